"""Another estimate of the uncertainty of each step, to put in the place of s_k: read off overlapping chunks.

It is a score (n, K), higher where more error is expected, for the statistics of `calibration`.
"""

import numpy as np
import torch
from torch import Tensor

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.results.tables import Cells
from ugr_lightning.rollout.overlap import Overlap
from ugr_lightning.uncertainty import calibration as kit
from ugr_lightning.uncertainty.predictions import Predictions, batches


def disagreement(actions: np.ndarray, episode: np.ndarray, step: np.ndarray) -> np.ndarray:
    """How far a chunk is from what earlier chunks of the episode said about the same moments.

    Args:
        actions: (n, K, A), in units in which distances mean something.
        episode, step: (n,) where each chunk was predicted; of an episode in the order of its steps.

    Returns:
        (n, K) root mean square distance to the earlier predictions; NaN where there are none: in an episode's first
        chunk, and at the end of every chunk.
    """
    overlaps: dict[int, Overlap] = {}
    found = np.empty(actions.shape[:2])
    for row, (number, now, chunk) in enumerate(zip(episode.tolist(), step.tolist(), actions, strict=True)):
        overlap = overlaps.setdefault(number, Overlap(actions.shape[1], np.ones(actions.shape[2])))
        found[row] = overlap.push(now, chunk)
    return found


def overlapping(policy: ChunkPolicy, data: ChunkDataModule, episodes: tuple[int, ...], *, stride: int) -> np.ndarray:
    """The `disagreement` of coarse chunks, in standard deviations of the training actions.

    Args:
        policy: in evaluation mode.
        data: after `setup`.
        episodes: which episodes; the order of the result is that of `predictions.predict`.
        stride: control steps between two queries.

    Returns:
        (n, K).
    """
    std = data.statistics.action_std  # (A,)
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for batch in batches(data, episodes, stride=stride):
        with torch.no_grad():
            chunk = policy.predict(batch.observation)
        coarse = chunk.actions if chunk.coarse is None else chunk.coarse  # (B, K, A)
        parts.append((coarse.float() / std, batch.episode, batch.step))
    return disagreement(*(torch.cat(of).numpy() for of in zip(*parts, strict=True)))


def estimator_table(validation: Predictions, estimates: dict[str, np.ndarray], budget: int) -> Cells:
    """Each estimate beside s_k on the same steps, as cells, heading first.

    Args:
        validation: predictions, with log-variance.
        estimates: (n, K) each, NaN where there is none.
        budget: steps that the policy refines, M.
    """
    learned = validation.log_variance
    assert learned is not None
    cells: Cells = [
        ("estimator", "steps", "Spearman", "within position", "recall", "recall of s_k", "difference", "AUSE")
    ]
    for name, score in {"s_k": learned, **estimates}.items():
        error = np.where(np.isnan(score), np.nan, validation.coarse)
        filled = np.nan_to_num(score)
        pair = np.stack([kit.recall(error, other, budget) for other in (filled, learned)])  # (2, n)

        def recalls(rows: np.ndarray, pair: np.ndarray = pair) -> np.ndarray:
            means = np.nanmean(pair[:, rows], axis=1)
            return np.array([means[0], means[1], means[0] - means[1]])

        own, other, difference = kit.bootstrap(recalls, validation.episode)
        numbers = [kit.spearman(error, filled), kit.spearman_within_position(error, filled)]
        shown = [f"{value:.3g}" for value in (*numbers, own.value, other.value)]
        steps = str(int((~np.isnan(error)).sum()))
        cells.append((name, steps, *shown, str(difference), f"{kit.ause(error, filled):.3g}"))
    return cells
