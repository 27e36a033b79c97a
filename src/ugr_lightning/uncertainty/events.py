"""Error and uncertainty around contacts and gripper commands, where the paper says that errors gather."""

from typing import NamedTuple

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.keyframes import HALF_OPEN
from ugr_lightning.embodiment import ACTION_DIM, GRIPPERS

KINDS = ("contact", "release", "close", "open")


def find_events(episode: Episode) -> dict[str, np.ndarray]:
    """The time steps at which a demonstration meets or leaves things, and opens or closes a gripper.

    Args:
        episode: a demonstration.

    Returns:
        By kind, (m,) time steps of both arms: `contact` and `release` are the first steps with and without fingers
        that touch something; `close` and `open` the first ones whose command is beyond half open. The first two are
        missing where contacts were not recorded, as in other projects' files, the others for robots that do not have
        our two grippers.
    """
    changes: dict[str, np.ndarray] = {}
    if "contacts" in episode.extras:
        touched = np.diff(np.asarray(episode.extras["contacts"])[: episode.length].astype(int), axis=0)  # (T - 1, 2)
        changes |= {"contact": touched > 0, "release": touched < 0}
    if episode.action.shape[1] == ACTION_DIM:
        moved = np.diff((episode.action[:, GRIPPERS] > HALF_OPEN).astype(int), axis=0)  # (T - 1, 2)
        changes |= {"close": moved < 0, "open": moved > 0}
    return {kind: np.unique(np.nonzero(change)[0] + 1) for kind, change in changes.items()}


class Aligned(NamedTuple):
    """Predicted steps around events of one kind.

    Args:
        lag: (m,) control steps from the event to the predicted step, negative before it.
        row, position: (m,) where the predicted step is in the arrays.
    """

    lag: np.ndarray
    row: np.ndarray
    position: np.ndarray


def align(
    episode: np.ndarray,
    step: np.ndarray,
    chunk_length: int,
    lengths: np.ndarray,
    events: dict[int, np.ndarray],
    reach: int,
) -> Aligned:
    """Find the predicted steps near events; a step near two of them counts for both.

    Args:
        episode, step: (n,) where each chunk was predicted.
        chunk_length: K.
        lengths: decision steps of each episode, by episode; predictions past the end are left out.
        events: time steps by episode.
        reach: largest lag, control steps.
    """
    time = step[:, None] + np.arange(chunk_length)  # (n, K)
    inside = time < lengths[episode][:, None]  # (n, K)
    lags, rows, positions = [np.empty(0, int)], [np.empty(0, int)], [np.empty(0, int)]
    for row in range(len(episode)):
        for event in events.get(int(episode[row]), ()):
            lag = time[row] - event  # (K,)
            near = np.flatnonzero(inside[row] & (np.abs(lag) <= reach))
            lags.append(lag[near])
            rows.append(np.full(len(near), row))
            positions.append(near)
    return Aligned(np.concatenate(lags), np.concatenate(rows), np.concatenate(positions))


def mean_by_lag(values: np.ndarray, aligned: Aligned, reach: int) -> np.ndarray:
    """Mean of (n, K) values at each lag from -reach to reach, (2 reach + 1,); NaN where there are none."""
    picked = values[aligned.row, aligned.position]
    known = ~np.isnan(picked)
    index = aligned.lag[known] + reach
    total = np.bincount(index, picked[known], minlength=2 * reach + 1)
    count = np.bincount(index, minlength=2 * reach + 1)
    return np.divide(total, count, out=np.full(2 * reach + 1, np.nan), where=count > 0)


def relative_to_position(values: np.ndarray) -> np.ndarray:
    """(n, K) values divided by the mean of their position: what the place in the chunk does not explain."""
    known = ~np.isnan(values)
    mean = np.where(known, values, 0.0).sum(0) / np.maximum(known.sum(0), 1)
    return values / np.where(mean > 0, mean, np.nan)


def near_to_far(values: np.ndarray, near: np.ndarray, inside: np.ndarray) -> float:
    """Mean of (n, K) values near events over that of the other steps inside the episodes; 1 is no difference.

    Args:
        values: (n, K).
        near: (n, K) bool.
        inside: (n, K) bool, steps before the end of their episode.
    """
    known = inside & ~np.isnan(values)
    close, far = values[known & near], values[known & ~near]
    return float(close.mean() / far.mean()) if len(close) and len(far) and far.mean() > 0 else float("nan")
