"""The kinds of demonstrations on disk: one file here per format, each found by listing this folder."""

import importlib
import inspect
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import ClassVar

import h5py

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.folder import find_episodes, hdf5_files, numbered_files
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout
from ugr_lightning.data.storage.hdf5 import open_hdf5, write_hdf5
from ugr_lightning.errors import ConfigError, DataError

RECORDED = "robotwin"  # the format that we record in
PEEKED = 8  # files of a folder that are looked into to recognise it


@dataclass(frozen=True)
class EpisodeLocation:
    """Where one episode is.

    Args:
        path: its file.
        key: its group in a file of several episodes; None where the file is the episode.
        rows: first and past-the-last row in a table of several episodes; None for all of them.
        seed: simulator seed where the folder says it.
        tasks: what was done in it, where the folder says that of each episode.
    """

    path: Path
    key: str | None = None
    rows: tuple[int, int] | None = None
    seed: int | None = None
    tasks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contents:
    """What an episode holds, as the file says it.

    Args:
        cameras: all cameras, by the names that `data.cameras` takes.
        state: name of each column of the joint vector; positions as text where the file gives no names.
        action: the same for commands.
        others: cameras without colour pictures, such as depth, and what they have instead.
        further: more columns that `data.layout.state` can pick by these names.
    """

    cameras: tuple[str, ...]
    state: tuple[str, ...]
    action: tuple[str, ...]
    others: Mapping[str, str] = field(default_factory=dict)
    further: tuple[str, ...] = ()

    @property
    def layout(self) -> Layout:
        """The layout that takes every column as it is."""
        return Layout(state=len(self.state), action=len(self.action))


class EpisodeFormat(ABC):
    """One way to keep demonstrations on disk.

    `read` gives every format the same meaning: `action[t]` is the absolute command of step t, labelled t.
    """

    name: ClassVar[str]
    marks: ClassVar[str]
    """What `recognises` looks for, in words, for the error of `detect`."""

    @property
    def writable(self) -> bool:
        """Whether `write` does anything else than refuse."""
        return type(self).write is not EpisodeFormat.write

    @abstractmethod
    def recognises(self, folder: Path) -> bool:
        """Whether the folder holds this format, by content and never by its name; False for anything unreadable."""

    @abstractmethod
    def find(self, folder: Path) -> dict[int, EpisodeLocation]:
        """Where the episodes are, by index, in order.

        Raises:
            DataError: the folder contradicts itself.
        """

    def strays(self, folder: Path) -> list[Path]:
        """Files that lie among the episodes and that `find` takes for none."""
        return []

    @abstractmethod
    def peek(self, location: EpisodeLocation) -> Contents:
        """The cameras and columns of an episode.

        Raises:
            DataError: the file is damaged or of another kind.
        """

    @abstractmethod
    def read(self, location: EpisodeLocation, cameras: Sequence[str], layout: Layout = DEFAULT_LAYOUT) -> Episode:
        """Check one episode completely and return it with its frames still on disk.

        Args:
            location: from `find`.
            cameras: the policy's names, in the order wanted.
            layout: which cameras and joints of the file those are.

        Raises:
            DataError: anything missing, damaged, foreign, or of another shape, type or length; names file and key.
            ConfigError: a camera that the file does not have.
        """

    def check(self, episodes: Sequence[Episode]) -> None:  # noqa: B027 - a format may hold every episode
        """Find out whether `write` can write these episodes; it begins with this, before it touches anything.

        Raises:
            DataError: an episode that the format cannot hold; says why.
            ConfigError: a package is missing.
        """

    def write(
        self, folder: Path, episodes: Sequence[Episode], done: Callable[[int], None] = lambda index: None
    ) -> None:
        """Write episodes, numbered from 0, each complete or absent; those that are already there stay as they are.

        Args:
            folder: where to.
            episodes: what to write, with the same cameras and dimensions.
            done: called with the index of every episode that is on disk.

        Raises:
            ConfigError: this format is only read, or a package is missing.
            DataError: an episode that the format cannot hold; says why.
        """
        raise ConfigError("--to", "a format that can be written", self.name, "Choose another.")


