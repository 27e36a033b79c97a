"""Trajectories of ManiSkill's `RecordEpisode` wrapper: one HDF5 file of many episodes, one JSON file beside it.

A trajectory of T steps has T actions and T + 1 observations, the first of them from the reset; the last is dropped,
because nothing was done in it. Joints are measured ones: ManiSkill does not record what was commanded before. What it
observed beside them (`obs/extra`: poses, goals, flags) can be picked into the state by name, such as `tcp_pose_0`.
"""

import json
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import Contents, EpisodeFormat, EpisodeLocation
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout, policy_cameras
from ugr_lightning.data.storage.hdf5 import FIX, has_key, list_keys, open_hdf5, read_array
from ugr_lightning.data.storage.hdf5_frames import colour_cameras, hdf5_frames
from ugr_lightning.errors import DataError

TRAJECTORY = re.compile(r"traj_(\d+)")
ABSOLUTE = "pd_joint_pos"  # the control mode whose actions are absolute joint targets
QPOS, EXTRA, CAMERAS = "obs/agent/qpos", "obs/extra", "obs/sensor_data"
REPLAY = "python -m mani_skill.trajectory.replay_trajectory --traj-path {path} --save-traj"
MAX_JSON_BYTES = 2**26


class ManiSkill(EpisodeFormat):
    """Episodes with pictures and absolute joint targets, as `RecordEpisode` writes them.

    Several files in a folder are read one after the other in the order of their names; a file can also be given alone.
    """

    name = "maniskill"
    marks = "a file .h5 with groups `traj_<number>` of `actions`"

    def recognises(self, folder: Path) -> bool:
        """Whether one of the files has trajectories."""
        return any(_trajectories(path) for path in _files(folder))

    def find(self, folder: Path) -> dict[int, EpisodeLocation]:
        """The trajectories by their number in a single file; counted through where there are several files.

        Where some files can be trained on, those that cannot are passed over: ManiSkill's replay leaves what it
        translated beside its translation.
        """
        files = [path for path in _files(folder) if _trajectories(path)]
        files = [path for path in files if _is_trainable(path)] or files
        found: dict[int, EpisodeLocation] = {}
        for path in files:
            about = _episodes_of(path)
            for number in _trajectories(path):
                index = number if len(files) == 1 else len(found)
                seed = about.get(number, {}).get("episode_seed")
                found[index] = EpisodeLocation(path, f"traj_{number}", seed=seed if isinstance(seed, int) else None)
        return found

    def strays(self, folder: Path) -> list[Path]:
        """Files without trajectories, or damaged ones."""
        return [path for path in _files(folder) if not _trajectories(path)]

    def peek(self, location: EpisodeLocation) -> Contents:
        """The cameras by the names they have, and the joints by position."""
        with open_hdf5(location.path) as file:
            cameras, others = _find_cameras(file, location)
            state = read_array(file, f"{location.key}/{QPOS}", (None, None))
            action = read_array(file, f"{location.key}/actions", (None, None))
            further = _read_further(file, f"{location.key}", len(state))[1]
        joints, commands = (tuple(map(str, range(values.shape[1]))) for values in (state, action))
        return Contents(policy_cameras(cameras), joints, commands, others, further)

    def read(self, location: EpisodeLocation, cameras: Sequence[str], layout: Layout = DEFAULT_LAYOUT) -> Episode:
        """Check one trajectory; observation t is step t, labelled `actions[t]`."""
        path, key = location.path, f"{location.key}"
        about = _about(location)
        with open_hdf5(path) as file:
            views = layout.find_cameras(cameras, sum(map(tuple, _find_cameras(file, location)), ()), path)
            action = read_array(file, f"{key}/actions", (None, None))
            steps, where = len(action), f"{path}:{key}/actions"
            if steps < 1 or about.get("elapsed_steps", steps) != steps:
                expected = f"{about.get('elapsed_steps', 'at least 1')} rows, as {_json_path(path).name} says"
                raise DataError(where, expected, steps, FIX)
            seen, names = read_array(file, f"{key}/{QPOS}", (steps + 1, None)), tuple[str, ...]()
            if layout.width("state") is None:
                further, names = _read_further(file, key, steps + 1)
                names = (*map(str, range(seen.shape[1])), *names)
                seen = np.concatenate([seen, further], axis=1)  # (T + 1, D)
            frames = hdf5_frames(file, tuple(f"{key}/{CAMERAS}/{view}/rgb" for view in views), steps + 1)
            extras = _read_extras(file, key, steps, about)
        state = layout.take(seen[:-1], "state", names, f"{path}:{key}/{QPOS}")
        return Episode(
            path=path,
            cameras=tuple(cameras),
            state=state,
            action=layout.take(action, "action", (), where),
            frames=frames,
            measured=state,
            seed=location.seed,
            extras=extras,
            label=f"{path.stem}-{key}",
        )


