"""Processed ACT HDF5, as RoboTwin's ACT trains on it: joints, commands and RGB frames per episode.

Frames are plain, or rows of JPEG bytes as act-plus-plus compresses them (attribute `compress`). The original ACT's
files (`original_act.py`) have the same keys and some more. Ours have the attributes of our recordings and the frames'
JPEGs as well, where there are any; other readers do not look at them.
"""

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import Contents, EpisodeLocation, NumberedFiles
from ugr_lightning.data.formats.robotwin import read_about, write_about
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout, policy_cameras
from ugr_lightning.data.storage.hdf5 import FIX, has_key, list_keys, open_hdf5, read_array
from ugr_lightning.data.storage.hdf5_frames import colour_cameras, hdf5_frames
from ugr_lightning.errors import DataError

QPOS, ACTION, IMAGES = "observations/qpos", "action", "observations/images"
ORIGINS = "ugr/jpeg"  # ours: the JPEGs that the frames were decoded from
TWO_ARMS = 12  # a vector of even length from here on is two arms, each with a gripper last


class ProcessedAct(NumberedFiles):
    """Episodes of T rows: `qpos[t]` was in force and `action[t]` commanded when the pictures of row t were taken."""

    name = "act"
    marks = "`action`, `observations/qpos`, `observations/images` and no `observations/qvel`"
    chunked = False
    """Whether frames are stored one by one, or in one block."""

    def matches(self, file: h5py.File) -> bool:
        return all(has_key(file, key) for key in (QPOS, ACTION, IMAGES)) and not is_original(file)

    def peek(self, location: EpisodeLocation) -> Contents:
        """The cameras, and the joints by position: these files do not name them."""
        with open_hdf5(location.path) as file:
            cameras, others = colour_cameras(file, {name: f"{IMAGES}/{name}" for name in list_keys(file, IMAGES)})
            widths = [read_array(file, key, (None, None)).shape[1] for key in (QPOS, ACTION)]
            state, action = (tuple(map(str, range(width))) for width in widths)
            return Contents(policy_cameras(cameras), state, action, others)

    def read(self, location: EpisodeLocation, cameras: Sequence[str], layout: Layout = DEFAULT_LAYOUT) -> Episode:
        """Check one file; row t of it is step t, labelled `action[t]`."""
        path = location.path
        with open_hdf5(path) as file:
            views = layout.find_cameras(cameras, list_keys(file, IMAGES), path)
            qpos = read_array(file, QPOS, (None, None))
            if len(qpos) < 1:
                raise DataError(f"{path}:{QPOS}", "at least 1 row", 0, FIX)
            action = read_array(file, ACTION, (len(qpos), None))
            origins = tuple(f"{ORIGINS}/{view}" for view in views) if has_key(file, ORIGINS) else ()
            frames = hdf5_frames(file, tuple(f"{IMAGES}/{view}" for view in views), len(qpos), origins)
            state, measured = self._read_joints(file, qpos)
            extras = self._read_further(file, len(qpos), layout) | read_about(file)
        return Episode(
            path=path,
            cameras=tuple(cameras),
            state=layout.take(state, "state", (), f"{path}:{QPOS}"),
            action=layout.take(action, "action", (), f"{path}:{ACTION}"),
            frames=frames,
            measured=None if measured is None else layout.take(measured, "state", (), f"{path}:{QPOS}"),
            seed=extras.pop("seed", location.seed),
            extras=extras,
        )

    def _read_joints(self, file: h5py.File, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """The state, and the measured joints where the file has them, (T, D) each."""
        return qpos, None

    def _read_further(self, file: h5py.File, steps: int, layout: Layout) -> dict[str, Any]:
        """What else the file says."""
        return {}

    def fill(self, file: h5py.File, episode: Episode) -> None:
        """Write one episode, its frames one at a time at the size they have.

        JPEGs that they come from are kept beside them, about a tenth more, so that the way back loses nothing.
        """
        write_about(file, episode)
        file[ACTION] = episode.action  # (T, A) float32
        self._write_joints(file, episode)
        pictures = []
        for camera, size in zip(episode.cameras, episode.frames.image_sizes, strict=True):
            shape = (episode.length, *size, 3)
            chunks = (1, *shape[1:]) if self.chunked else None
            pictures.append(file.create_dataset(f"{IMAGES}/{camera}", shape, np.uint8, chunks=chunks))
        jpegs = [episode.frames.jpegs(step) for step in range(episode.length)]
        for step in range(episode.length):
            for dataset, picture in zip(pictures, episode.frames.pictures(step), strict=True):
                dataset[step] = picture
        kept = [step for step in jpegs if step is not None]
        if len(kept) == episode.length:
            for view, camera in enumerate(episode.cameras):
                file[f"{ORIGINS}/{camera}"] = np.array([step[view] for step in kept], dtype=bytes)

    def _write_joints(self, file: h5py.File, episode: Episode) -> None:
        """The state, and the number of joints of each arm in every row, as RoboTwin's converter leaves it."""
        file[QPOS] = episode.state  # (T, S) float32
        joints = episode.state.shape[1]
        if joints >= TWO_ARMS and joints % 2 == 0:
            for side in ("left", "right"):
                file[f"observations/{side}_arm_dim"] = np.full(episode.length, joints // 2 - 1, np.int64)


def is_original(file: h5py.File) -> bool:
    """Whether a file with ACT's keys is one of the original ACT and not one made from RoboTwin's recordings."""
    return "sim" in file.attrs or has_key(file, "observations/qvel")
