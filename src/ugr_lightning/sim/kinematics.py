"""Closed-form kinematics of one ViperX 300s arm (numpy only).

The last three joint axes meet in one point, so that position and orientation separate. Frames: the arm's base frame has
x forward and z up; the tool (TCP) frame has x along the gripper and y along the finger motion.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ugr_lightning.embodiment import BASE_X, FOREARM, SHOULDER_HEIGHT, TOOL_LENGTH, UPPER_ARM
from ugr_lightning.errors import SimulationError

Array = NDArray[np.float64]

SIDES: tuple[str, str] = ("left", "right")
JOINT_LOW: Array = np.array([-3.14158, -1.85005, -1.76278, -3.14158, -1.8675, -3.14158])
JOINT_HIGH: Array = np.array([3.14158, 1.25664, 1.6057, 3.14158, 2.23402, 3.14158])
FINGER_CLOSED, FINGER_OPEN = 0.0215, 0.057  # finger joint, metres
UP: Array = np.array([0.0, 0.0, 1.0])
HOME: Array = np.array([0.0, -0.96, 1.16, 0.0, -0.3, 0.0])

_UPPER_LENGTH = float(np.hypot(*UPPER_ARM))
_UPPER_ANGLE = float(np.arctan2(*UPPER_ARM))
_JOINT_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.7, 1.0, 0.7])
_ROLL_COST = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.5])


class TcpPose(NamedTuple):
    """Position and orientation of a tool frame.

    Args:
        position: (3,) metres.
        rotation: (3, 3) rotation matrix.
    """

    position: Array
    rotation: Array


class UnreachableError(SimulationError):
    """A tool pose that no joint configuration within the limits reaches."""


def rotation_x(angle: float) -> Array:
    """Rotation about x by `angle` radians, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle: float) -> Array:
    """Rotation about y by `angle` radians, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle: float) -> Array:
    """Rotation about z by `angle` radians, (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_vector(rotation: Array) -> Array:
    """Axis times angle of a rotation matrix, (3,); the angle is in [0, pi]."""
    angle = float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))
    if angle < 1e-9:
        return np.zeros(3)
    if angle > np.pi - 1e-4:  # the antisymmetric part vanishes: take the eigenvector of eigenvalue 1
        return np.linalg.eigh((rotation + rotation.T) / 2.0)[1][:, -1] * angle
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return axis * (angle / (2.0 * np.sin(angle)))


def rotation_from_vector(vector: Array) -> Array:
    """Rotation matrix of an axis-times-angle vector (3,)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def base_rotation(side: str) -> Array:
    """Orientation of an arm's base in the world, (3, 3): both arms look towards the middle."""
    return np.eye(3) if side == "left" else np.diag([-1.0, -1.0, 1.0])


def base_position(side: str) -> Array:
    """Position of an arm's base in the world, (3,) metres."""
    return np.array([-BASE_X if side == "left" else BASE_X, 0.0, 0.0])


def to_base(side: str, pose: TcpPose, base_height: float = 0.0) -> TcpPose:
    """Express a world pose in the frame of an arm's base, which stands `base_height` metres above the table top."""
    inverse, base = base_rotation(side).T, base_position(side) + base_height * UP
    return TcpPose(inverse @ (pose.position - base), inverse @ pose.rotation)


def to_world(side: str, pose: TcpPose, base_height: float = 0.0) -> TcpPose:
    """Express a pose of the frame of an arm's base in the world; see `to_base`."""
    rotation, base = base_rotation(side), base_position(side) + base_height * UP
    return TcpPose(base + rotation @ pose.position, rotation @ pose.rotation)


def forward(joints: Array) -> TcpPose:
    """Tool pose in the arm's base frame.

    Args:
        joints: (6,) radians.
    """
    rotation = rotation_z(joints[0])
    position = np.array([0.0, 0.0, SHOULDER_HEIGHT])
    rotation = rotation @ rotation_y(joints[1])
    position = position + rotation @ np.array([UPPER_ARM[0], 0.0, UPPER_ARM[1]])
    rotation = rotation @ rotation_y(joints[2])
    position = position + rotation @ np.array([FOREARM, 0.0, 0.0])
    rotation = rotation @ rotation_x(joints[3]) @ rotation_y(joints[4]) @ rotation_x(joints[5])
    return TcpPose(position + rotation[:, 0] * TOOL_LENGTH, rotation)


