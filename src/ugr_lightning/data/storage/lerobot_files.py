"""Writing a LeRobotDataset v3.0: one table and one video per camera for each episode, then what describes them."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.storage.tables import import_pyarrow, read_table
from ugr_lightning.data.storage.video import import_av, write_videos
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.system.files import publish, publish_text

INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES_PATH, DATA_PATH = f"meta/episodes/{PLACE}.parquet", f"data/{PLACE}.parquet"
VIDEO_PATH = "videos/{video_key}/" + PLACE + ".mp4"
STATE, ACTION, CAMERA = "observation.state", "action", "observation.images."
CHUNK = 1000  # files in a folder
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SAMPLED = 100  # pictures of an episode that its statistics are taken from
SAMPLED_SIDE = 150  # pixels a side, about, that are looked at


def write_dataset(folder: Path, episodes: Sequence[Episode], done: Callable[[int], None] = lambda index: None) -> None:
    """Write episodes as a dataset that lerobot reads.

    Every episode has files of its own, and its row in `meta/episodes` comes last: stopped at any time, the next call
    goes on with the first episode without one. `meta/info.json` comes last of all. State and action stay exact,
    pictures become H.264. What lerobot has no place for is left out: measured joints, seeds, contacts, phases.

    Args:
        folder: where to; a new folder, or one that a call with the same episodes was stopped in.
        episodes: what to write, with the same cameras and dimensions.
        done: called with the index of every episode that is on disk.

    Raises:
        DataError: episodes that differ, that do not say their rate, or a folder with another dataset.
        ConfigError: pyarrow or PyAV is not installed, or there is nothing to write.
    """
    rate, features = check_episodes(episodes)
    tasks = list(dict.fromkeys(map(_task, episodes)))
    starts = np.cumsum([0] + [episode.length for episode in episodes])
    info = _info(features, rate, len(episodes), int(starts[-1]), len(tasks))
    if (folder / INFO).exists():
        _check_same(folder / INFO, info)
    for index, episode in enumerate(episodes):
        if not (folder / _path(EPISODES_PATH, index)).exists():
            task = tasks.index(_task(episode))
            _write_episode(folder, index, episode, int(starts[index]), rate, task)
            episode.frames.close()
        done(index)
    _write_json(folder / STATS, _all_statistics(folder, list(features), len(episodes)))
    pandas_index = {"task_index": list(range(len(tasks))), "task": tasks}
    publish(folder / TASKS, lambda partial: _write_table(partial, pandas_index, index_column="task"))
    _write_json(folder / INFO, info)


def check_episodes(episodes: Sequence[Episode]) -> tuple[int, dict[str, dict[str, Any]]]:
    """Find out whether episodes can be a dataset.

    Args:
        episodes: what is to be written.

    Returns:
        Their steps per second, and what every row has, in lerobot's words.

    Raises:
        DataError: episodes that differ, or that do not say one rate in whole steps per second.
        ConfigError: pyarrow or PyAV is not installed, or there is nothing to write.
    """
    import_pyarrow(), import_av()
    if not episodes:
        raise ConfigError("episodes", "at least one", "none", "Choose some.")
    return _rate(episodes), _features(episodes)


def _path(pattern: str, index: int, key: str = "") -> str:
    return pattern.format(video_key=key, chunk_index=index // CHUNK, file_index=index % CHUNK)


def _rate(episodes: Sequence[Episode]) -> int:
    said = {episode.extras.get("control_hz") for episode in episodes}
    rate = next(iter(said))
    if len(said) > 1 or not isinstance(rate, (int, float)) or rate < 1 or rate != int(rate):
        expected, fix = "episodes that say one rate in whole steps per second", "State it with `--rate`."
        raise DataError(episodes[0].path.parent, expected, " and ".join(sorted(map(str, said))), fix)
    return int(rate)


def _task(episode: Episode) -> str:
    """What the robot is told to do, in words."""
    task = episode.extras.get("instruction") or str(episode.extras.get("task", "")).replace("_", " ")
    return str(task) or "unspecified"


def _features(episodes: Sequence[Episode]) -> dict[str, dict[str, Any]]:
    """What every row has, in lerobot's words."""
    first = episodes[0]
    for episode in episodes:
        expected, got = ((one.cameras, one.frames.image_sizes) for one in (first, episode))
        if expected != got:
            raise DataError(episode.path, f"cameras as in {first.path.name}, {expected}", got, "Separate them.")
        shapes = [(one.state.shape[1], one.action.shape[1]) for one in (first, episode)]
        if shapes[0] != shapes[1]:
            raise DataError(episode.path, f"{shapes[0]} joints as in {first.path.name}", shapes[1], "Separate them.")
    features: dict[str, dict[str, Any]] = {}
    for key, width in ((STATE, first.state.shape[1]), (ACTION, first.action.shape[1])):
        names = [f"motor_{number}" for number in range(width)]
        features[key] = {"dtype": "float32", "shape": [width], "names": names}
    for camera, size in zip(first.cameras, first.frames.image_sizes, strict=True):
        shape = [*size, 3]
        features[CAMERA + camera] = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    return features | {key: {"dtype": "int64", "shape": [1], "names": None} for key in COUNTERS}


