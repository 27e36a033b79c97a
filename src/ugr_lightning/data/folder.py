"""The folder of one recording, `<root>/<task>/<setting>`: episode files and the lists beside them."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.errors import DataError
from ugr_lightning.system.files import publish_text

MAX_DIGITS = 18  # of a seed
OURS, ENDINGS = "episode", (".hdf5", ".h5")
NUMBERED = re.compile(r"(.*?)[_-]?(\d{1,18})")  # the stem of a file name: what it is, and its number


def episode_path(folder: Path, index: int) -> Path:
    """Where episode `index` belongs."""
    return Path(folder) / "data" / f"episode{index}.hdf5"


def find_episodes(folder: Path) -> dict[int, Path]:
    """The episodes present, by index, in order; see `numbered_files`."""
    return numbered_files(Path(folder) / "data")


def hdf5_files(folder: Path) -> list[Path]:
    """The HDF5 files of a folder in the order of their names; unfinished ones (`.partial`) are none."""
    return sorted((path for path in Path(folder).glob("*") if path.suffix in ENDINGS), key=lambda path: path.name)


def numbered_files(folder: Path) -> dict[int, Path]:
    """The episode files of a folder, by index, in order.

    `episode7.hdf5`, `episode_0000007.hdf5`, `demo_7.h5`: the number at the end counts. Where there are such with
    `episode`, these are the episodes, else those of one name that are more than half of all files. Where no name has so
    many, all files are episodes, counted in the order of their names.

    Raises:
        DataError: two files claim the same index.
    """
    files = hdf5_files(folder)
    numbers = {path: match for path in files if (match := NUMBERED.fullmatch(path.stem))}
    called = Counter(match[1] for match in numbers.values())
    name = OURS if OURS in called else max(called, key=called.__getitem__, default="")
    if name != OURS and called[name] <= len(files) / 2:
        return dict(enumerate(files))
    numbers = {path: match for path, match in numbers.items() if match[1] == name}
    found: dict[int, Path] = {}
    for path, match in numbers.items():
        index = int(match[2])
        if index in found:
            got = f"{found[index].name} and {path.name}"
            fix = "The number at the end of a name counts: move one of the two elsewhere, or rename it."
            raise DataError(path.parent, f"one file for episode {index}", got, fix)
        found[index] = path
    return dict(sorted(found.items()))


def write_seeds(folder: Path, seeds: Sequence[int]) -> None:
    """Write `seed.txt`: the simulator seed of every episode, by index, separated by spaces."""
    text = " ".join(str(int(seed)) for seed in seeds)
    publish_text(Path(folder) / "seed.txt", text + "\n")


def read_seeds(folder: Path) -> list[int]:
    """The seeds in `seed.txt`; empty where there is none.

    Raises:
        DataError: something in it is not a whole number.
    """
    path = Path(folder) / "seed.txt"
    if not path.is_file():
        return []
    words = path.read_text(errors="replace").split()
    wrong = [word for word in words if not word.isdecimal() or len(word) > MAX_DIGITS]
    if wrong:
        raise DataError(path, "whole numbers separated by spaces", wrong[0][:40], "Restore or remove the file.")
    return [int(word) for word in words]


def write_scene_info(folder: Path, scenes: Mapping[int, Mapping[str, Any]]) -> None:
    """Write `scene_info.json`: by `episode_<index>`, what the scene looked like at reset."""
    content = {f"episode_{index}": scenes[index] for index in sorted(scenes)}
    _publish_json(Path(folder) / "scene_info.json", content)


def read_scene_info(folder: Path) -> dict[int, dict[str, Any]]:
    """The content of `scene_info.json` by episode index; empty where there is none.

    Raises:
        DataError: not JSON of that kind.
    """
    path = Path(folder) / "scene_info.json"
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text())
        return {int(name.removeprefix("episode_")): dict(scene) for name, scene in content.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise DataError(path, "JSON by `episode_<index>`", str(error), "Restore or remove the file.") from error


def write_instructions(folder: Path, index: int, seen: Sequence[str]) -> None:
    """Write `instructions/episode<index>.json`: what the robot is told to do, in words."""
    path = Path(folder) / "instructions" / f"episode{index}.json"
    _publish_json(path, {"seen": list(seen), "unseen": []})


def _publish_json(path: Path, content: object) -> None:
    publish_text(path, json.dumps(content, indent=2, default=_plain) + "\n")


def _plain(value: object) -> object:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
