"""The original ACT's HDF5: measured joints and velocities, any cameras, simulated or from a real robot."""

from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats.act_hdf5 import ACTION, IMAGES, QPOS, ProcessedAct, is_original
from ugr_lightning.data.storage.hdf5 import has_key, read_array, read_attribute
from ugr_lightning.errors import DataError

QVEL = "observations/qvel"


class OriginalAct(ProcessedAct):
    """Episodes with the attribute `sim`, and velocities beside the measured joints.

    The label of step t is `action[t]` for both kinds. What the original's loader does with a real robot's, where
    `sim` is false, it does while sampling: `data.action_offset: -1`.
    """

    name = "original-act"
    marks = "`action`, `observations/qpos`, `observations/images`, and `observations/qvel` or the attribute `sim`"
    chunked = True

    def matches(self, file: h5py.File) -> bool:
        return all(has_key(file, key) for key in (QPOS, ACTION, IMAGES)) and is_original(file)

    def _read_further(self, file: h5py.File, state: np.ndarray) -> tuple[np.ndarray | None, dict[str, Any]]:
        extras: dict[str, Any] = {}
        simulated = read_attribute(file, "sim")
        if simulated is not None:
            extras["sim"] = bool(simulated)
        if has_key(file, QVEL):
            extras["qvel"] = read_array(file, QVEL, (len(state), None))
        return state, extras

    def _write_further(self, file: h5py.File, episode: Episode) -> None:
        file.attrs["sim"] = bool(episode.extras.get("sim", True))  # true: its loader then takes action[t] for step t
        file[QVEL] = _velocities(episode)


def _velocities(episode: Episode) -> np.ndarray:
    """The velocities that were recorded, or else the differences of the joints, (T, S) float32, per second."""
    if "qvel" in episode.extras:
        return np.asarray(episode.extras["qvel"], np.float32)
    rate = episode.extras.get("control_hz")
    if rate is None:
        fix = "State the steps per second with `--rate`, or convert to `act`, which needs no velocities."
        raise DataError(episode.path, "`control_hz`, to derive joint velocities from", "none", fix)
    joints = episode.state if episode.measured is None else episode.measured  # (T, S)
    return np.diff(joints, axis=0, prepend=joints[:1]) * np.float32(rate)
