"""Made-up demonstrations, as costly to read as recorded ones."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ugr_lightning.contract import CAMERAS, STATE_DIM
from ugr_lightning.data.folder import episode_path
from ugr_lightning.data.formats.robotwin import write_episode
from ugr_lightning.data.recorded_arrays import CAMERA_PARAMETERS

TASK = "click_alarmclock"
DIFFERENT = 4


def write_made_up(
    folder: Path, index: int, steps: int, image_size: tuple[int, int], cameras: Sequence[str] = CAMERAS
) -> Path:
    """Write a demonstration of smooth random pictures, whose JPEGs are as costly as those of a scene.

    Args:
        folder: of the recording.
        index: number of the demonstration, and seed of its content.
        steps: control steps.
        image_size: (H, W).
        cameras: names of the V cameras.

    Returns:
        The file.
    """
    generator = np.random.default_rng(index)
    height, width = image_size
    blocks = steps + 1, len(cameras), -(-height // 8), -(-width // 8), 3
    images = generator.integers(256, size=blocks, dtype=np.uint8).repeat(8, axis=2).repeat(8, axis=3)
    joints = generator.standard_normal((steps + 1, STATE_DIM)).astype(np.float32)
    camera = {key: np.eye(*shape) for key, shape in CAMERA_PARAMETERS.items()}
    path = episode_path(folder, index)
    write_episode(
        path,
        images=images[:, :, :height, :width],  # (steps + 1, V, H, W, 3)
        commanded=joints,
        measured=joints,
        endpose=np.zeros((steps + 1, 2, 7)),
        contacts=np.zeros((steps + 1, 2), bool),
        expert_action=joints[1:],
        phase=["bench"] * steps,
        slack=np.zeros(steps, np.float32),
        camera_parameters=dict.fromkeys(cameras, camera),
        task=TASK,
        setting="demo_clean",
        seed=index,
        control_hz=25.0,
        cameras=cameras,
    )
    return path


def write_many(folder: Path, count: int, steps: int, image_size: tuple[int, int], cameras: Sequence[str]) -> None:
    """Write demonstrations of which a few differ; the others are hard links to these and take no room.

    Args:
        folder: of the recording.
        count: how many.
        steps: control steps of each.
        image_size: (H, W).
        cameras: names of the cameras.
    """
    written = [write_made_up(folder, index, steps, image_size, cameras) for index in range(min(count, DIFFERENT))]
    for index in range(len(written), count):
        episode_path(folder, index).hardlink_to(written[index % DIFFERENT])
