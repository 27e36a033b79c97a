"""The original ACT's HDF5: measured joints and velocities, any cameras, simulated or from a real robot."""

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats.act_hdf5 import ACTION, IMAGES, QPOS, ProcessedAct, is_original
from ugr_lightning.data.layout import Layout
from ugr_lightning.data.storage.hdf5 import has_key, read_array, read_attribute
from ugr_lightning.errors import DataError

QVEL = "observations/qvel"
STATE = "ugr/state"  # ours: the state, where `qpos` is not both the state and measured


class OriginalAct(ProcessedAct):
    """Episodes with the attribute `sim`, and velocities beside the measured joints.

    The label of step t is `action[t]` for both kinds. What the original's loader does with a real robot's, where
    `sim` is false, it does while sampling: `data.action_offset: -1`.

    `qpos` is measured, and the state. What we write of episodes that know both commanded and measured joints has the
    state in `ugr/state` as well; where nothing was measured, `qpos` repeats it.
    """

    name = "original-act"
    marks = "`action`, `observations/qpos`, `observations/images`, and `observations/qvel` or the attribute `sim`"
    chunked = True

    def matches(self, file: h5py.File) -> bool:
        return all(has_key(file, key) for key in (QPOS, ACTION, IMAGES)) and is_original(file)

    def _read_joints(self, file: h5py.File, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        if not has_key(file, STATE):
            return qpos, qpos
        state = read_array(file, STATE, qpos.shape)
        return state, None if np.array_equal(state, qpos) else qpos

    def _read_further(self, file: h5py.File, steps: int, layout: Layout) -> dict[str, Any]:
        extras: dict[str, Any] = {}
        simulated = read_attribute(file, "sim")
        if simulated is not None:
            extras["sim"] = bool(simulated)
        if has_key(file, QVEL) and layout.width("state") is not None:  # of other joints, or units, it says nothing
            extras["qvel"] = read_array(file, QVEL, (steps, None))
        return extras

    def check(self, episodes: Sequence[Episode]) -> None:
        for episode in episodes:
            if "qvel" not in episode.extras and episode.extras.get("control_hz") is None:
                fix = "State the steps per second with `--rate`, or convert to `act`, which needs no velocities."
                raise DataError(episode.path, "`control_hz`, to derive joint velocities from", "none", fix)

    def _write_joints(self, file: h5py.File, episode: Episode) -> None:
        file.attrs["sim"] = bool(episode.extras.get("sim", True))  # true: its loader then takes action[t] for step t
        file[QPOS], file[QVEL] = _joints(episode), _velocities(episode)  # (T, S) float32
        if episode.measured is None or not np.array_equal(episode.measured, episode.state):
            file[STATE] = episode.state


def _joints(episode: Episode) -> np.ndarray:
    """The measured joints, or else the state, (T, S) float32."""
    return episode.state if episode.measured is None else episode.measured


def _velocities(episode: Episode) -> np.ndarray:
    """The velocities that were recorded, or else the differences of the joints, (T, S) float32, per second."""
    if "qvel" in episode.extras:
        return np.asarray(episode.extras["qvel"], np.float32)
    joints = _joints(episode)
    return np.diff(joints, axis=0, prepend=joints[:1]) * np.float32(episode.extras["control_hz"])
