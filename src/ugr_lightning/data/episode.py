"""One demonstration: its numbers in memory, its frames on disk until somebody asks."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.data.storage.frames import FrameSource
from ugr_lightning.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Episode:
    """One validated demonstration of T decision steps.

    `action[t]` is what the expert commands while it sees `state[t]` and `images(t)`: the label of step t.

    Args:
        path: the file it came from.
        cameras: camera names in the order of the images.
        state: (T, S) float32, commanded joints in force at each step, robot units.
        action: (T, A) float32, robot units.
        frames: where the pictures are.
        measured: (T, S) float32, measured joints; None where a format does not have them.
        seed: simulator seed, None where unknown.
        extras: further arrays and attributes of the file (contacts, phase, slack, task, control_hz).
        label: its name where the file holds several episodes.
        projection: (T, V, 3, 4) float32, see `embodiment.image_projection`; None without calibrated cameras.
        endpose: (T + 1, 2, 7) tool poses of the left and right arm before each step and at the end, x y z qw qx qy qz
            in the world, without noise on the commands where a file tells them so; None where a format has none.
    """

    path: Path
    cameras: tuple[str, ...]
    state: np.ndarray
    action: np.ndarray
    frames: FrameSource
    measured: np.ndarray | None = None
    seed: int | None = None
    extras: dict[str, Any] = field(default_factory=dict)
    label: str | None = None
    projection: np.ndarray | None = None
    endpose: np.ndarray | None = None

    @property
    def name(self) -> str:
        """What tells it from the others of its folder: the file's name without its ending, e.g. `episode7`."""
        return self.label or self.path.stem

    @property
    def length(self) -> int:
        """Number of decision steps T."""
        return len(self.state)

    @property
    def image_size(self) -> tuple[int, int]:
        """Stored (height, width) in pixels; the largest that all cameras have where they differ."""
        return self.frames.image_size

    def images(self, step: int) -> np.ndarray:
        """The pictures seen at one step.

        Returns:
            (V, H, W, 3) uint8 RGB.
        """
        out = np.empty((len(self.cameras), *self.image_size, 3), np.uint8)
        self.frames.read(step, out)
        return out

    def proprioception(self, kind: str) -> np.ndarray:
        """The joints that a policy sees as its state.

        Args:
            kind: `commanded` or `measured`.

        Returns:
            (T, S) float32.

        Raises:
            ConfigError: the file has no measured joints.
        """
        if kind == "commanded":
            return self.state
        if kind == "measured" and self.measured is not None:
            return self.measured
        raise ConfigError(f"data.state for {self.path}", "`commanded`, or `measured` where it was recorded", kind,
                          "Use `--data.state commanded`.")  # fmt: skip
