import numpy as np
import pytest

from ugr_lightning.sim.expert import Arms, grasp_yaw, gripper_down, minimum_jerk
from ugr_lightning.sim.kinematics import HOME, TcpPose, UnreachableError, forward, to_world

START = np.concatenate([HOME, [1.0], HOME, [1.0]]).astype(np.float32)
ABOVE = TcpPose(np.array([-0.15, -0.1, 0.2]), gripper_down(0.0))
BELOW = TcpPose(np.array([-0.15, -0.1, 0.1]), gripper_down(0.0))


def tool_path(steps):
    return np.array([to_world("left", forward(step.action[:6].astype(float))).position for step in steps])


def test_a_motion_ends_exactly_at_its_goal_and_leaves_the_other_arm_alone():
    steps = list(Arms(START).move({"left": ABOVE}, steps=30, phase="reach"))
    reached = to_world("left", forward(steps[-1].action[:6].astype(float)))
    assert len(steps) == 30
    np.testing.assert_allclose(reached.position, ABOVE.position, atol=1e-5)
    np.testing.assert_allclose(reached.rotation, ABOVE.rotation, atol=1e-5)
    np.testing.assert_array_equal(steps[-1].action[7:], START[7:])


def test_a_second_motion_goes_straight_down_and_smoothly():
    arms = Arms(START)
    list(arms.move({"left": ABOVE}, steps=30, phase="reach"))
    path = tool_path(arms.move({"left": BELOW}, steps=30, phase="press"))
    np.testing.assert_allclose(path[:, :2], np.tile(ABOVE.position[:2], (30, 1)), atol=1e-5)
    assert (np.diff(path[:, 2]) < 1e-6).all()


def test_overlapping_motions_do_not_stop_in_between_and_still_end_at_the_goal():
    arms = Arms(START)
    steps = list(arms.move({"left": ABOVE}, steps=30, phase="reach", overlap=10))
    steps += list(arms.move({"left": BELOW}, steps=30, phase="press"))
    path = tool_path(steps)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert len(steps) == 50
    assert speed[5:-5].min() > 3e-4
    assert np.abs(np.diff(speed)).max() < 6e-3
    np.testing.assert_allclose(path[-1], BELOW.position, atol=1e-5)


def test_speed_divides_the_number_of_steps():
    fast = list(Arms(START, speed=2.0).move({"left": ABOVE}, steps=30, phase="reach"))
    assert len(fast) == 15


def test_the_nominal_command_never_depends_on_what_was_executed():
    steps = list(Arms(START).move({"left": ABOVE}, steps=30, phase="reach"))
    arms, noisy = Arms(START), []
    for step in arms.move({"left": ABOVE}, steps=30, phase="reach"):
        noisy.append(step.action.copy())
        step.action[:] += 0.1  # an executor that adds its noise in place
    np.testing.assert_array_equal(noisy, [step.action for step in steps])


def test_slack_rises_from_zero_and_follows_its_knots():
    steps = list(Arms(START).move({"left": ABOVE}, steps=40, phase="reach", slack=(1.0, 1.0, 0.0)))
    slack = np.array([step.slack for step in steps])
    assert slack[0] == 0.0
    assert slack[20] > 0.99
    assert slack[-1] == 0.0
    assert np.abs(np.diff(slack)).max() < 0.25


def test_grippers_ramp_while_the_arm_moves():
    steps = list(Arms(START).move({"left": ABOVE}, steps=30, phase="reach", grip={"left": 0.0}))
    opening = np.array([step.action[6] for step in steps])
    assert (np.diff(opening) <= 0).all()
    assert opening[-1] == 0.0
    assert steps[-1].action[13] == 1.0


def test_a_goal_out_of_reach_raises():
    with pytest.raises(UnreachableError, match=r"left arm, phase `reach`: .*position \[0\.6, 0\.0, 0\.3\]"):
        list(Arms(START).move({"left": TcpPose(np.array([0.6, 0.0, 0.3]), gripper_down(0.0))}, steps=5, phase="reach"))


def test_minimum_jerk_is_at_rest_at_both_ends():
    assert minimum_jerk(0.0) == 0.0
    assert minimum_jerk(1.0) == 1.0
    assert minimum_jerk(0.01) < 1e-4
    assert minimum_jerk(0.5) == pytest.approx(0.5)


def test_grasp_yaw_uses_the_symmetry_of_a_square_block():
    assert grasp_yaw("left", 0.3) == pytest.approx(0.3)
    assert grasp_yaw("left", np.pi / 2 + 0.3) == pytest.approx(0.3)
    assert grasp_yaw("right", 0.3) == pytest.approx(np.pi + 0.3)
