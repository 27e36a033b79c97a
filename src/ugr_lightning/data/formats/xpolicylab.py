"""XPolicyLab's trajectory v1.0, as RoboTwin's collector and its converter write it.

The two differ in what this reader does not need (the key of the extrinsics, a joint vector besides the arms) and in how
they spell instructions. Both store actions that are already the next state. The number `frequency` is kept as it is: in
RoboTwin's files it counts simulation steps between frames and is no rate.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import Contents, EpisodeLocation, NumberedFiles
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout, policy_cameras
from ugr_lightning.data.storage.hdf5 import FIX, find_dataset, has_key, list_keys, open_hdf5, read_array, read_texts
from ugr_lightning.data.storage.hdf5_frames import colour_cameras, hdf5_frames
from ugr_lightning.errors import DataError

VERSION = "v1.0"
PARTS = {  # of the joint vector, in our order: the file's key, and what we call a column of it
    "left_arm_joint_states": "left_joint",
    "left_ee_joint_states": "left_gripper",
    "right_arm_joint_states": "right_joint",
    "right_ee_joint_states": "right_gripper",
    "arm_joint_states": "joint",
    "ee_joint_states": "gripper",
}
PHYSICS_HZ = 250.0  # RoboTwin's simulation steps per second

Alignment = Literal["next_state", "same_index", "commanded", "without_actions"]


class XPolicyLab(NumberedFiles):
    """Trajectories with state and action per arm, and one group per camera.

    What `action[t]` becomes depends on what the file's row t holds, see `extras["action_alignment"]`:
    `next_state` and `commanded` are taken as they are; where a converter was told to repeat the state (`same_index`),
    and where there are only states (`without_actions`), the next state is the command and the last row is dropped.
    """

    name = "xpolicylab"
    marks = "`vision/<camera>/colors`, `state/*_joint_states`"

    def matches(self, file: h5py.File) -> bool:
        return bool(list_keys(file, "vision")) and any(has_key(file, f"state/{part}") for part in PARTS)

    def peek(self, location: EpisodeLocation) -> Contents:
        """The cameras by our names, and the joints as left_joint_1 .. right_gripper, or joint_1 .. gripper."""
        with open_hdf5(location.path) as file:
            _, names = _read_joints(file, "state", None)
            keys = {name: f"vision/{name}/colors" for name in list_keys(file, "vision")}
            cameras, others = colour_cameras(file, keys)
            return Contents(policy_cameras(cameras), names, names, others)

    def read(self, location: EpisodeLocation, cameras: Sequence[str], layout: Layout = DEFAULT_LAYOUT) -> Episode:
        """Check one file; see the class for what becomes the action of a step."""
        path = location.path
        meta = _read_meta(path)
        with open_hdf5(path) as file:
            _check_version(file)
            views = layout.find_cameras(cameras, list_keys(file, "vision"), path)
            state, names = _read_joints(file, "state", None)
            rows = len(state)
            action = _read_joints(file, "action", rows)[0] if list_keys(file, "action") else None
            alignment = _alignment(path, state, action, meta.get("action_alignment"))
            frames = hdf5_frames(file, tuple(f"vision/{view}/colors" for view in views), rows)
            extras = {"action_alignment": alignment, **_read_extras(file, meta)}
        if alignment in ("same_index", "without_actions"):
            state, action = state[:-1], state[1:]
        if action is None or not len(state):
            raise DataError(f"{path}:state", "at least 2 rows", rows, FIX)
        return Episode(
            path=path,
            cameras=tuple(cameras),
            state=layout.take(state, "state", names, f"{path}:state"),
            action=layout.take(action, "action", names, f"{path}:action"),
            frames=frames,
            seed=location.seed,
            extras=extras,
        )


def _check_version(file: h5py.File) -> None:
    if has_key(file, "data_format_version"):
        found = read_texts(file, "data_format_version")
        if found != (VERSION,):
            where = f"{file.filename}:data_format_version"
            raise DataError(where, VERSION, ", ".join(found)[:80] or "nothing", "Update ugr-lightning.")


def _read_joints(file: h5py.File, group: str, rows: int | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """The parts of a joint vector side by side, (T, D) float32, and the names of the columns."""
    present = [part for part in PARTS if has_key(file, f"{group}/{part}")]
    if not present:
        got = f"only {', '.join(list_keys(file, group)[:8]) or 'nothing'}"
        raise DataError(f"{file.filename}:{group}", f"one of {', '.join(PARTS)}", got, FIX)
    arrays: list[np.ndarray] = []
    names: list[str] = []
    for part in present:
        values = read_array(file, f"{group}/{part}", (rows, None))  # (T, D of the part)
        rows, name, width = len(values), PARTS[part], values.shape[1]
        numbered = name.endswith("joint") or width > 1
        names += [f"{name}_{i}" for i in range(1, width + 1)] if numbered else [name] * width
        arrays.append(values)
    if not rows:
        raise DataError(f"{file.filename}:{group}/{present[0]}", "at least 1 row", 0, FIX)
    return np.concatenate(arrays, axis=1), tuple(names)


def _alignment(path: Path, state: np.ndarray, action: np.ndarray | None, said: object) -> Alignment:
    """What the rows of `action` are; what `conversion_meta.json` says is checked against them."""
    if action is None:
        return "without_actions"
    if action.shape != state.shape:
        got = f"{action.shape[1]} columns"
        raise DataError(f"{path}:action", f"the {state.shape[1]} columns of state", got, FIX)
    still = bool((state == state[:1]).all())
    repeats, leads = np.array_equal(action, state), np.array_equal(action[:-1], state[1:])
    found: Alignment = "same_index" if repeats and not still else "next_state" if leads else "commanded"
    names: dict[object, Alignment] = {"same_index": "same_index", "next_state_as_action": "next_state"}
    if said is None:
        return found
    if names.get(said) != found and not still:
        where, got = f"{path}:action", f"rows that are {found}"
        raise DataError(where, f"what conversion_meta.json says, {said!r}"[:120], got, "Convert the episodes again.")
    return names.get(said, found)


def _read_extras(file: h5py.File, meta: dict[str, Any]) -> dict[str, Any]:
    """Instructions in either spelling, and the frequency; a rate where it is known what the frequency means."""
    extras: dict[str, Any] = {}
    if has_key(file, "instructions"):
        extras["instructions"] = _unpack(read_texts(file, "instructions"))
    if has_key(file, "instruction"):
        extras["instruction"] = " ".join(read_texts(file, "instruction"))
    elif extras.get("instructions"):
        extras["instruction"] = extras["instructions"][0]
    if has_key(file, "additional_info/frequency"):
        found, where = find_dataset(file, "additional_info/frequency"), f"{file.filename}:additional_info/frequency"
        if found.shape != () or found.dtype.kind not in "iu" or not int(found[()]) > 0:
            raise DataError(where, "a whole number above 0", f"shape {found.shape} {found.dtype}", FIX)
        extras["frequency"] = int(found[()])
        if meta.get("source_format") == "RoboTwin":
            extras["control_hz"] = PHYSICS_HZ / extras["frequency"]
    return extras


def _unpack(texts: tuple[str, ...]) -> tuple[str, ...]:
    """The collector writes one JSON list, the converter the texts themselves."""
    if len(texts) == 1 and texts[0].startswith("["):
        try:
            values = json.loads(texts[0])
        except (ValueError, RecursionError):
            return texts
        if all(isinstance(value, str) for value in values):
            return tuple(values)
    return texts


def _read_meta(path: Path) -> dict[str, Any]:
    """`conversion_meta.json`, which the converter leaves beside the folder of the episodes; empty where it is not."""
    folders = [path.parent, path.parent.parent] if path.parent.name == "data" else [path.parent]
    for folder in folders:
        meta = folder / "conversion_meta.json"
        if not meta.is_file():
            continue
        try:
            content = json.loads(meta.read_text())
        except (OSError, ValueError, RecursionError) as error:
            raise DataError(meta, "JSON", str(error), "Restore the file, or convert again.") from error
        if not isinstance(content, dict):
            raise DataError(meta, "a JSON object", type(content).__name__, "Restore the file, or convert again.")
        return content
    return {}
