"""RoboTwin 2.0's raw demonstrations: one HDF5 file per episode, written and read.

Ours carry one more group, `ugr/`: the expert's intended command and tool poses, measured joints, contacts, phases and
slack.
RoboTwin's own tools do not look at it; files of RoboTwin do not have it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.folder import episode_path, read_seeds
from ugr_lightning.data.formats import Contents, EpisodeLocation, NumberedFiles
from ugr_lightning.data.keyframes import first_axes
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout, policy_cameras
from ugr_lightning.data.recorded_arrays import (
    CameraParameters,
    camera_arrays,
    checked_array,
    encoded_frames,
)
from ugr_lightning.data.storage.hdf5 import (
    FIX,
    find_dataset,
    has_key,
    list_keys,
    open_hdf5,
    read_array,
    read_attribute,
    read_texts,
    write_hdf5,
)
from ugr_lightning.data.storage.hdf5_frames import colour_cameras, hdf5_frames
from ugr_lightning.data.storage.jpeg import encode_frame
from ugr_lightning.embodiment import CAMERAS, image_projection
from ugr_lightning.errors import DataError

FORMAT_VERSION = 1
VECTOR = "joint_action/vector"
FLANGE_TO_TOOL, TABLE_HEIGHT = 0.12, 0.74
"""RoboTwin's own tool poses are so far behind the place between the fingers, m, and its table is so high; ours are
there, and at 0 (RoboTwin-Platform/RoboTwin@cf47ab5, envs/robot/robot.py and envs/_base_task.py)."""
DISK_CAMERAS = {"cam_high": "head_camera", "cam_right_wrist": "right_camera", "cam_left_wrist": "left_camera"}

_ATTRIBUTES: dict[str, type] = {
    "seed": int,
    "control_hz": float,
    "task": str,
    "task_version": int,
    "setting": str,
    "noise": str,
}


def write_episode(
    path: Path,
    *,
    images: np.ndarray | Sequence[Sequence[bytes]],
    commanded: np.ndarray,
    measured: np.ndarray,
    endpose: np.ndarray,
    contacts: np.ndarray,
    expert_action: np.ndarray,
    phase: Sequence[str],
    slack: np.ndarray,
    camera_parameters: CameraParameters | Sequence[CameraParameters],
    task: str,
    setting: str,
    seed: int,
    control_hz: float,
    noise: Mapping[str, Any] | None = None,
    task_version: int | None = None,
    cameras: Sequence[str] = CAMERAS,
    intended_endpose: np.ndarray | None = None,
) -> None:
    """Write one episode of N decision steps, hence N + 1 frames, so that it is either complete on disk or absent.

    `commanded[t + 1]` is what was executed at step t, `expert_action[t]` what the expert wanted; they differ where
    noise was injected, and the latter is the label that `read_episode` returns.

    Args:
        path: final file, see `data.folder.episode_path`; folders are made, and `<path>.partial` is renamed to it.
        images: (N + 1, V, H, W, 3) uint8 RGB in the order of `cameras`; or N + 1 items of V JPEGs each, as
            `data.jpeg.encode_frame` makes them, to keep memory low while recording.
        commanded: (N + 1, S) joint targets in force, robot units.
        measured: (N + 1, S) measured joints, robot units.
        endpose: (N + 1, 2, 7) world pose of the left and right tool, x y z qw qx qy qz, m.
        contacts: (N + 1, 2) bool, left and right fingers touch something.
        expert_action: (N, S) the expert's intended absolute command, robot units.
        phase: N names of the motion that each step belongs to.
        slack: (N,) how much execution noise each step tolerates, 0 to 1.
        camera_parameters: N + 1 items of `Simulator.camera_parameters()`, or one for cameras that never move;
            by camera name: intrinsic_cv (3, 3), extrinsic_cv (3, 4), cam2world_gl (4, 4).
        task: task name.
        setting: scene setting.
        seed: simulator seed.
        control_hz: decision steps per second.
        noise: how noise was injected, plain values; None for none.
        task_version: version of the task; None where it has none.
        cameras: names of the cameras.
        intended_endpose: (N + 1, 2, 7) `endpose` without the noise, see `demos.intended`; None where nobody knows.

    Raises:
        DataError: an array of another shape, or NaN or infinity in one; nothing is written.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, envs/_base_task.py and envs/utils/pkl2hdf5.py.
    """
    path, steps = Path(path), len(expert_action)
    if steps < 1:
        raise DataError(path, "at least one step", "none", "Record a longer episode.")
    joints = np.shape(commanded)[-1]
    commanded = checked_array(path, "commanded", commanded, (steps + 1, joints))
    endpose = checked_array(path, "endpose", endpose, (steps + 1, 2, 7))
    ours = {
        "expert_action": checked_array(path, "expert_action", expert_action, (steps, joints)).astype(np.float32),
        "measured": checked_array(path, "measured", measured, (steps + 1, joints)).astype(np.float32),
        "contacts": checked_array(path, "contacts", contacts, (steps + 1, 2)).astype(bool),
        "slack": checked_array(path, "slack", slack, (steps,)).astype(np.float32),
    }
    if intended_endpose is not None:
        ours["intended_endpose"] = checked_array(path, "intended_endpose", intended_endpose, (steps + 1, 2, 7))
    if len(phase) != steps:
        raise DataError(f"{path}:phase", f"{steps} names", len(phase), "Give one phase per step.")
    jpegs = encoded_frames(path, images, steps + 1, cameras)
    parameters = camera_arrays(path, camera_parameters, steps + 1, cameras)

    def fill(file: h5py.File) -> None:
        file.attrs["ugr_format_version"] = FORMAT_VERSION
        file.attrs["seed"], file.attrs["control_hz"] = int(seed), float(control_hz)
        if task_version is not None:
            file.attrs["task_version"] = int(task_version)
        texts = {"task": task, "setting": setting, "noise": json.dumps(dict(noise or {}), sort_keys=True)}
        for name, text in {**texts, "package_version": version("ugr-lightning")}.items():
            file.attrs[name] = np.bytes_(text.encode())  # fixed width: see `read_attribute`
        _write_joints(file, commanded)
        for pose, side in enumerate(("left", "right")):
            file[f"endpose/{side}_endpose"] = endpose[:, pose]
            if f"joint_action/{side}_gripper" in file:  # a robot of one arm has the left one
                file[f"endpose/{side}_gripper"] = file[f"joint_action/{side}_gripper"][()]
        for camera in cameras:
            group = file.create_group(f"observation/{DISK_CAMERAS.get(camera, camera)}")
            group["rgb"] = np.array(jpegs[camera], dtype=bytes)  # (N + 1,) S{longest}, padded with NUL
            for name, values in parameters[camera].items():
                group[name] = values
        file["pointcloud"] = np.zeros((steps + 1, 0))
        for key, array in ours.items():
            file[f"ugr/{key}"] = array
        file["ugr/phase"] = np.array([name.encode() for name in phase])

    write_hdf5(path, fill)


def read_episode(
    path: Path, cameras: Sequence[str] = CAMERAS, *, seed: int | None = None, layout: Layout = DEFAULT_LAYOUT
) -> Episode:
    """Check one episode file completely and return it with its frames still on disk.

    Args:
        path: a RoboTwin 2.0 raw file, ours or RoboTwin's own.
        cameras: names of `embodiment.CAMERAS`, or of further cameras of the file, in the order wanted.
        seed: simulator seed known from `seed.txt`, used where the file does not say.
        layout: which cameras and joints of the file those are.

    Returns:
        T = frames - 1 steps: state[t] = vector[t], action[t] = `ugr/expert_action[t]` or, without it, vector[t + 1].

    Raises:
        DataError: anything missing, damaged, foreign, or of another shape, type or length.
        ConfigError: a camera that does not exist.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, envs/_base_task.py and envs/utils/pkl2hdf5.py: the state is the
        drive target.
    """
    path = Path(path)
    with open_hdf5(path) as file:
        views = layout.find_cameras(cameras, list_keys(file, "observation"), path)
        vector = read_array(file, VECTOR, (None, None))
        frames = len(vector)
        if frames < 2:
            raise DataError(f"{path}:{VECTOR}", "at least 2 frames", frames, FIX)
        names, where = _columns(file, vector.shape[1]), f"{path}:{VECTOR}"
        state, action, measured = layout.take(vector[:-1], "state", names, where), vector[1:], None
        if has_key(file, "ugr/expert_action"):
            action = read_array(file, "ugr/expert_action", (frames - 1, vector.shape[1]))
        if has_key(file, "ugr/measured"):
            joints = read_array(file, "ugr/measured", (frames, vector.shape[1]))[:-1]
            measured = layout.take(joints, "state", names, where)
        pictures = hdf5_frames(file, tuple(f"observation/{view}/rgb" for view in views), frames)
        extras = _read_extras(file, frames)
        projection, endpose = _projection(file, views, frames, pictures.image_sizes), _endpose(file, frames)
        if endpose is not None and not has_key(file, "ugr/measured"):
            endpose[..., :3] += FLANGE_TO_TOOL * first_axes(endpose[..., 3:])[..., :3]
            extras["table_height"] = TABLE_HEIGHT
    return Episode(
        path=path,
        cameras=tuple(cameras),
        state=state,
        action=layout.take(action, "action", names, where),
        frames=pictures,
        measured=measured,
        seed=extras.pop("seed", seed),
        extras=extras,
        projection=projection,
        endpose=endpose,
    )


def _projection(
    file: h5py.File, views: Sequence[str], frames: int, image_sizes: Sequence[tuple[int, int]]
) -> np.ndarray | None:
    """(T, V, 3, 4), see `embodiment.image_projection`; None where a camera has no calibration."""
    found = []
    for view, image_size in zip(views, image_sizes, strict=True):
        names = [f"observation/{view}/{name}" for name in ("intrinsic_cv", "extrinsic_cv")]
        if not all(has_key(file, name) for name in names):
            return None
        intrinsic, extrinsic = (
            read_array(file, name, (frames, *shape)) for name, shape in zip(names, ((3, 3), (3, 4)), strict=True)
        )
        found.append(image_projection(intrinsic[:-1], extrinsic[:-1], image_size))
    return np.stack(found, axis=1)


def _endpose(file: h5py.File, frames: int) -> np.ndarray | None:
    """(T + 1, 2, 7) tool poses, without noise where the file knows them so; None where it has none."""
    if has_key(file, "ugr/intended_endpose"):
        return read_array(file, "ugr/intended_endpose", (frames, 2, 7))
    names = [f"endpose/{side}_endpose" for side in ("left", "right")]
    if not all(has_key(file, name) for name in names):
        return None
    return np.stack([read_array(file, name, (frames, 7)) for name in names], axis=1)


def _columns(file: h5py.File, width: int) -> tuple[str, ...]:
    """Names of the columns of `joint_action/vector`: left arm, left gripper, right arm, right gripper."""
    arms = [f"joint_action/{side}_arm" for side in ("left", "right")]
    shapes: list[tuple[int, ...]] = [find_dataset(file, arm).shape or () if has_key(file, arm) else () for arm in arms]
    joints = [shape[1] if len(shape) == 2 else 0 for shape in shapes]
    if sum(joints) + 2 != width:
        return tuple(map(str, range(width)))
    names: list[str] = []
    for side, count in zip(("left", "right"), joints, strict=True):
        names += [f"{side}_joint_{joint}" for joint in range(1, count + 1)] + [f"{side}_gripper"]
    return tuple(names)


class RoboTwin(NumberedFiles):
    """RoboTwin 2.0's raw demonstrations, and ours."""

    name = "robotwin"
    marks = "`joint_action/vector`, `observation`"

    def matches(self, file: h5py.File) -> bool:
        return has_key(file, "joint_action")

    def find(self, folder: Path) -> dict[int, EpisodeLocation]:
        """The episodes with the seeds of `seed.txt`, by index."""
        seeds = dict(enumerate(read_seeds(folder)))
        return {i: replace(location, seed=seeds.get(i)) for i, location in super().find(folder).items()}

    def peek(self, location: EpisodeLocation) -> Contents:
        """The cameras, head and wrists by our names, and the joints as left_joint_1 .. right_gripper."""
        with open_hdf5(location.path) as file:
            names = _columns(file, read_array(file, VECTOR, (None, None)).shape[1])
            keys = {name: f"observation/{name}/rgb" for name in list_keys(file, "observation")}
            cameras, others = colour_cameras(file, keys)
            return Contents(policy_cameras(cameras), names, names, others)

    def read(self, location: EpisodeLocation, cameras: Sequence[str], layout: Layout = DEFAULT_LAYOUT) -> Episode:
        return read_episode(location.path, cameras, seed=location.seed, layout=layout)

    def episode_file(self, folder: Path, index: int) -> Path:
        return episode_path(folder, index)

    def check(self, episodes: Sequence[Episode]) -> None:
        for episode in episodes:
            joints, actions = episode.state.shape[1], episode.action.shape[1]
            if actions != joints or joints < 4 or joints % 2:
                got = f"{joints} states, {actions} actions"
                expected = "two arms, each with a gripper, in states and actions alike"
                raise DataError(episode.path, expected, got, "Convert to `act` instead.")

    def fill(self, file: h5py.File, episode: Episode) -> None:
        """Write an episode of another format: T steps give T + 1 frames, the last with the pictures of step T - 1.

        The label goes to `ugr/expert_action` where it is not the next state. Poses and cameras' parameters, which
        other formats do not have, are left out rather than made up. Pictures are compressed, unless they already were.
        """
        vector = np.concatenate([episode.state, episode.action[-1:]]).astype(np.float64)  # (T + 1, S)
        write_about(file, episode)
        _write_joints(file, vector)
        if not np.array_equal(vector[1:], episode.action):
            file["ugr/expert_action"] = episode.action
        steps = range(episode.length)
        jpegs = [episode.frames.jpegs(step) or encode_frame(episode.frames.pictures(step)) for step in steps]
        for view, camera in enumerate(episode.cameras):
            frames = [step[view] for step in [*jpegs, jpegs[-1]]]
            file[f"observation/{DISK_CAMERAS.get(camera, camera)}/rgb"] = np.array(frames, dtype=bytes)
        file["pointcloud"] = np.zeros((len(vector), 0))


