"""One demonstration: its numbers in memory, its frames on disk until somebody asks."""

import os
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.hdf5 import FIX
from ugr_lightning.data.jpeg import decode_jpeg
from ugr_lightning.errors import ConfigError, DataError


class FrameSource(ABC):
    """Where the pictures of an episode come from.

    Args:
        image_size: stored (height, width) in pixels.
    """

    image_size: tuple[int, int]

    @abstractmethod
    def read(self, step: int, out: np.ndarray) -> None:
        """Write the pictures of one step into `out`, (V, H, W, 3) uint8 RGB, contiguous."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the file; reading again opens it again."""


class JpegFrames(FrameSource):
    """JPEG frames in an HDF5 file, one dataset per camera.

    The file is opened at the first read in each process: an HDF5 handle survives neither a fork nor pickling.

    Args:
        path: the file.
        keys: one dataset of JPEG bytes per camera.
        image_size: (height, width) that every frame has.
    """

    def __init__(self, path: Path, keys: tuple[str, ...], image_size: tuple[int, int]) -> None:
        self.path, self.keys, self.image_size = path, keys, image_size
        self._opened: tuple[int, h5py.File, list[h5py.Dataset]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    def _datasets(self) -> list[h5py.Dataset]:
        if self._opened is None or self._opened[0] != os.getpid():
            file = h5py.File(self.path, "r")
            self._opened = (os.getpid(), file, [file[key] for key in self.keys])
        return self._opened[2]

    def encoded(self, step: int) -> tuple[bytes, ...]:
        """The JPEG bytes of one step, one item per camera.

        Raises:
            DataError: the file changed or became unreadable after it was checked.
        """
        try:
            return tuple(bytes(dataset[step]) for dataset in self._datasets())
        except (OSError, RuntimeError, KeyError, ValueError, IndexError) as error:
            raise DataError(f"{self.path}[{step}]", "a stored frame", f"a read error ({error})", FIX) from error

    def read(self, step: int, out: np.ndarray) -> None:
        """Decode one step into `out`.

        Raises:
            DataError: a frame that is no JPEG of the episode's size.
        """
        for key, data, picture in zip(self.keys, self.encoded(step), out, strict=True):
            try:
                decode_jpeg(data, picture)
            except ValueError as error:
                size = "x".join(map(str, self.image_size))
                raise DataError(f"{self.path}:{key}[{step}]", f"a JPEG of {size}", str(error), FIX) from error

    def close(self) -> None:
        """Close the file; the next read opens it again."""
        if self._opened is not None and self._opened[0] == os.getpid():
            self._opened[1].close()
        self._opened = None


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
    """

    path: Path
    cameras: tuple[str, ...]
    state: np.ndarray
    action: np.ndarray
    frames: FrameSource
    measured: np.ndarray | None = None
    seed: int | None = None
    extras: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """File name without its ending, e.g. `episode7`."""
        return self.path.stem

    @property
    def length(self) -> int:
        """Number of decision steps T."""
        return len(self.state)

    @property
    def image_size(self) -> tuple[int, int]:
        """Stored (height, width) in pixels."""
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
