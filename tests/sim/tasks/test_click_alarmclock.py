import numpy as np
import pytest

from ugr_lightning.sim.scene import Touch
from ugr_lightning.sim.tasks.click_alarmclock import BUTTON_RADIUS, FEET, MODELS, TOUCH_RADIUS, X_RANGE, Y_RANGE


@pytest.fixture
def at_button(click, monkeypatch):
    """Set what touches what, with a closed gripper, and ask whether that is a click."""
    click.reset(0)
    environment = click._env
    side = click.scene_info()["side"]

    def condition(offset=(0.0, 0.0, 0.0), touching=side, other="alarm_button", opening=0.0):
        environment.command[6 if side == "left" else 13] = opening
        point = environment.button_point + np.array(offset)
        monkeypatch.setattr(environment, "touches", lambda: [Touch(touching, other, point[None])])
        return environment.condition()

    return condition, side


def test_a_touch_within_three_centimetres_counts_and_beyond_does_not(at_button, holds_within):
    condition, _ = at_button
    assert condition()
    assert holds_within(condition, (0.03, 0.03, 0.03))


def test_the_gripper_must_be_commanded_closed(at_button):
    condition, _ = at_button
    assert condition(opening=0.19)
    assert not condition(opening=0.2)


def test_only_the_arm_on_the_side_of_the_clock_and_only_the_clock_count(at_button):
    condition, side = at_button
    assert not condition(touching="left" if side == "right" else "right")
    assert not condition(other="table")
    assert condition(other="alarm_clock")


def test_success_is_latched_and_the_fingers_report_contact(click):
    frame = click.reset(1)
    before = []
    for step in click.expert():
        before.append(frame.success)
        frame = click.step(step.action)
        if step.phase == "reach":
            assert not frame.success
    side = 0 if click.scene_info()["side"] == "left" else 1
    assert frame.contacts[side]
    assert not frame.contacts[1 - side]
    for _ in range(15):
        frame = click.step(np.array([0, -0.96, 1.16, 0, -0.3, 0, 1] * 2))
    assert not frame.contacts.any()
    assert frame.success


def test_clocks_stand_within_the_ranges_on_both_sides(click):
    buttons = []
    for seed in range(20):
        click.reset(seed)
        buttons.append(click.scene_info()["button"])
    x, y, _ = np.array(buttons).T
    assert ((np.abs(x) >= X_RANGE[0]) & (np.abs(x) <= X_RANGE[1])).all()
    assert ((y >= Y_RANGE[0]) & (y <= Y_RANGE[1])).all()
    assert 4 < (x > 0).sum() < 16


def test_both_clocks_occur_and_their_buttons_have_their_own_height(click):
    scenes = [(click.reset(seed), click.scene_info())[1] for seed in range(12)]
    assert {scene["model"] for scene in scenes} == set(MODELS)
    for scene in scenes:
        assert scene["button"][2] == MODELS[scene["model"]].button


def test_a_touch_near_the_button_is_a_touch_of_the_clock_on_both_models():
    for model in MODELS.values():
        assert min(model.size[:2]) / 2.0 >= TOUCH_RADIUS > BUTTON_RADIUS
        assert model.button - FEET - model.size[2] < TOUCH_RADIUS
