from functools import partial

import numpy as np
import pytest

from ugr_lightning.sim.kinematics import rotation_y
from ugr_lightning.sim.objects import pose_of
from ugr_lightning.sim.sapien_simulator import SapienSimulator
from ugr_lightning.sim.tasks.pick_dual_bottles import (
    GLASS,
    GOALS,
    HEIGHT_RANGE,
    RADIUS_RANGE,
    RAISED,
    TOLERANCE,
    X_RANGE,
    Y_RANGE,
    YAW_RANGE,
)


@pytest.fixture(scope="module")
def bottles():
    with SapienSimulator("pick_dual_bottles", render=False) as simulator:
        yield simulator


@pytest.fixture
def held(bottles):
    """Put both bottles at their places, one of them with an offset, and ask whether that is the goal."""
    bottles.reset(0)
    environment = bottles._env

    def condition(moved="left", offset=(0.0, 0.0, 0.0), rotation=None):
        for side, goal in GOALS.items():
            base = np.array([*goal, RAISED + 0.01]) + (offset if side == moved else 0.0)
            environment.bottles[side].actor._objs[0].set_pose(pose_of(base, rotation if side == moved else None))
        return environment.condition()

    return condition


@pytest.mark.parametrize("side", ["left", "right"])
def test_each_bottle_has_to_be_within_ten_centimetres_of_its_place_in_x_and_y(held, holds_within, side):
    assert held()
    assert holds_within(partial(held, side), (TOLERANCE, TOLERANCE))


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_base_of_each_bottle_has_to_be_raised_as_in_robotwin(held, side):
    assert pytest.approx(0.89 - 0.74) == RAISED
    assert held(side, np.array([0.0, 0.0, -0.009]))
    assert not held(side, np.array([0.0, 0.0, -0.011]))


def test_the_grippers_do_not_matter_and_neither_does_the_tilt(held, bottles):
    assert held(rotation=rotation_y(0.5))
    for opening in (0.0, 1.0):
        bottles._env.command[[6, 13]] = opening
        assert held()


def test_bottles_stand_within_the_ranges_and_vary_with_the_seed_only(bottles):
    scenes = []
    for seed in range(14):
        bottles.reset(seed)
        scenes.append(bottles.scene_info())
    for side, sign in (("left", -1.0), ("right", 1.0)):
        seen = [scene[f"bottle_{side}"] for scene in scenes]
        x, y = (sign * np.array([bottle["place"] for bottle in seen]) * [1.0, sign]).T
        for values, limits in (
            (x, X_RANGE),
            (y, Y_RANGE),
            ([bottle["yaw"] for bottle in seen], YAW_RANGE),
            ([bottle["radius"] for bottle in seen], RADIUS_RANGE),
            ([bottle["height"] for bottle in seen], HEIGHT_RANGE),
        ):
            assert limits[0] <= min(values) < max(values) <= limits[1]
            assert max(values) - min(values) > 0.6 * (limits[1] - limits[0])
        assert len({tuple(bottle["colour"]) for bottle in seen}) > len(GLASS) / 2
    assert all(scene["bottle_left"]["colour"] != scene["bottle_right"]["colour"] for scene in scenes)
    bottles.reset(3)
    assert bottles.scene_info() == scenes[3]


def test_a_bottle_is_as_large_as_it_says_and_stands(bottles):
    home = bottles.reset(4).commanded
    for _ in range(25):
        bottles.step(home)
    for bottle in bottles._env.bottles.values():
        base, rotation = bottle.pose()
        assert base == pytest.approx([*bottle.place, 0.0], abs=1e-3)
        assert rotation[2, 2] > 0.9999
        entity = bottle.actor._objs[0]
        entity.set_pose(pose_of((0.0, 0.0, 0.0)))  # bounds follow the axes of the world
        body = next(part for part in entity.components if hasattr(part, "compute_global_aabb_tight"))
        low, high = body.compute_global_aabb_tight()
        assert high - low == pytest.approx([2 * bottle.radius, 2 * bottle.radius, bottle.height], abs=1e-3)


def _owner(entity):
    name = entity.name.removeprefix("scene-0_").removeprefix("bottle_")
    return name.split("_")[0]


def test_both_arms_work_at_once_and_neither_meets_the_other_or_its_bottle(bottles):
    for seed in (5, 6):
        rng, offset = np.random.default_rng(seed), np.zeros(14)
        frame = bottles.reset(seed)
        contacts, phases, successes = [], [], []
        for step in bottles.expert():
            offset = 0.92 * offset + 0.39 * 0.04 * rng.standard_normal(14)
            offset[[6, 13]] = 0.0
            frame = bottles.step(step.action + step.slack * offset)
            contacts.append(frame.contacts)
            phases.append(step.phase)
            successes.append(frame.success)
            for contact in bottles._env.scene.sub_scenes[0].physx_system.get_contacts():
                if any(np.linalg.norm(point.impulse) > 0.0 for point in contact.points):
                    assert {_owner(body.entity) for body in contact.bodies} != {"left", "right"}
        lift, carry = phases.index("lift"), phases.index("carry")
        assert not np.any(contacts[: phases.index("grasp")])  # a touch on the way would show in the pictures
        assert np.all(contacts[lift:])
        assert not any(successes[:carry])
        assert frame.success
        for side, bottle in bottles._env.bottles.items():
            base, rotation = bottle.pose()
            assert np.abs(base[:2] - GOALS[side]).max() < 0.05
            assert base[2] > RAISED + 0.02
            assert rotation[2, 2] > 0.99
