"""LeRobotDataset v3.0: joints in Parquet tables, pictures in videos or in the tables, several episodes per file.

`meta/info.json` says what there is, `meta/episodes/*/*.parquet` in which file and at which time each episode is. An
action is the command of its own row. Needs the extra `lerobot` (pyarrow, av).
"""

import json
import re
import string
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import Contents, EpisodeFormat, EpisodeLocation
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout, policy_cameras
from ugr_lightning.data.storage.frames import FrameSource, SeveralSources
from ugr_lightning.data.storage.lerobot_files import ACTION, CAMERA, INFO, STATE, check_episodes, write_dataset
from ugr_lightning.data.storage.tables import TablePictures, column_values, finite_rows, read_table
from ugr_lightning.data.storage.video import VideoFrames, View, check_video
from ugr_lightning.errors import DataError

FIX = "Copy the dataset again."
UPGRADE = (
    "Convert it with lerobot: `python -m lerobot.datasets.v30.convert_dataset_v21_to_v30 --repo-id=NAME` "
    "(from lerobot 0.5: `python -m lerobot.scripts.convert_dataset_v21_to_v30`)."
)
MAX_JSON_BYTES = 2**24
MAX_HZ = 10_000
MAX_PATTERN = 300
PLACES = ("video_key", "chunk_index", "file_index")
PLACES_OF_EPISODES = ("episode_index", "length", "tasks", "data/chunk_index", "data/file_index")
PLACE_OF_VIDEO = re.compile(r"videos/.+/(chunk_index|file_index|from_timestamp)")
WIDTH = re.compile(r"(0?\d{1,2})?d?")  # how a number in a file name is written, e.g. 03d


class LeRobot(EpisodeFormat):
    """Datasets of lerobot from 0.4 on, read and written.

    Cameras are called what follows `observation.images.`. Read with pictures in the tables, the encoded pictures of
    every episode that is in use are in memory; with videos, nothing is.
    """

    name = "lerobot"
    marks = "`meta/info.json` with `codebase_version` and `features`"

    def recognises(self, folder: Path) -> bool:
        """Whether its description is one of lerobot's, of any version."""
        try:
            return {"codebase_version", "features"} <= set(_read_json(_home(Path(folder)) / INFO))
        except DataError:
            return False

    def find(self, folder: Path) -> dict[int, EpisodeLocation]:
        """The row of each episode in the tables of `meta/episodes`, and its tasks."""
        root = _home(Path(folder))
        total = _Info.read(root).total_episodes
        found: dict[int, EpisodeLocation] = {}
        for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
            table = _cached(_read_places, path)
            indices = column_values(table, "episode_index", path)
            tasks = table.column("tasks").to_pylist() if "tasks" in table.column_names else [None] * len(indices)
            for row, (index, done) in enumerate(zip(map(int, indices), tasks, strict=True)):
                if index in found:
                    got = f"another in {found[index].path.name}"
                    raise DataError(path, f"one row for episode {index}", got, FIX)
                found[index] = EpisodeLocation(
                    path, f"episode {index}", (row, row + 1), tasks=tuple(map(str, done or ()))
                )
        if total is not None and len(found) != total:
            raise DataError(root / INFO, f"{len(found)} episodes, as in meta/episodes", total, FIX)
        return dict(sorted(found.items()))

    def peek(self, location: EpisodeLocation) -> Contents:
        """The cameras by the last part of their names, and the joints by theirs."""
        info = _Info.read(_root(location.path))
        state, action = (info.columns(key) or tuple(map(str, range(info.width(key)))) for key in (STATE, ACTION))
        return Contents(policy_cameras(tuple(_short(info.cameras))), state, action, info.others)

    def read(self, location: EpisodeLocation, cameras: Sequence[str], layout: Layout = DEFAULT_LAYOUT) -> Episode:
        """Check one episode; row t of it is step t, labelled `action[t]`."""
        info = _Info.read(_root(location.path))
        short = _short(info.cameras)
        views = layout.find_cameras(cameras, tuple(short), info.root)
        keys = [short.get(view, view) for view in views]
        about = info.episode(location, keys)
        path, index = info.data_file(about), int(about["episode_index"])
        columns = _cached(_read_numbers, path)
        first, last = _find_rows(columns["episode_index"], path, index, int(about["length"]))
        times = _check_times(columns, path, info.fps, first, last)
        vectors = {}
        for vector, key in (("state", STATE), ("action", ACTION)):
            vectors[vector] = finite_rows(columns[key][first:last], f"{path}:{key}", first)
        state = layout.take(vectors["state"], "state", info.columns(STATE), f"{path}:{STATE}")
        action = layout.take(vectors["action"], "action", info.columns(ACTION), f"{path}:{ACTION}")
        extras = {"control_hz": info.fps, **({"instruction": about["tasks"][0]} if about.get("tasks") else {})}
        return Episode(
            path=path,
            cameras=tuple(cameras),
            state=state,
            action=action,
            frames=_find_frames(info, about, keys, path, (first, last), times),
            seed=location.seed,
            extras=extras,
            label=f"episode{index}",
        )

    def check(self, episodes: Sequence[Episode]) -> None:
        check_episodes(episodes)

    def write(
        self, folder: Path, episodes: Sequence[Episode], done: Callable[[int], None] = lambda index: None
    ) -> None:
        write_dataset(Path(folder), episodes, done)


