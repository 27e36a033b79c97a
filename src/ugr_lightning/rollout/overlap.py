"""How far chunks that overlap are from each other, while an episode runs or afterwards."""

import math

import numpy as np

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.models.normalizer import Normalizer

HORIZON = 10
"""Steps of a chunk that count in how far it is from earlier ones."""


class Overlap:
    """How far each chunk of an episode is from what earlier chunks said about the same moments.

    Args:
        chunk_length: K.
        unit: (A,) what a distance of 1 is in each action.

    Source: Welford (1962), running mean and squared deviations: a chunk costs O(K A), however many it overlaps with.
    """

    def __init__(self, chunk_length: int, unit: np.ndarray) -> None:
        self._unit, self._step = unit, 0
        self._mean = np.zeros((chunk_length, len(unit)))  # (K, A), of what was said about the next K moments
        self._squares = np.zeros(chunk_length)  # (K,) summed squared distances from it
        self._count = np.zeros(chunk_length)  # (K,)

    def push(self, step: int, chunk: np.ndarray) -> np.ndarray:
        """Root mean square distances (K,) of a chunk to the earlier ones, NaN where there are none; remembers it.

        Args:
            step: control step at which it was predicted, never lower than the last one.
            chunk: (K, A) robot units.
        """
        passed, self._step = min(step - self._step, len(self._count)), step
        for table in (self._mean, self._squares, self._count):
            table[:] = np.concatenate([table[passed:], np.zeros_like(table[:passed])])
        said = np.where(np.isfinite(chunk), chunk, np.nan) / self._unit  # (K, A)
        off = said - self._mean
        known = self._count > 0
        square = np.square(off).sum(1) + self._squares / np.where(known, self._count, np.nan)  # (K,)
        self._count += 1
        self._mean += off / self._count[:, None]
        self._squares += (off * (said - self._mean)).sum(1)
        return np.sqrt(square)


def near_disagreement(distances: np.ndarray) -> float:
    """What an alarm goes by: mean of the first distances of a chunk that are known; NaN without any.

    Args:
        distances: (K,) see `Overlap.push`.
    """
    near = distances[:HORIZON]
    known = near[np.isfinite(near)]
    return float(known.mean()) if len(known) else math.nan


def action_unit(policy: ChunkPolicy) -> np.ndarray:
    """What a distance of 1 is in each action, (A,): as the policy normalises it, robot units for one that does not."""
    fitted = (part for part in policy.modules() if isinstance(part, Normalizer) and part.fitted)
    scale = next((part.action_scale.double().cpu().numpy() for part in fitted), np.ones(policy.action_dim))
    return np.where(scale > 0, scale, 1.0)
