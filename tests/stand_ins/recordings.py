"""Made-up demonstrations of the two arms, written as our own recordings are."""

import numpy as np

from ugr_lightning.data.folder import episode_path, write_seeds
from ugr_lightning.data.formats.robotwin import write_episode
from ugr_lightning.embodiment import CAMERAS


def arrays(steps=12, seed=0, size=(24, 32), **changes):
    """Keyword arguments of `write_episode`, drawn by `seed`; changes replace single ones."""
    rng = np.random.default_rng(seed)
    shades = rng.integers(40, 215, size=(steps + 1, 3, 1, 1, 3))
    ramp = np.linspace(-20, 20, size[1])[:, None] + np.linspace(-15, 15, size[0])[:, None, None]
    camera = {"intrinsic_cv": np.eye(3) * 30, "extrinsic_cv": np.eye(3, 4), "cam2world_gl": np.eye(4)}
    given = {
        "images": np.clip(shades + ramp, 0, 255).astype(np.uint8),  # smooth, and their red and blue differ
        "commanded": rng.normal(size=(steps + 1, 14)).astype(np.float32),
        "measured": rng.normal(size=(steps + 1, 14)).astype(np.float32),
        "endpose": rng.normal(size=(steps + 1, 2, 7)),
        "contacts": rng.random((steps + 1, 2)) < 0.5,
        "expert_action": rng.normal(size=(steps, 14)).astype(np.float32),
        "phase": ["reach"] * (steps - 1) + ["press"],
        "slack": rng.random(steps).astype(np.float32),
        "camera_parameters": dict.fromkeys(CAMERAS, camera),
        "task": "click_alarmclock",
        "setting": "demo_clean",
        "seed": seed,
        "control_hz": 25.0,
        "noise": {"std": 0.03},
    }
    return given | changes


def record(root, count=5, steps=7, longer=3, task="click_alarmclock", first_draw=0, **options):
    """Records episodes under a root, each by some steps longer than the one before it; returns their folder."""
    folder = root / task / "demo_clean"
    for index in range(count):
        given = arrays(steps + longer * index, first_draw + index, **options)
        write_episode(episode_path(folder, index), **given | {"seed": index})
    write_seeds(folder, range(count))
    return folder


def prepared(data):
    """A data module as a trainer leaves it before the first batch."""
    data.prepare_data()
    data.setup("fit")
    return data
