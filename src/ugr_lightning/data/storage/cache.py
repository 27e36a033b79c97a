"""Decoded frames: in memory, in a file that is mapped into memory, or decoded each time they are asked for."""

import hashlib
import json
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.storage.frames import shrink
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.system.files import publish
from ugr_lightning.system.limits import available_memory, usable_cores
from ugr_lightning.system.lock import locked
from ugr_lightning.system.progress import Progress

Cache = Literal["ram", "memmap", "none"]
OPEN_EPISODES = 64
"""Files that `none` keeps open; systems allow 256 (macOS) or 1024 in all."""
SHOWN_SIZES = 3  # of pictures, in an error


class FrameStore(ABC):
    """The pictures of all frames of a data set, in the order of `sampling.Frames`."""

    @abstractmethod
    def take(self, frames: np.ndarray) -> np.ndarray:
        """The pictures of some frames, (B,) -> (B, V, H, W, 3) uint8 RGB, a fresh contiguous array."""


class ArrayStore(FrameStore):
    """Frames in one array, or in a file mapped into memory that every process maps for itself.

    Args:
        array: (N, V, H, W, 3) uint8.
        path: the file it is mapped from; None when it is plain memory.
    """

    def __init__(self, array: np.ndarray, path: Path | None = None) -> None:
        self.array, self.path = array, path

    def __getstate__(self) -> dict[str, Any]:
        return {"array": self.array if self.path is None else None, "path": self.path}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.array, self.path = state["array"], state["path"]
        if self.path is not None:
            self.array = np.load(self.path, mmap_mode="r")

    def take(self, frames: np.ndarray) -> np.ndarray:
        return np.take(np.asarray(self.array), frames, axis=0)  # (B, V, H, W, 3)


class FileStore(FrameStore):
    """Frames decoded from the episode files each time; those read last stay open, so many that each process may.

    Args:
        episodes: demonstrations with the same cameras.
        image_size: (height, width) to deliver.
    """

    def __init__(self, episodes: Sequence[Episode], image_size: tuple[int, int]) -> None:
        self.episodes, self.image_size = list(episodes), image_size
        self.ends = np.cumsum([episode.length for episode in episodes])
        self._open: dict[int, None] = {}  # episodes, the one read last at the end

    def take(self, frames: np.ndarray) -> np.ndarray:
        out = np.empty((len(frames), len(self.episodes[0].cameras), *self.image_size, 3), np.uint8)
        for row, frame in zip(out, frames, strict=True):
            index = int(np.searchsorted(self.ends, frame, side="right"))
            episode = self._opened(index)
            read_resized(episode, int(frame - self.ends[index]) + episode.length, row)
        return out

    def _opened(self, index: int) -> Episode:
        self._open.pop(index, None)
        self._open[index] = None
        if len(self._open) > OPEN_EPISODES:
            longest_unused = next(iter(self._open))
            del self._open[longest_unused]
            self.episodes[longest_unused].frames.close()
        return self.episodes[index]


def read_resized(episode: Episode, step: int, out: np.ndarray) -> None:
    """Decode one step into `out`, (V, H, W, 3); a smaller size averages the area of each new pixel."""
    if out.shape[1:3] == episode.image_size:
        episode.frames.read(step, out)
        return
    for picture, row in zip(episode.frames.pictures(step), out, strict=True):
        shrink(picture, row)


def open_frames(
    episodes: Sequence[Episode], cache: Cache, image_size: tuple[int, int] | None = None, folder: Path | None = None
) -> FrameStore:
    """Make the frames of some episodes available.

    Args:
        episodes: demonstrations, all with the same cameras.
        cache: `ram` decodes once per run, `memmap` once for all runs and processes, `none` whenever a frame is used.
        image_size: (height, width) to shrink to; None for the stored size, which all pictures then have to share.
        folder: where a `memmap` goes, into a subfolder `.cache`; None for where our recordings have it.

    Raises:
        DataError: a frame that is no JPEG, a folder that cannot be written to.
        ConfigError: no size where pictures differ in theirs, one larger than a stored one, or more frames than memory
            or disk can hold.
    """
    size = _choose_size(episodes, image_size)
    shape = (sum(episode.length for episode in episodes), len(episodes[0].cameras), *size, 3)
    if cache == "none":
        return FileStore(episodes, size)
    if cache == "ram":
        fix = "Use `--data.cache memmap`, or `none`."
        _require_space(shape, available_memory(), "memory", fix)
        try:
            array = np.empty(shape, np.uint8)
        except MemoryError as error:  # a limit that the system does not tell, such as `ulimit -v`
            raise ConfigError("data.cache", "frames that fit into memory", error, fix) from error
        _decode_all(episodes, array)
        return ArrayStore(array)
    if cache == "memmap":
        home = folder or episodes[0].path.parent.parent
        return _open_memmap(episodes, shape, (home if home.is_dir() else home.parent) / ".cache")
    raise ConfigError("data.cache", "`ram`, `memmap` or `none`", cache, "Correct the name.")


