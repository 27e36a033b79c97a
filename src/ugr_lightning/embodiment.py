"""The paper's robot: cameras, joints, chunk, and where a camera sees the world; without torch, which takes seconds."""

import numpy as np

CAMERAS: tuple[str, ...] = ("cam_high", "cam_right_wrist", "cam_left_wrist")
STATE_DIM = 14
ACTION_DIM = 14
CHUNK_LENGTH = 50


def last_of_each_arm(dim: int) -> tuple[int, ...]:
    """Where the grippers are in a vector of joints: the last of each arm.

    Args:
        dim: how many joints; an odd number is one arm, an even one two equal arms.
    """
    return (dim - 1,) if dim % 2 else (dim // 2 - 1, dim - 1)


GRIPPERS = last_of_each_arm(ACTION_DIM)
"""Where the grippers are in both vectors."""


# One ViperX 300s arm, from its base to its tool; lengths in m. Its joints turn about z, y, y, x, y and x.
BASE_X = 0.469  # the arms stand at x = -+BASE_X and face each other, as in ALOHA
SHOULDER_HEIGHT = 0.12705
UPPER_ARM = (0.05955, 0.3)  # x and z of the elbow in the upper arm's frame
FOREARM = 0.3
TCP_OFFSET = 0.14  # gripper link to TCP, between the finger pads
TOOL_LENGTH = 0.069744 + TCP_OFFSET  # wrist centre to TCP


def image_projection(intrinsic: np.ndarray, extrinsic: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """The matrix that takes a point of the world to image units, whatever the size of the picture.

    A point (x, y, z, 1) becomes (u d, v d, d): d is its depth in m, u and v go from -1 to 1, left to right and top to
    bottom over the picture's edges.

    Args:
        intrinsic: (..., 3, 3), OpenCV's, in pixels.
        extrinsic: (..., 3, 4), world to camera, OpenCV's axes.
        image_size: (H, W) that the intrinsic matrix is for.

    Returns:
        (..., 3, 4) float32.
    """
    height, width = image_size
    units = np.array([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1]])
    return (units @ np.asarray(intrinsic, np.float64) @ np.asarray(extrinsic, np.float64)).astype(np.float32)