@dataclass(frozen=True)
class _Info:
    """What `meta/info.json` says, checked.

    Args:
        root: folder of the dataset.
        fps: frames per second.
        features: what every row has, by name.
        data_path, video_path: patterns of file names under the root.
        total_episodes: how many there are; None where it does not say.
    """

    root: Path
    fps: float
    features: Mapping[str, Mapping[str, Any]]
    data_path: str
    video_path: str | None
    total_episodes: int | None

    @classmethod
    def read(cls, root: Path) -> "_Info":
        """Read and check it.

        Raises:
            DataError: damaged, of another version, or without joints and commands.
        """
        where = root / INFO
        content = _read_json(where)
        version = str(content.get("codebase_version"))[:40]
        if version.startswith(("v1.", "v2.")):
            raise DataError(f"{where}:codebase_version", "v3.0", version, UPGRADE)
        if not version.startswith("v3."):
            raise DataError(f"{where}:codebase_version", "v3.0", version, "Update ugr-lightning.")
        features, fps, total = content.get("features"), content.get("fps"), content.get("total_episodes")
        if not isinstance(features, dict) or not all(map(_is_feature, features.values())):
            raise DataError(f"{where}:features", "names with `dtype` and `shape`", str(features)[:80], FIX)
        if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps <= MAX_HZ:
            raise DataError(f"{where}:fps", "frames per second", str(fps)[:40], FIX)
        for key in (STATE, ACTION):
            if key not in features or len(features[key]["shape"]) != 1:
                expected = f"a vector `{key}`"
                raise DataError(f"{where}:features", expected, ", ".join(features)[:120] or "nothing", FIX)
        data, video = content.get("data_path"), content.get("video_path")
        if not isinstance(data, str) or not isinstance(video, (str, type(None))):
            raise DataError(where, "`data_path` and `video_path`", f"{data!r}, {video!r}"[:120], FIX)
        return cls(root, float(fps), features, data, video, total if isinstance(total, int) else None)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The features that are colour pictures."""
        return tuple(
            key
            for key, feature in self.features.items()
            if feature["dtype"] in ("video", "image") and not _is_depth(feature)
        )

    @property
    def others(self) -> dict[str, str]:
        """The features that are pictures without colour, by the last part of their names."""
        return {
            name: "depth"
            for name, key in _short(tuple(self.features)).items()
            if self.features[key]["dtype"] in ("video", "image") and _is_depth(self.features[key])
        }

    def width(self, key: str) -> int:
        """Length of a vector."""
        return int(self.features[key]["shape"][0])

    def columns(self, key: str) -> tuple[str, ...]:
        """The names of a vector's numbers; empty where they are not given one by one."""
        names = self.features[key].get("names")
        if isinstance(names, dict):  # {"motors": [...]}
            names = [name for group in names.values() if isinstance(group, list) for name in group]
        if isinstance(names, list) and len(names) == self.width(key) and len(set(map(str, names))) == len(names):
            return tuple(map(str, names))
        return ()

    def episode(self, location: EpisodeLocation, keys: Sequence[str]) -> dict[str, Any]:
        """The row of `meta/episodes` that describes an episode, with the places of these cameras."""
        names = ["episode_index", "length", "data/chunk_index", "data/file_index"]
        for key in keys:
            if self.features[key]["dtype"] == "video":
                names += [f"videos/{key}/{part}" for part in ("chunk_index", "file_index", "from_timestamp")]
        table, (first, last) = _cached(_read_places, location.path), location.rows or (0, 0)
        missing = [name for name in names if name not in table.column_names]
        if missing or last > len(table):
            got = f"no {', '.join(missing) or location.key} among {', '.join(table.column_names[:12])}"
            raise DataError(location.path, "the places of each episode", got, FIX)
        row: dict[str, Any] = table.slice(first, 1).to_pylist()[0]
        wrong = [name for name in names if not _is_place(row[name])]
        if wrong or row["length"] < 1:
            got = f"{wrong or ['length']}: {row[(wrong or ['length'])[0]]!r}"[:120]
            raise DataError(f"{location.path}:{location.key}", "numbers that say where the episode is", got, FIX)
        return row

    def data_file(self, about: Mapping[str, Any]) -> Path:
        """The table an episode is in."""
        return self._file(self.data_path, about["data/chunk_index"], about["data/file_index"])

    def video_file(self, about: Mapping[str, Any], key: str) -> Path:
        """The video an episode's pictures of a camera are in."""
        if self.video_path is None:
            raise DataError(f"{self.root / INFO}:video_path", "a pattern, as there are videos", None, FIX)
        chunk, number = (about[f"videos/{key}/{part}"] for part in ("chunk_index", "file_index"))
        return self._file(self.video_path, chunk, number, key)

    def _file(self, pattern: str, chunk: float, number: float, key: str = "") -> Path:
        try:
            fields = [(name, spec or "") for _, name, spec, _ in string.Formatter().parse(pattern) if name is not None]
            if len(pattern) > MAX_PATTERN or not all(n in PLACES and WIDTH.fullmatch(spec) for n, spec in fields):
                raise ValueError(pattern)
            name = pattern.format(video_key=key, chunk_index=int(chunk), file_index=int(number))
        except (KeyError, IndexError, ValueError, AttributeError) as error:
            raise DataError(self.root / INFO, "patterns of file names", f"{pattern!r}"[:120], FIX) from error
        inside = Path(name)  # by its words: the hub's cache has links to elsewhere in the place of files
        if "\0" in name or len(name) > 1000 or inside.is_absolute() or ".." in inside.parts:
            raise DataError(self.root / INFO, "files inside the dataset", f"{name!r}"[:120], FIX)
        return self.root / name


