"""Per-dimension statistics of training episodes."""

from collections.abc import Sequence

import numpy as np
import torch

from ugr_lightning.contract import Statistics
from ugr_lightning.data.episode import Episode
from ugr_lightning.data.keyframes import keyframe_labels, missing_for_keyframes
from ugr_lightning.errors import DataError

MIN_STD = 1e-2  # an arm that never moves would otherwise be blown up by normalisation


def compute_statistics(
    episodes: Sequence[Episode], indices: Sequence[int] | None = None, *, state: str = "commanded"
) -> Statistics:
    """Mean, unbiased standard deviation, minimum and maximum of states and actions, over real steps only.

    Args:
        episodes: demonstrations.
        indices: positions of the training episodes; None for all.
        state: `commanded` or `measured`, as the policy will see it.

    Returns:
        In robot units, float32, accumulated in float64; standard deviations are at least 0.01.

    Raises:
        DataError: no episode.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/ACT/utils.py, without its padded rows and without
        validation episodes.
    """
    chosen = [episodes[i] for i in (range(len(episodes)) if indices is None else indices)]
    if not chosen:
        raise DataError("statistics", "at least one training episode", "none", "Record demonstrations.")
    states = np.concatenate([episode.proprioception(state) for episode in chosen]).astype(np.float64)  # (N, S)
    actions = np.concatenate([episode.action for episode in chosen]).astype(np.float64)  # (N, A)
    labels = [keyframe_labels(episode) for episode in chosen]
    positions = [label[0] for label in labels if label is not None]  # of (T, 2, 3)
    if any(map(missing_for_keyframes, episodes)):  # validation needs them, too
        return Statistics(*_moments(states), *_moments(actions))
    mean, std, *_ = _moments(np.concatenate(positions).astype(np.float64))  # (2, 3) each
    whole = Statistics(*_moments(states), *_moments(actions))
    return whole._replace(keyframe_mean=mean, keyframe_std=std)


def _moments(rows: np.ndarray) -> list[torch.Tensor]:
    std = rows.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(rows.shape[1:])
    moments = (rows.mean(axis=0), np.maximum(std, MIN_STD), rows.min(axis=0), rows.max(axis=0))
    return [torch.from_numpy(moment.astype(np.float32)) for moment in moments]
