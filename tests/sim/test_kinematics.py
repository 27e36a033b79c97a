import numpy as np
import pytest

from ugr_lightning.errors import SimulationError
from ugr_lightning.sim.kinematics import (
    HOME,
    JOINT_HIGH,
    JOINT_LOW,
    SIDES,
    TcpPose,
    forward,
    inverse,
    rotation_from_vector,
    rotation_vector,
    solutions,
    to_base,
    to_world,
)


def random_joints(count):
    rng = np.random.default_rng(0)
    return rng.uniform(JOINT_LOW, JOINT_HIGH, (count, 6))


def test_every_solution_reaches_the_pose_within_the_limits_and_one_is_the_original():
    for joints in random_joints(200):
        pose = forward(joints)
        found = solutions(pose)
        assert min(np.abs(candidate - joints).max() for candidate in found) < 1e-6
        for candidate in found:
            again = forward(candidate)
            np.testing.assert_allclose(again.position, pose.position, atol=1e-9)
            np.testing.assert_allclose(again.rotation, pose.rotation, atol=1e-7)
            assert (candidate >= JOINT_LOW).all()
            assert (candidate <= JOINT_HIGH).all()


def test_inverse_stays_on_the_branch_it_comes_from():
    for joints in random_joints(100):
        near = joints + 0.02
        np.testing.assert_allclose(inverse(forward(joints), near), joints, atol=1e-6)


def test_where_wrist_axes_align_the_forearm_keeps_its_roll():
    joints = np.array([0.2, -0.5, 0.8, 0.7, 0.0, -0.4])
    np.testing.assert_allclose(inverse(forward(joints), joints), joints, atol=1e-6)


def test_a_pose_out_of_reach_is_a_clear_error():
    with pytest.raises(SimulationError, match="within reach"):
        inverse(TcpPose(np.array([2.0, 0.0, 0.0]), np.eye(3)), HOME)


def test_world_and_base_frames_are_inverse_and_the_arms_face_each_other():
    pose = forward(HOME)
    for side in SIDES:
        back = to_base(side, to_world(side, pose))
        np.testing.assert_allclose(back.position, pose.position)
        np.testing.assert_allclose(back.rotation, pose.rotation)
    left, right = (to_world(side, pose) for side in SIDES)
    np.testing.assert_allclose(left.position * [-1, 1, 1], right.position, atol=1e-12)
    np.testing.assert_allclose(left.rotation[:, 0] @ [1, 0, 0], -right.rotation[:, 0] @ [1, 0, 0])


@pytest.mark.parametrize("vector", [[0.0, 0.0, 0.0], [0.3, -0.2, 1.0], [0.0, np.pi, 0.0]])
def test_rotation_vectors_round_trip_up_to_half_a_turn(vector):
    rotation = rotation_from_vector(np.array(vector))
    np.testing.assert_allclose(rotation_from_vector(rotation_vector(rotation)), rotation, atol=1e-6)