def _write_joints(file: h5py.File, vector: np.ndarray) -> None:
    """`joint_action/*`, float64, from (T, S); an odd number of joints is one arm."""
    arms = 1 if vector.shape[1] % 2 else 2
    for side, joints in zip(("left", "right"), np.split(vector, arms, axis=1), strict=False):
        file[f"joint_action/{side}_arm"] = joints[:, :-1]
        file[f"joint_action/{side}_gripper"] = joints[:, -1]
    file[VECTOR] = vector


def _read_extras(file: h5py.File, frames: int) -> dict[str, Any]:
    """What our files say beyond RoboTwin's layout; empty for RoboTwin's own."""
    extras: dict[str, Any] = {}
    if has_key(file, "ugr/contacts"):
        extras["contacts"] = read_array(file, "ugr/contacts", (frames, 2), kind="b")
    if has_key(file, "ugr/slack"):
        extras["slack"] = read_array(file, "ugr/slack", (frames - 1,))
    if has_key(file, "ugr/phase"):
        extras["phase"] = read_texts(file, "ugr/phase", frames - 1)
    return extras | read_about(file)


def read_about(file: h5py.File) -> dict[str, Any]:
    """What the attributes of a file of ours say about the episode; empty for the files of others.

    Raises:
        DataError: a value of another type, or a file of the future.
    """
    about: dict[str, Any] = {}
    written = read_attribute(file, "ugr_format_version")
    if written not in (None, FORMAT_VERSION):
        got = f"version {written}"
        raise DataError(file.filename, f"format version {FORMAT_VERSION}", got, "Update ugr-lightning.")
    for name, kind in _ATTRIBUTES.items():
        value = read_attribute(file, name)
        if value is None:
            continue
        if not isinstance(value, kind):
            raise DataError(f"{file.filename}:@{name}", kind.__name__, repr(value)[:80], FIX)
        about[name] = value
    return about


def write_about(file: h5py.File, episode: Episode) -> None:
    """Write what is known about an episode for `read_about`."""
    for name in _ATTRIBUTES:
        value = episode.seed if name == "seed" else episode.extras.get(name)
        if value is not None:
            file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
