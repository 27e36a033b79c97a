import numpy as np
import pytest

from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, NumericsError, SimulationError
from ugr_lightning.sim.sapien_simulator import SapienSimulator

HOME = np.array([0, -0.96, 1.16, 0, -0.3, 0, 1] * 2, np.float32)


def play(simulator, seed, noise=0.0):
    """Frames of the expert's episode with white noise on what is executed."""
    rng = np.random.default_rng(seed)
    frames = [simulator.reset(seed)]
    for step in simulator.expert():
        frames.append(simulator.step(step.action + noise * step.slack * rng.standard_normal(14)))
    return frames


def assert_identical(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        for name, a, b in zip(one._fields, one, other, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)


def test_a_frame_has_the_shapes_and_types_of_the_contract(click):
    frame = click.reset(0)
    assert frame.images.shape == (len(CAMERAS), 30, 40, 3)
    assert frame.images.dtype == np.uint8
    assert frame.commanded.dtype == frame.measured.dtype == np.float32
    assert frame.endpose.shape == (2, 7)
    np.testing.assert_array_equal(frame.commanded, HOME)
    np.testing.assert_allclose(frame.measured, HOME, atol=1e-6)
    assert frame.contacts.tolist() == [False, False]
    assert frame.success is False
    assert click.control_hz == 25.0


def test_the_same_seed_gives_the_same_episode_whatever_ran_before(click):
    first = play(click, 3)
    play(click, 4, noise=0.2)
    click.reset(5)
    rng = np.random.default_rng(0)
    for _ in range(20):
        click.step(rng.uniform(-3, 3, 14))
    assert_identical(first, play(click, 3))


def test_contact_rich_episodes_repeat_too_and_in_another_simulator(handover):
    first = play(handover, 7)
    handover.reset(8)
    for _ in range(30):
        handover.step(np.zeros(14))
    assert_identical(first, play(handover, 7))
    with SapienSimulator("handover_block", image_size=(30, 40), render=False) as another:
        assert_identical(first, play(another, 7))


def test_the_pictures_show_what_differs_between_seeds(click):
    first, second = click.reset(0).images, click.reset(1).images
    assert (np.abs(first[0].astype(int) - second[0]) > 40).any()
    assert first[0].min() < 100  # the arms are dark
    assert all(image.std() > 5 for image in first)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_not_finite_never_reaches_the_simulator(click, bad):
    click.reset(0)
    action = HOME.copy()
    action[3] = bad
    with pytest.raises(NumericsError, match=r"\[3\]"):
        click.step(action)
    np.testing.assert_array_equal(click.step(HOME).commanded, HOME)


def test_an_action_of_the_wrong_shape_is_refused(click):
    click.reset(0)
    with pytest.raises(SimulationError, match="14"):
        click.step(np.zeros(7))


def test_actions_are_clipped_to_the_limits_and_reported_as_commanded(click):
    click.reset(0)
    action = HOME.copy()
    action[[1, 6]] = 9.0
    frame = click.step(action)
    assert frame.commanded[1] == np.float32(1.25664)
    assert frame.commanded[6] == 1.0


def test_the_measured_joints_follow_the_command_in_the_order_of_the_contract(click):
    click.reset(0)
    goal = HOME.copy()
    goal[[0, 6, 12, 13]] = [0.3, 0.2, -0.4, 0.7]
    for _ in range(25):
        frame = click.step(goal)
    np.testing.assert_allclose(frame.measured, goal, atol=0.01)
    assert frame.endpose[0, 0] < 0 < frame.endpose[1, 0]


def test_camera_parameters_are_those_of_the_picture(click):
    click.reset(0)
    parameters = click.camera_parameters()
    assert tuple(parameters) == CAMERAS
    high = parameters["cam_high"]
    button = np.append(click.scene_info()["button"], 1.0)
    x, y, depth = high["intrinsic_cv"] @ (high["extrinsic_cv"] @ button)
    column, row = round(x / depth), round(y / depth)
    red, green, blue = click.reset(0).images[0, row, column].astype(int)
    assert red > blue + 60
    assert green > blue + 40  # the button is yellow
    assert high["cam2world_gl"].shape == (4, 4)


def test_without_rendering_there_are_no_pictures(handover):
    assert handover.reset(0).images.shape == (0, 30, 40, 3)


def test_stepping_before_reset_says_so():
    with SapienSimulator("click_alarmclock", render=False) as simulator, pytest.raises(SimulationError, match="reset"):
        simulator.step(HOME)


def test_an_unknown_setting_is_refused():
    with pytest.raises(ConfigError, match="demo_clean"):
        SapienSimulator("click_alarmclock", setting="demo_dirty", render=False)


def test_steps_that_nobody_looks_at_change_no_later_picture(click):
    always, rarely = click.reset(6), click.reset(6, look=False)
    assert rarely.images.shape == (0, 30, 40, 3)
    actions = np.linspace(HOME, HOME + 0.3, 7)
    click.reset(6)
    for action in actions:
        always = click.step(action)
    click.reset(6, look=False)
    for index, action in enumerate(actions):
        rarely = click.step(action, look=index == len(actions) - 1)
    assert_identical([always], [rarely])


def test_rendering_changes_nothing_in_the_physics(click):
    with SapienSimulator("click_alarmclock", render=False) as blind:
        for seen, unseen in zip(play(click, 6), play(blind, 6), strict=True):
            np.testing.assert_array_equal(seen.measured, unseen.measured)
            assert seen.success == unseen.success