def _choose_size(episodes: Sequence[Episode], wanted: tuple[int, int] | None) -> tuple[int, int]:
    """(height, width) of the pictures to deliver: the one wanted, or the one that every picture has."""
    sizes: dict[tuple[int, int], str] = {}  # and where each is found first
    for episode in episodes:
        for camera, (height, width) in zip(episode.cameras, episode.frames.image_sizes, strict=True):
            sizes.setdefault((height, width), f"{height}x{width} in {camera} of {episode.name} ({episode.path})")
    stored = (min(height for height, _ in sizes), min(width for _, width in sizes))
    if wanted is None and len(sizes) > 1:
        got = ", ".join(list(sizes.values())[:SHOWN_SIZES]) + " ..." * (len(sizes) > SHOWN_SIZES)
        fix = f"Give all pictures one: `--data.image_size [{stored[0]},{stored[1]}]`."
        raise ConfigError("data.image_size", "a size, as the pictures differ in theirs", got, fix)
    size = stored if wanted is None else (wanted[0], wanted[1])
    if not (1 <= size[0] <= stored[0] and 1 <= size[1] <= stored[1]):
        fix = "Choose a smaller size, or record larger pictures."
        raise ConfigError("data.image_size", f"at most the stored size {stored}", size, fix)
    return size


def _open_memmap(episodes: Sequence[Episode], shape: tuple[int, ...], folder: Path) -> FrameStore:
    """Map the decoded frames beside the episodes; decode them first when missing or made from other files."""
    names = [[episode.path.name, episode.name, list(episode.frames.keys)] for episode in episodes]
    what = [names, list(episodes[0].cameras), list(shape)]
    files = [path.stat() for episode in episodes for path in episode.frames.files]
    sources = [[file.st_size, file.st_mtime_ns] for file in files]
    name = f"frames-{_digest(what)}"
    path = folder / f"{name}-{_digest(sources)}.npy"
    if not path.is_file():
        try:
            folder.mkdir(exist_ok=True)
            with locked(folder / f"{name}.lock", f"Decoded frames in {folder}", wait=True):
                if not path.is_file():  # or another process has made it meanwhile
                    for stale in folder.glob(f"{name}-*"):
                        stale.unlink()
                    _write_memmap(episodes, shape, path)
        except OSError as error:
            fix = "Use `--data.cache ram`, or `none`."
            raise DataError(folder, "a folder that decoded frames can be written to", error, fix) from error
    try:
        array = np.load(path, mmap_mode="r")
    except (OSError, EOFError, ValueError) as error:
        raise DataError(path, f"frames {shape}", str(error), "Remove the file; it is made again.") from error
    if array.shape != shape or array.dtype != np.uint8:
        raise DataError(path, f"frames {shape}", array.shape, "Remove the file; it is made again.")
    return ArrayStore(array, path)


def _write_memmap(episodes: Sequence[Episode], shape: tuple[int, ...], path: Path) -> None:
    fix = "Free some space, or use `--data.cache none`."
    _require_space(shape, shutil.disk_usage(path.parent).free, "disk", fix)

    def write(partial: Path) -> None:
        array = np.lib.format.open_memmap(partial, mode="w+", dtype=np.uint8, shape=shape)
        if hasattr(os, "posix_fallocate"):  # a disk that runs full is an error now, and not a bus error later
            with partial.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, partial.stat().st_size)
        _decode_all(episodes, array)
        array.flush()

    publish(path, write)


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]


def _decode_all(episodes: Sequence[Episode], out: np.ndarray) -> None:
    """Decode every decision step into `out`, (N, V, H, W, 3), one thread per core."""
    starts = np.concatenate([[0], np.cumsum([episode.length for episode in episodes])])

    def decode(index: int) -> None:
        episode = episodes[index]
        for step in range(episode.length):
            read_resized(episode, step, out[starts[index] + step])
        episode.frames.close()

    title = f"Decoding episodes into {out.nbytes / 1e9:.2f} GB"
    with ThreadPoolExecutor(usable_cores()) as pool, Progress(title, len(episodes)) as line:
        for _ in pool.map(decode, range(len(episodes))):
            line.advance()


def _require_space(shape: tuple[int, ...], free: int | None, what: str, fix: str) -> None:
    need = int(np.prod(shape, dtype=np.int64))
    if free is not None and need > 0.9 * free:
        raise ConfigError(
            "data.cache", f"frames that fit into {free / 1e9:.1f} GB of {what}", f"{need / 1e9:.1f} GB", fix
        )