def _read_json(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes")
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            raise ValueError(type(content).__name__)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, "a JSON object", str(error)[:120], FIX) from error
    return content


def _is_feature(feature: object) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        return False
    shape = feature.get("shape")
    return isinstance(shape, list) and all(type(size) is int and size > 0 for size in shape)


def _is_depth(feature: Mapping[str, Any]) -> bool:
    places = [feature.get("info"), feature.get("video_info")]
    return any(
        bool(place.get(name))
        for place in places
        if isinstance(place, dict)
        for name in ("is_depth_map", "video.is_depth_map")
    )


def _is_place(value: object) -> bool:
    return isinstance(value, (int, float)) and bool(np.isfinite(value)) and 0 <= value < 2**31


def _short(features: Sequence[str]) -> dict[str, str]:
    """Names of features without what all cameras' begin with: their whole names."""
    return {key.removeprefix(CAMERA) if key.startswith(CAMERA) else key.rsplit(".", 1)[-1]: key for key in features}


def _home(folder: Path) -> Path:
    """The folder with `meta`: the one given, or what a repository's folder of the hub's cache has as its newest.

    A cache keeps a folder of links for each revision, `snapshots/<revision>`, and in `refs/main` which is the newest.
    """
    snapshots = folder / "snapshots"
    if (folder / INFO).exists() or not snapshots.is_dir():
        return folder
    newest = folder / "refs" / "main"
    if newest.is_file() and (snapshots / newest.read_text().strip() / INFO).exists():
        return snapshots / newest.read_text().strip()
    whole = [path for path in snapshots.iterdir() if (path / INFO).exists()]
    return max(whole, key=lambda path: path.stat().st_mtime, default=folder)