def _info(features: dict[str, dict[str, Any]], fps: int, episodes: int, frames: int, tasks: int) -> dict[str, Any]:
    videos = {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            height, width = feature["shape"][:2]
            pixels = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"
            about = {"video.height": height, "video.width": width, "video.codec": "h264", "video.pix_fmt": pixels}
            about |= {"video.is_depth_map": False, "video.fps": fps, "video.channels": 3, "has_audio": False}
            videos[key] = feature | {"info": about}
    return {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": features | videos,
    }


def _check_same(path: Path, info: dict[str, Any]) -> None:
    """A finished dataset may only be the one that is to be written."""
    try:
        same = json.loads(path.read_text()) == info
    except (OSError, ValueError, RecursionError):
        same = False
    if not same:
        raise DataError(path, "no dataset, or the same one", "another", "Choose an empty folder.")


def _write_episode(folder: Path, index: int, episode: Episode, start: int, fps: int, task: int) -> None:
    """The videos, the table and then the description of one episode."""
    keys = [CAMERA + camera for camera in episode.cameras]
    sampled: list[list[np.ndarray]] = []
    paths = [folder / _path(VIDEO_PATH, index, key) for key in keys]
    _publish_all(paths, lambda partials: write_videos(partials, _pictures(episode, sampled), fps))
    length = episode.length
    columns: dict[str, np.ndarray] = {STATE: episode.state, ACTION: episode.action}
    columns["timestamp"] = (np.arange(length) / fps).astype(np.float32)
    counters = (np.arange(length), np.full(length, index), np.arange(start, start + length), np.full(length, task))
    columns |= dict(zip(COUNTERS, counters, strict=True))
    publish(folder / _path(DATA_PATH, index), lambda partial: _write_table(partial, columns))
    chunk, number = divmod(index, CHUNK)
    about: dict[str, Any] = {"episode_index": index, "tasks": [_task(episode)], "length": length}
    about |= {"data/chunk_index": chunk, "data/file_index": number}
    about |= {"dataset_from_index": start, "dataset_to_index": start + length}
    for key in keys:
        about |= {f"videos/{key}/chunk_index": chunk, f"videos/{key}/file_index": number}
        about |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": length / fps}
    statistics = {key: summarise(values.reshape(length, -1)) for key, values in columns.items()}
    for key, views in zip(keys, zip(*sampled, strict=True), strict=True):  # by camera, P of (h, w, 3)
        found = summarise(np.stack(views).reshape(-1, 3) / 255)
        statistics[key] = {name: value.reshape(3, 1, 1) for name, value in found.items() if name != "count"}
        statistics[key]["count"] = np.array([len(views)])
    for key, values in statistics.items():
        about |= {f"stats/{key}/{name}": value.tolist() for name, value in values.items()}
    about |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": number}
    row = {name: [value] for name, value in about.items()}
    publish(folder / _path(EPISODES_PATH, index), lambda partial: _write_table(partial, row))


def _pictures(episode: Episode, sampled: list[list[np.ndarray]]) -> Iterator[list[np.ndarray]]:
    """The pictures of all steps, V of (H, W, 3) each; some pixels of some of them are kept for statistics."""
    chosen = set(np.linspace(0, episode.length - 1, min(SAMPLED, episode.length)).round().astype(int).tolist())
    stride = max(1, max(episode.image_size) // SAMPLED_SIDE)
    for step in range(episode.length):
        pictures = episode.frames.pictures(step)
        if step in chosen:
            sampled.append([picture[::stride, ::stride].copy() for picture in pictures])
        yield pictures


def summarise(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of (N, D) values by column, as lerobot keeps them for each episode.

    Returns:
        min, max, mean, std and the quantiles q01 to q99, (D,) float64 each; count, (1,).
    """
    values = values.astype(np.float64)
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)  # (5, D)
    return found | dict(zip(QUANTILES, quantiles, strict=True)) | {"count": np.array([len(values)])}


def pool(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Statistics of several episodes together: exact, but for the quantiles, which are means weighted by length."""
    counts = np.array([part["count"][0] for part in parts], np.float64)
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0] if name != "count"}

    def weighted(values: np.ndarray) -> np.ndarray:
        return np.tensordot(counts / counts.sum(), values, axes=1)

    mean = weighted(stacked["mean"])
    variance = weighted(stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)
    found = {"min": stacked["min"].min(0), "max": stacked["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
    found |= {name: weighted(stacked[name]) for name in QUANTILES}
    return found | {"count": np.array([int(counts.sum())])}


def _all_statistics(folder: Path, keys: Sequence[str], count: int) -> dict[str, dict[str, Any]]:
    """Statistics of the dataset from those of the episodes on disk."""
    names = ["min", "max", "mean", "std", "count", *QUANTILES]
    parts: dict[str, list[dict[str, np.ndarray]]] = {key: [] for key in keys}
    for index in range(count):
        path = folder / _path(EPISODES_PATH, index)
        row = read_table(path, [f"stats/{key}/{name}" for key in keys for name in names]).to_pylist()[0]
        for key in keys:
            parts[key].append({name: np.array(row[f"stats/{key}/{name}"]) for name in names})
    pooled = {key: pool(episodes) for key, episodes in parts.items()}
    return {key: {name: value.tolist() for name, value in values.items()} for key, values in pooled.items()}


def _write_table(path: Path, columns: dict[str, Any], index_column: str | None = None) -> None:
    """Write columns to a Parquet file; rows of a matrix become lists of fixed length, one column becomes numbers."""
    pyarrow = import_pyarrow()
    arrays = {}
    for name, values in columns.items():
        if isinstance(values, np.ndarray) and values.ndim == 2 and values.shape[1] > 1:
            flat = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
            arrays[name] = pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])
        else:
            arrays[name] = pyarrow.array(np.ravel(values) if isinstance(values, np.ndarray) else values)
    table = pyarrow.table(arrays)
    if index_column is not None:  # what pandas, with which lerobot reads this table, takes for the index of the rows
        table = table.replace_schema_metadata({"pandas": json.dumps(_pandas_metadata(table, index_column))})
    pyarrow.parquet.write_table(table, path)


def _pandas_metadata(table: Any, index_column: str) -> dict[str, Any]:
    kinds = {
        name: "int64" if str(table.schema.field(name).type) == "int64" else "unicode" for name in table.column_names
    }
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": "int64" if kind == "int64" else "object"}
        | {"metadata": None}
        for name, kind in kinds.items()
    ]
    return {"index_columns": [index_column], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}


def _publish_all(
    paths: Sequence[Path], write: Callable[[Sequence[Path]], None], partials: tuple[Path, ...] = ()
) -> None:
    """`publish` for files that have to be written side by side."""
    if not paths:
        write(partials)
        return
    publish(paths[0], lambda partial: _publish_all(paths[1:], write, (*partials, partial)))


def _write_json(path: Path, content: object) -> None:
    publish_text(path, json.dumps(content, indent=4) + "\n")
