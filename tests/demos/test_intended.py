import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ugr_lightning.demos.intended import intended_poses
from ugr_lightning.sim.kinematics import HOME, SIDES, forward, to_world

N, DROP = 4, 0.03


def tools(joints):
    """(N, 2, 7) world poses of both tools, on a table that stands lower than usual."""
    found = []
    for row in joints:
        poses = [to_world(s, forward(row[i : i + 6]), -DROP) for s, i in zip(SIDES, (0, 7), strict=True)]
        turns = [Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True) for pose in poses]
        found.append([[*pose.position, *turn] for pose, turn in zip(poses, turns, strict=True)])
    return np.array(found)


def test_a_tool_is_where_the_command_meant_it_to_be_where_there_was_noise_and_where_it_was_elsewhere():
    rng = np.random.default_rng(0)
    intended = np.tile(np.append(HOME, 1.0), 2) + 0.2 * rng.normal(size=(N, 14))
    measured = np.concatenate([intended[:1], intended + 0.04 * rng.normal(size=(N, 14))])
    were, slack = tools(measured), np.array([0.0, 0.3, 0.0, 1.0])
    poses = intended_poses(were, measured, intended, slack, forward)
    np.testing.assert_array_equal(poses[[0, 1, 3]], were[[0, 1, 3]])
    meant = tools(intended)[[1, 3]]
    assert poses[[2, 4], :, :3] == pytest.approx(meant[..., :3], abs=1e-9)
    alike = np.abs((poses[[2, 4], :, 3:] * meant[..., 3:]).sum(-1))  # a rotation has two quaternions
    assert alike == pytest.approx(1.0)
    assert np.linalg.norm(were[[2, 4], :, :3] - meant[..., :3], axis=-1).min() > 0.003