def _files(folder: Path) -> list[Path]:
    folder = Path(folder)
    return [folder] if folder.is_file() else sorted(folder.glob("*.h5"))


def _trajectories(path: Path) -> list[int]:
    """The numbers of a file's trajectories, in order; none in a file of another kind or a damaged one."""
    try:
        with open_hdf5(path) as file:
            numbers = [int(match[1]) for match in map(TRAJECTORY.fullmatch, map(str, file)) if match]
            return sorted(n for n in numbers if has_key(file, f"traj_{n}/actions"))
    except DataError:
        return []


def _find_cameras(file: h5py.File, location: EpisodeLocation) -> tuple[tuple[str, ...], dict[str, str]]:
    """The cameras of a trajectory that give colour pictures, and what the others give."""
    key = f"{location.key}/{CAMERAS}"
    cameras, others = colour_cameras(file, {name: f"{key}/{name}/rgb" for name in list_keys(file, key)})
    if not cameras or not has_key(file, f"{location.key}/{QPOS}"):
        there = list_keys(file, f"{location.key}/obs") or list_keys(file, f"{location.key}")
        expected = f"joints at {QPOS} and pictures at {CAMERAS}/<camera>/rgb"
        fix = f"Record them: {REPLAY.format(path=location.path)} -o rgb"
        raise DataError(f"{location.path}:{location.key}", expected, f"only {', '.join(there) or 'nothing'}", fix)
    return cameras, others


def _read_further(file: h5py.File, key: str, rows: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """What was observed beside the joints, (T + 1, D) float32, and the names of the columns; numbers and flags only."""
    arrays, names = [np.zeros((rows, 0), np.float32)], list[str]()
    for name in list_keys(file, f"{key}/{EXTRA}"):
        found = file[f"{key}/{EXTRA}/{name}"]
        shape = {1: (rows,), 2: (rows, None)}.get(len(getattr(found, "shape", None) or ()))
        if shape is None or found.dtype.kind not in "bfiu":
            continue
        kind = "b" if found.dtype.kind == "b" else "f"
        values = read_array(file, f"{key}/{EXTRA}/{name}", shape, kind).reshape(rows, -1)  # (T + 1, d)
        arrays.append(values.astype(np.float32))
        names += [name] if len(shape) == 1 else [f"{name}_{column}" for column in range(values.shape[1])]
    return np.concatenate(arrays, axis=1), tuple(names)


def _is_trainable(path: Path) -> bool:
    """Whether the first trajectory of a file has pictures, joints and absolute joint targets."""
    location = EpisodeLocation(path, f"traj_{_trajectories(path)[0]}")
    try:
        _about(location)
        with open_hdf5(path) as file:
            return bool(_find_cameras(file, location))
    except DataError:
        return False


def _about(location: EpisodeLocation) -> dict[str, Any]:
    """What the JSON file says of a trajectory, checked for the control mode."""
    path = location.path
    about = _episodes_of(path).get(int(str(location.key).removeprefix("traj_")))
    if about is None:
        raise DataError(_json_path(path), f"an entry of {location.key}", "none", "Record the episodes again.")
    if about.get("control_mode") != ABSOLUTE:
        expected = f"actions that are absolute joint targets, control mode {ABSOLUTE!r}"
        fix = f"Translate them: {REPLAY.format(path=path)} -o rgb -c {ABSOLUTE}"
        raise DataError(f"{path}:{location.key}", expected, repr(about.get("control_mode"))[:80], fix)
    return about


def _read_extras(file: h5py.File, key: str, steps: int, about: dict[str, Any]) -> dict[str, Any]:
    extras = {"control_mode": about["control_mode"], "environment": about.get("environment")}
    if has_key(file, f"{key}/success"):
        extras["success"] = read_array(file, f"{key}/success", (steps,), kind="b")
    return {name: value for name, value in extras.items() if value is not None}


def _json_path(path: Path) -> Path:
    return path.with_suffix(".json")


def _episodes_of(path: Path) -> dict[int, dict[str, Any]]:
    """Entries of the JSON file beside an HDF5 file, by number of the trajectory."""
    beside = _json_path(path)
    if not beside.is_file():
        raise DataError(beside, "the JSON file beside the trajectories", "no such file", "Copy it there, too.")
    return _parse(beside, beside.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _parse(path: Path, changed_ns: int) -> dict[int, dict[str, Any]]:
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes")
        content = json.loads(path.read_text())
        environment = (content.get("env_info") or {}).get("env_id")
        about = {episode["episode_id"]: {**episode, "environment": environment} for episode in content["episodes"]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        got = f"{type(error).__name__}: {error}"[:120]
        raise DataError(path, "JSON with an entry for every episode", got, "Record the episodes again.") from error
    if not all(isinstance(number, int) for number in about):
        raise DataError(path, "episodes with numbers", list(about)[:3], "Record the episodes again.")
    return about