class NumberedFiles(EpisodeFormat):
    """A format with one HDF5 file per episode, see `folder.numbered_files` for their names.

    The files are in the folder itself or in its subfolder `data`; a single file, under any name, is a folder of one.
    """

    @property
    def writable(self) -> bool:
        """Whether `fill` does anything else than refuse."""
        return type(self).fill is not NumberedFiles.fill

    @abstractmethod
    def matches(self, file: h5py.File) -> bool:
        """Whether an open file is of this format."""

    def recognises(self, folder: Path) -> bool:
        try:
            paths = list(episode_files(folder).values())[:PEEKED]
        except DataError:
            return False
        return any(self._is_one(path) for path in paths)

    def find(self, folder: Path) -> dict[int, EpisodeLocation]:
        return {index: EpisodeLocation(path) for index, path in episode_files(folder).items()}

    def strays(self, folder: Path) -> list[Path]:
        """HDF5 files that are not named as the episodes beside them are."""
        episodes = set(episode_files(folder).values())
        return [path for path in (*hdf5_files(folder / "data"), *hdf5_files(folder)) if path not in episodes]

    def write(
        self, folder: Path, episodes: Sequence[Episode], done: Callable[[int], None] = lambda index: None
    ) -> None:
        """Write one file per episode, see `EpisodeFormat.write`."""
        self.check(episodes)
        others = [one.name for one in recognise(folder) if one.name != self.name]
        if others:
            fix = "Choose an empty folder."
            raise DataError(folder, f"a folder for {self.name}", f"demonstrations of {others[0]}", fix)
        for index, episode in enumerate(episodes):
            path = self.episode_file(Path(folder), index)
            if not path.exists():
                write_hdf5(path, partial(self.fill, episode=episode))
                episode.frames.close()
            done(index)

    def episode_file(self, folder: Path, index: int) -> Path:
        """Where an episode is written."""
        return folder / f"episode_{index}.hdf5"

    def fill(self, file: h5py.File, episode: Episode) -> None:
        """Write one episode, which was checked, into an open, empty file.

        Raises:
            ConfigError: this format is only read.
        """
        raise ConfigError("--to", "a format that can be written", self.name, "Choose another.")

    def _is_one(self, path: Path) -> bool:
        try:
            with open_hdf5(path) as file:
                return self.matches(file)
        except DataError:
            return False


def episode_files(folder: Path) -> dict[int, Path]:
    """The numbered files of a folder, or of its subfolder `data`, by index; a single file is episode 0.

    Raises:
        DataError: two files claim the same index.
    """
    folder = Path(folder)
    if folder.is_file():
        return {0: folder}
    return find_episodes(folder) or numbered_files(folder)


@cache
def formats() -> tuple[EpisodeFormat, ...]:
    """Every format of this folder, sorted by name."""
    found: list[EpisodeFormat] = []
    for module in pkgutil.iter_modules(__path__, f"{__name__}."):
        for item in vars(importlib.import_module(module.name)).values():
            ours = inspect.isclass(item) and item.__module__ == module.name and issubclass(item, EpisodeFormat)
            if ours and not inspect.isabstract(item):
                found.append(item())
    return tuple(sorted(found, key=lambda one: one.name))


def find_format(name: str) -> EpisodeFormat:
    """The format of a name.

    Raises:
        ConfigError: there is no such format.
    """
    named = {one.name: one for one in formats()}
    if name not in named:
        raise ConfigError("format", "one of " + ", ".join(named), name, "Correct the name.")
    return named[name]


def recognise(folder: Path) -> list[EpisodeFormat]:
    """The formats that a folder could be of; none where nothing is there or everything is damaged."""
    return [one for one in formats() if one.recognises(Path(folder))]


def detect(folder: Path) -> EpisodeFormat:
    """The format of a folder of demonstrations.

    Raises:
        DataError: nothing is there, no format recognises it, or several do.
    """
    folder = Path(folder)
    if not folder.exists():
        raise DataError(folder, "demonstrations", "nothing there", "Check the path, or record with `ugr collect`.")
    found = recognise(folder)
    if len(found) == 1:
        return found[0]
    if found:
        got = f"marks of {' and '.join(one.name for one in found)}"
        raise DataError(folder, "demonstrations of one format", got, "Give each format a folder of its own.")
    expected = "one of the formats " + "; ".join(f"{one.name} ({one.marks})" for one in formats())
    raise DataError(folder, expected, _what_is_there(folder), "Check the path, or record with `ugr collect`.")


def _what_is_there(folder: Path) -> str:
    for path in episode_files(folder).values():
        try:
            with open_hdf5(path) as file:
                return f"{path.name} with the keys {', '.join(list(map(str, file))[:8]) or 'none'}"
        except DataError as error:
            return f"{path.name}, {error.got}"
    names = sorted(path.name for path in folder.iterdir())
    return ", ".join(names[:6]) + " ..." * (len(names) > 6) or "an empty folder"