def _root(path: Path) -> Path:
    """The folder of the dataset that a file of `meta/episodes` belongs to."""
    return path.parents[3]


def _read_places(path: Path) -> Any:
    """What `meta/episodes` says of places, lengths and tasks; the statistics beside it are hundreds of columns."""
    table = read_table(path, lambda name: name in PLACES_OF_EPISODES or bool(PLACE_OF_VIDEO.fullmatch(name)))
    if "episode_index" not in table.column_names:
        raise DataError(path, "the column `episode_index`", "none", FIX)
    return table


def _read_numbers(path: Path) -> dict[str, np.ndarray]:
    """The numbers of all episodes of a table, by column."""
    names = ("episode_index", "frame_index", "timestamp", STATE, ACTION)
    table = read_table(path, names)
    return {name: column_values(table, name, path) for name in names}


def _cached(read: Callable[[Path], Any], path: Path) -> Any:
    """What was read of a file, once for the many episodes in it, until the file changes."""
    stat = path.stat() if path.is_file() else None
    return _cache(read, path, stat and (stat.st_size, stat.st_mtime_ns))


@lru_cache(maxsize=8)
def _cache(read: Callable[[Path], Any], path: Path, stamp: object) -> Any:
    return read(path)


def _find_rows(indices: np.ndarray, path: Path, index: int, length: int) -> tuple[int, int]:
    """First and past-the-last row of an episode in its table."""
    rows = np.flatnonzero(indices == index)
    if len(rows) != length or rows[-1] - rows[0] != length - 1:
        got = f"{len(rows)} rows" + ("" if len(rows) != length else " with others between them")
        raise DataError(f"{path}:episode_index", f"{length} rows of episode {index}", got, FIX)
    return int(rows[0]), int(rows[-1]) + 1


def _check_times(columns: Mapping[str, np.ndarray], path: Path, fps: float, first: int, last: int) -> np.ndarray:
    """The time of each row, (T,) float64 in s; rows have to be in order, a frame apart."""
    length, numbers = last - first, columns["frame_index"][first:last]
    if not np.array_equal(numbers, np.arange(length)):
        raise DataError(f"{path}:frame_index", f"0 to {length - 1}", numbers[:5].tolist(), FIX)
    times = columns["timestamp"][first:last].astype(np.float64)
    off = np.abs(times - np.arange(length) / fps)
    if times.shape != (length,) or not (off < 0.25 / fps).all():
        got = f"{times[int(np.argmax(off))] if times.shape == (length,) else times.shape}"
        raise DataError(f"{path}:timestamp", f"rows that are 1/{fps:g} s apart", got, FIX)
    return times


def _find_frames(
    info: _Info, about: Mapping[str, Any], keys: Sequence[str], path: Path, rows: tuple[int, int], times: np.ndarray
) -> FrameSource:
    """Videos or pictures in the table, checked."""
    kinds = {info.features[key]["dtype"] for key in keys}
    if kinds == {"image"}:
        return TablePictures(path, keys, rows)
    views = {key: _find_view(info, about, key, times[-1]) for key in keys if info.features[key]["dtype"] == "video"}
    sizes = {check_video(view.path)[0] for view in views.values()}
    if len(kinds) == len(sizes) == 1:
        return VideoFrames(list(views.values()), times, info.fps, sizes.pop())
    return SeveralSources(
        [
            VideoFrames([views[key]], times, info.fps, check_video(views[key].path)[0])
            if key in views
            else TablePictures(path, [key], rows)
            for key in keys
        ]
    )


def _find_view(info: _Info, about: Mapping[str, Any], key: str, end_of_episode: float) -> View:
    """Where a camera's pictures are, checked against what `info.json` says and the episode's length."""
    view = View(info.video_file(about, key), key, float(about[f"videos/{key}/from_timestamp"]))
    size, end = check_video(view.path)
    shape = info.features[key]["shape"]
    if len(shape) != 3 or size not in ((shape[0], shape[1]), (shape[1], shape[2])):
        raise DataError(view.path, f"pictures of {shape}, as info.json says", size, FIX)
    if view.start + end_of_episode > end - 0.25 / info.fps:
        raise DataError(view.path, f"a video longer than {view.start + end_of_episode:.3f} s", f"{end:.3f} s", FIX)
    return view
