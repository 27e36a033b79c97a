"""Where the tools of a demonstration would have been without the noise on its commands."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from ugr_lightning.sim.kinematics import Array, TcpPose


def intended_poses(
    endpose: np.ndarray,
    measured: np.ndarray,
    intended: np.ndarray,
    slack: np.ndarray,
    forward: Callable[[Array], TcpPose],
) -> np.ndarray:
    """Tool poses in which those after a disturbed command are replaced by where the intended command leads.

    Noise displaces a tool by a centimetre and more, which no picture tells: a keyframe has to be where it was meant to
    be, as the commands that are learned are. Elsewhere the tool is left where it was; what it pushes against stops it.

    Args:
        endpose: (N + 1, 2, 7) where the tools were, x y z qw qx qy qz, m.
        measured: (N + 1, 14) joints then, robot units.
        intended: (N, 14) commands without noise, robot units.
        slack: (N,) how much noise each command had, 0 for none.
        forward: from the six joints of an arm to its tool in the arm's base frame.

    Returns:
        (N + 1, 2, 7).
    """
    poses = np.array(endpose, np.float64)
    for step in np.flatnonzero(slack):
        for arm, joints in enumerate((slice(0, 6), slice(7, 13))):
            was, meant = forward(measured[step + 1, joints]), forward(intended[step, joints])
            pose = poses[step + 1, arm]  # (7,), a view
            base = Rotation.from_quat(pose[3:], scalar_first=True) * Rotation.from_matrix(was.rotation).inv()
            pose[:3] += base.apply(meant.position - was.position)
            pose[3:] = (base * Rotation.from_matrix(meant.rotation)).as_quat(scalar_first=True)
    return poses
