import importlib.util
import os

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
import pytest

from ugr_lightning.data.keyframes import next_keyframes
from ugr_lightning.errors import SimulationError
from ugr_lightning.sim.kinematics import SIDES, forward, to_world
from ugr_lightning.sim.outside.aloha_transfer_cube import ENVIRONMENT, HIGH, LOW, TABLE, AlohaTransferCube

if not all(importlib.util.find_spec(name) for name in ("gym_aloha", "dm_control")):
    pytest.skip("needs `pip install ugr-lightning[aloha]`", allow_module_level=True)

TASK, SIZE = "aloha_transfer_cube", (60, 80)


@pytest.fixture(scope="module")
def cube():
    try:
        simulator = AlohaTransferCube(TASK, image_size=SIZE)
        simulator.reset(0)
    except SimulationError as error:
        if os.environ.get("UGR_REQUIRE_RENDERING") == "1":
            raise
        pytest.skip(str(error))
    with simulator:
        yield simulator


def test_the_expert_hands_the_cube_over_within_the_limit(cube):
    frame, successes, touching, left = cube.reset(3, look=False), [], [], []
    home, start = frame.commanded, cube._cube()
    for step in cube.expert():
        assert 0.0 <= step.slack <= 1.0
        frame = cube.step(step.action, look=False)
        successes.append(frame.success)
        touching.append(bool(frame.contacts[0]))
        left.append(bool(frame.contacts[1]))
    first = successes.index(True)
    assert all(successes[first:]), "a success once is a success of the episode"
    assert touching.index(True) in (first - 1, first), "it begins when the left fingers reach the lifted cube"
    assert 60 < first < 160
    assert len(successes) < cube.horizon
    assert not frame.contacts[1]
    assert left[first], "until then the right fingers hold it"
    assert frame.images.shape == (0, *SIZE, 3)
    assert np.linalg.norm(cube._cube() - start) > 0.15
    assert not cube.reset(3, look=False).success
    assert np.array_equal(cube.reset(3, look=False).commanded, home)


def test_its_tools_are_where_our_kinematics_have_them_and_grip_at_the_cube(cube):
    frame, frames, intentions = cube.reset(3, look=False), [], []
    for step in cube.expert():
        frames.append(cube.step(step.action, look=False))
        intentions.append(step.action)
    for arm, side in enumerate(SIDES):
        tool = to_world(side, forward(frames[40].measured[7 * arm : 7 * arm + 6].astype(float)))
        assert tool.position + TABLE == pytest.approx(frames[40].endpose[arm, :3], abs=1e-4)
    grasp = next_keyframes(np.stack(intentions)[:, 7:])[0]
    place = np.array(cube.scene_info()["cube"])[:2] + TABLE[:2]
    assert np.linalg.norm(frames[grasp - 1].endpose[1, :2] - place) < 0.01
    assert frame.projection is None


def test_a_command_is_two_steps_of_the_environment_as_it_is_made_by_others(cube):
    """The joints bit for bit; the picture up to the shadows."""
    import gymnasium

    cube_at_full_size = AlohaTransferCube(TASK, image_size=(480, 640))
    original = gymnasium.make(ENVIRONMENT, obs_type="pixels_agent_pos")
    seen, _ = original.reset(seed=12)
    ours = cube_at_full_size.reset(12, look=False)
    assert np.array_equal(seen["agent_pos"].astype(np.float32), ours.measured)
    action = ours.commanded + np.tile([0.1, -0.05, 0.1, 0.0, 0.1, 0.0, 0.5], 2).astype(np.float32)
    for _ in range(2):
        seen, *_ = original.step(action)
    with cube_at_full_size:
        ours = cube_at_full_size.step(action)
    assert np.array_equal(seen["agent_pos"].astype(np.float32), ours.measured)
    difference = np.abs(ours.images[0].astype(int) - seen["pixels"]["top"])
    assert np.median(difference) <= 1
    assert difference.mean() < 4


def test_an_episode_does_not_depend_on_what_ran_before(cube):
    def run(seed):
        frames = [cube.reset(seed)]
        frames += [cube.step(frames[0].commanded + 0.02 * step) for step in range(4)]
        return frames

    once, other, again = run(7), run(8), run(7)
    for before, after in zip(once, again, strict=True):
        assert np.array_equal(before.images, after.images)
        assert np.array_equal(before.measured, after.measured)
    assert not np.array_equal(once[0].images, other[0].images)


def test_the_cube_is_red_where_the_camera_parameters_put_it(cube):
    for seed in (1, 2):
        image = cube.reset(seed).images[0].astype(int)  # (H, W, 3)
        camera = cube.camera_parameters()["top"]
        x, y, z = cube.scene_info()["cube"]
        point = np.array([x, y + 0.5, z, 1.0])
        u, v, depth = camera["intrinsic_cv"] @ camera["extrinsic_cv"] @ point
        assert depth > 0
        red = np.argwhere((image[..., 0] > 120) & (image[..., 1:].max(-1) < 80))
        assert len(red) >= 2
        assert np.abs(red.mean(0) + 0.5 - [v / depth, u / depth]).max() < 1.0
        product = camera["cam2world_gl"] @ np.diag([1, -1, -1, 1]) @ np.vstack([camera["extrinsic_cv"], [0, 0, 0, 1]])
        assert np.allclose(product, np.eye(4))


def test_commands_are_clipped_and_doing_nothing_does_not_succeed(cube):
    home = cube.reset(0, look=False).commanded
    for _ in range(10):
        frame = cube.step(home, look=False)
    assert not frame.success
    assert np.abs(frame.measured - home).max() < 0.05
    assert np.array_equal(cube.step(np.full(14, 9.0), look=False).commanded, HIGH.astype(np.float32))
    assert np.array_equal(cube.step(np.full(14, -9.0), look=False).commanded, LOW.astype(np.float32))
