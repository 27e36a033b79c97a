"""Where the pictures of an episode come from: decoded or copied one step at a time, never all at once."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

MAX_PIXELS = 4096  # a side of a picture that comes from elsewhere


class FrameSource(ABC):
    """Where the pictures of an episode come from.

    Args:
        image_size: stored (height, width) in pixels, of every camera.
        keys: where each camera's pictures are, in words of the format.
    """

    image_size: tuple[int, int]
    keys: tuple[str, ...]

    @abstractmethod
    def read(self, step: int, out: np.ndarray) -> None:
        """Write the pictures of one step into `out`, (V, H, W, 3) uint8 RGB, contiguous.

        Raises:
            DataError: a damaged picture, one of another size, or a file that changed after it was checked.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the file; reading again opens it again."""

    def jpegs(self, step: int) -> tuple[bytes, ...] | None:
        """The JPEGs that decode to exactly the pictures of one step, one per camera; None where there are none."""
        return None

    @property
    def image_sizes(self) -> tuple[tuple[int, int], ...]:
        """Stored (height, width) of each camera."""
        return (self.image_size,) * len(self.keys)

    def pictures(self, step: int) -> list[np.ndarray]:
        """The pictures of one step at the sizes they have, V of (H, W, 3) uint8 RGB."""
        out = np.empty((len(self.keys), *self.image_size, 3), np.uint8)  # (V, H, W, 3)
        self.read(step, out)
        return list(out)

    @property
    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """The files that the pictures are in."""


class SeveralSources(FrameSource):
    """Cameras that differ in size or in how they are stored, each from a source of its own.

    `image_size` is the largest that all cameras have; `read` shrinks what is larger than asked for.

    Args:
        sources: one per camera.
    """

    def __init__(self, sources: Sequence[FrameSource]) -> None:
        self.sources = tuple(sources)
        self.keys = tuple(key for source in sources for key in source.keys)
        heights, widths = zip(*(source.image_size for source in sources), strict=True)
        self.image_size = (min(heights), min(widths))

    @property
    def image_sizes(self) -> tuple[tuple[int, int], ...]:
        return tuple(source.image_size for source in self.sources)

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(dict.fromkeys(path for source in self.sources for path in source.files))

    def pictures(self, step: int) -> list[np.ndarray]:
        return [picture for source in self.sources for picture in source.pictures(step)]

    def jpegs(self, step: int) -> tuple[bytes, ...] | None:
        kept = [source.jpegs(step) for source in self.sources]
        return None if any(one is None for one in kept) else tuple(jpeg for one in kept for jpeg in one or ())

    def read(self, step: int, out: np.ndarray) -> None:
        for picture, row in zip(self.pictures(step), out, strict=True):
            shrink(picture, row)

    def close(self) -> None:
        for source in self.sources:
            source.close()


def shrink(picture: np.ndarray, out: np.ndarray) -> None:
    """Write a picture (H, W, 3) uint8 into `out`; a smaller size averages the area of each new pixel."""
    if picture.shape == out.shape:
        out[:] = picture
    else:
        out[:] = np.asarray(Image.fromarray(picture).resize(out.shape[1::-1], Image.Resampling.BOX))
