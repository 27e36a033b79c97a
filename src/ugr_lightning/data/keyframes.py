"""Where each hand will grip, or let go, next: labels that recordings hold without anybody having drawn them."""

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.embodiment import ACTION_DIM

ARM = 7
HALF_OPEN = 0.5
AT_REST = 0.002
"""An arm whose joints are commanded to move less in a control step, rad, is to rest: a gripper that closes on the way
marks no keyframe, and noise on the executed motion hides none."""

FLAT = 1e-6
"""Determinant of a camera's matrix below which it sees no depth; a real one has one of about 1."""


def next_keyframes(commands: np.ndarray) -> np.ndarray:
    """For each step of a demonstration, when the next keyframe of an arm is.

    Args:
        commands: (T, 7) of the arm: six joints in rad, and the gripper, 0 closed .. 1 open.

    Returns:
        (T,) int64, 1 .. T: the frame at which the gripper changes while the hand rests, or the last one.
    """
    steps = len(commands)
    resting = np.abs(np.diff(commands[:, :-1], axis=0)).max(axis=1) < AT_REST  # (T - 1,)
    changes = np.flatnonzero(np.diff(commands[:, -1] > HALF_OPEN) & resting) + 1
    events = np.append(changes, steps)  # (n,)
    return events[np.searchsorted(events, np.arange(steps), side="right")]


def missing_for_keyframes(episode: Episode) -> list[str]:
    """What a demonstration lacks of what its keyframes are made of, in words; empty where it has them.

    Args:
        episode: of any format.
    """
    commands = f"commands of two arms of six joints ({ACTION_DIM} numbers; {episode.action.shape[1]} here)"
    poses, cameras = episode.endpose, episode.projection  # (T + 1, 2, 7), (T, V, 3, 4)
    lengths = np.ones(1) if poses is None else np.linalg.norm(poses[..., 3:], axis=-1)  # (T + 1, 2), of quaternions
    depths = np.ones(1) if cameras is None else np.linalg.det(cameras[..., :3].astype(np.float64))  # (T, V)
    lacks = {
        "tool poses (`endpose`)": poses is None,
        "tool poses that are filled in (`endpose` has quaternions of length 0)": not lengths.all(),
        "calibrated cameras (`intrinsic_cv`, `extrinsic_cv`)": cameras is None,
        "a calibration that is filled in (`intrinsic_cv`, `extrinsic_cv` have no inverse)": np.abs(depths).min() < FLAT,
        commands: episode.action.shape[1] != ACTION_DIM,
    }
    return [what for what, missing in lacks.items() if missing]


def keyframe_labels(episode: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Poses of both tools at their next keyframes, for each step of a demonstration.

    Args:
        episode: with tool poses and commands of our two arms.

    Returns:
        (T, 2, 3) positions in m, (T, 2, 6) first two axes of the tool, (T, 2) steps until then; None where the
        demonstration lacks what they are made of.
    """
    if missing_for_keyframes(episode):
        return None
    arms = range(ACTION_DIM // ARM)
    poses = np.asarray(episode.endpose, np.float64)  # (T + 1, 2, 7)
    when = np.stack([next_keyframes(episode.action[:, ARM * arm : ARM * (arm + 1)]) for arm in arms], 1)  # (T, 2)
    there = np.stack([poses[when[:, arm], arm] for arm in arms], 1)  # (T, 2, 7)
    delay = when - np.arange(len(when))[:, None]  # (T, 2)
    return there[..., :3].astype(np.float32), first_axes(there[..., 3:]).astype(np.float32), delay


def first_axes(quaternion: np.ndarray) -> np.ndarray:
    """The first and second column of the rotation of a unit quaternion, (..., 4) qw qx qy qz to (..., 6)."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    second = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
    return np.stack([*first, *second], -1)
