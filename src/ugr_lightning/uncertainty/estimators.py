"""Other estimates of the uncertainty of each step, to put in the place of s_k: sampled, or read off overlapping chunks.

All are (n, K) scores, higher where more error is expected, for the statistics of `calibration`.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import nn

from ugr_lightning.contract import Chunk, Observation
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.models.act import ACT
from ugr_lightning.models.transformer import Dropout, drop
from ugr_lightning.results.tables import Cells
from ugr_lightning.rollout.overlap import Overlap
from ugr_lightning.uncertainty import calibration as kit
from ugr_lightning.uncertainty.predictions import Predictions, batches

Draw = Callable[[Observation], Chunk]


def sampled_deviation(
    draw: Draw, data: ChunkDataModule, episodes: tuple[int, ...], *, stride: int, samples: int
) -> np.ndarray:
    """How far repeated predictions of one chunk scatter, in standard deviations of the training actions.

    Args:
        draw: predicts at random.
        data: after `setup`.
        episodes: which episodes; the order of the result is that of `predictions.predict`.
        stride: control steps between two queries.
        samples: predictions of each chunk.

    Returns:
        (n, K) root of the variance, summed over the action, of the coarse actions.
    """
    std = data.statistics.action_std  # (A,)
    found = []
    for batch in batches(data, episodes, stride=stride):
        chunks = [draw(batch.observation) for _ in range(samples)]
        actions = torch.stack([chunk.actions if chunk.coarse is None else chunk.coarse for chunk in chunks])
        found.append((actions.float() / std).var(0).sum(-1).sqrt())  # (B, K)
    return torch.cat(found).double().numpy()


@contextmanager
def dropout_on(policy: nn.Module, probability: float) -> Iterator[None]:
    """Drop values at random in all dropout layers although the policy is in evaluation mode.

    Args:
        policy: its dropout layers act as they were trained.
        probability: used in layers that were trained without dropout.
    """

    def perturb(layer: Any, inputs: Any, output: torch.Tensor) -> torch.Tensor:
        return drop(output, layer.probability or probability)

    hooks = [layer.register_forward_hook(perturb) for layer in policy.modules() if isinstance(layer, Dropout)]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


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


def estimate(
    policy: ACT,
    data: ChunkDataModule,
    episodes: tuple[int, ...],
    *,
    stride: int,
) -> dict[str, np.ndarray]:
    """Every estimate, by name, on some episodes; the state of the global random generator is put back.

    Args:
        policy: in evaluation mode, with its CVAE's decoder.
        data: after `setup`.
        episodes: which episodes.
        stride: control steps between two queries.
    """
    std = data.statistics.action_std.numpy()  # (A,)
    frames = data.data.frames.of(episodes, stride)
    episode, step = data.data.frames.locate(frames)
    chunks = [policy.predict(data.data.__getitems__([frame]).observation) for frame in frames.tolist()]
    actions = torch.cat([chunk.actions if chunk.coarse is None else chunk.coarse for chunk in chunks]).numpy()

    def sampled_style(observation: Observation) -> Chunk:
        return policy.predict(observation, torch.randn(len(observation.state), policy.latent_dim))

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        styles = sampled_deviation(sampled_style, data, episodes, stride=stride, samples=8)
        with dropout_on(policy, 0.1):
            dropped = sampled_deviation(policy.predict, data, episodes, stride=stride, samples=8)
    overlap = disagreement(actions / std, episode, step)
    return {"MC dropout": dropped, "CVAE samples": styles, "overlapping chunks": overlap}


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