def solutions(pose: TcpPose, roll_at_singularity: float = 0.0) -> list[Array]:
    """All joint configurations within the limits that reach a tool pose.

    Args:
        pose: tool pose in the arm's base frame.
        roll_at_singularity: forearm roll (rad) to use where it and the wrist roll share one axis.

    Returns:
        At most eight arrays of (6,) radians.
    """
    found = []
    for waist, lift, bend in _arm_branches(pose.position - pose.rotation[:, 0] * TOOL_LENGTH):
        wrist = (rotation_z(waist) @ rotation_y(lift + bend)).T @ pose.rotation
        for roll, tilt, twist in _wrist_branches(wrist, roll_at_singularity):
            joints = np.array([waist, lift, bend, roll, tilt, twist])
            if np.all(joints >= JOINT_LOW) and np.all(joints <= JOINT_HIGH):
                found.append(joints)
    return found


def inverse(pose: TcpPose, near: Array, *, prefer_small_rolls: float = 0.0) -> Array:
    """Joints that reach a tool pose, on the branch closest to `near`.

    Args:
        pose: tool pose in the arm's base frame.
        near: (6,) radians.
        prefer_small_rolls: weight that keeps forearm and wrist roll small. Without it a path that starts on a branch
            with large rolls stays there and meets the joint limits later.

    Returns:
        (6,) radians.

    Raises:
        UnreachableError: no configuration within the joint limits.
    """
    found = solutions(pose, float(near[3]))
    if not found:
        where = f"tool position {np.round(pose.position, 3).tolist()} in the arm's base frame"
        raise UnreachableError(where, "a pose within reach and joint limits", "none", "Choose a nearer pose.")
    return min(found, key=lambda q: float(_JOINT_WEIGHTS @ (q - near) ** 2 + prefer_small_rolls * (_ROLL_COST @ q**2)))


def _arm_branches(wrist: Array) -> list[tuple[float, float, float]]:
    """Waist, shoulder and elbow angles that bring the wrist centre to a point."""
    branches = []
    height = wrist[2] - SHOULDER_HEIGHT
    for behind in (False, True):
        waist = _wrap(np.arctan2(wrist[1], wrist[0]) + np.pi * behind)
        radius = float(np.hypot(wrist[0], wrist[1])) * (-1.0 if behind else 1.0)
        cosine = (radius**2 + height**2 - _UPPER_LENGTH**2 - FOREARM**2) / (2.0 * _UPPER_LENGTH * FOREARM)
        if abs(cosine) > 1.0:
            continue
        for sign in (1.0, -1.0):
            fold = sign * np.arccos(cosine)
            upper = np.arctan2(radius, height)
            upper -= np.arctan2(FOREARM * np.sin(fold), _UPPER_LENGTH + FOREARM * np.cos(fold))
            lift = _wrap(upper - _UPPER_ANGLE)
            branches.append((waist, lift, _wrap(upper + fold - np.pi / 2.0 - lift)))
    return branches


def _wrist_branches(wrist: Array, roll_at_singularity: float) -> list[tuple[float, float, float]]:
    """Forearm roll, wrist angle and wrist roll of a wrist rotation."""
    tilt = float(np.arccos(np.clip(wrist[0, 0], -1.0, 1.0)))
    if abs(np.sin(tilt)) < 1e-6:
        total = np.arctan2(wrist[2, 1], wrist[1, 1])
        return [(roll_at_singularity, tilt, _wrap(total - roll_at_singularity))]
    return [
        (
            float(np.arctan2(sign * wrist[1, 0], -sign * wrist[2, 0])),
            sign * tilt,
            float(np.arctan2(sign * wrist[0, 1], sign * wrist[0, 2])),
        )
        for sign in (1.0, -1.0)
    ]


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
