"""Whether a predicted uncertainty knows the error: statistics over arrays, nothing else.

`error` is (n, K): the length of the error of step k in sample n, NaN on padded steps. A `score` is (n, K), higher where
more error is expected: the predicted log-variance s_k, or a rival of it such as the mean error of position k.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats

from ugr_lightning.errors import DataError
from ugr_lightning.models.refine.ranked import highest

LEVELS = (0.5, 0.6827, 0.9, 0.95)
"""Nominal shares of the intervals whose coverage is reported; the second is one standard deviation."""
FRACTIONS = np.linspace(0.0, 0.95, 20)
"""Shares of the steps that a sparsification curve leaves out."""


class Interval(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def position_mean(error: np.ndarray) -> np.ndarray:
    """The position prior: mean error of each position of the chunk.

    Args:
        error: (n, K).

    Returns:
        (K,).

    Raises:
        DataError: a position that is padded in all samples.
    """
    known = ~np.isnan(error)
    if not known.any(0).all():
        got = f"none at position {int(np.argmin(known.any(0)))}"
        raise DataError("position prior", "a known step at every position of the chunk", got, "Use --after_end hold.")
    return np.where(known, error, 0.0).sum(0) / known.sum(0)


def spearman(error: np.ndarray, score: np.ndarray) -> float:
    """Rank correlation of error and score over all steps of all samples; NaN where one of them never varies."""
    known = ~np.isnan(error)
    return _correlation(stats.rankdata(error[known]), stats.rankdata(score[known]))


def spearman_within_position(error: np.ndarray, score: np.ndarray) -> float:
    """Rank correlation of error and score that their position in the chunk does not explain.

    Both are ranked over all steps, each position's mean rank is taken away, and what is left is correlated: the partial
    Spearman correlation given the position as a category. A score that only knows the position gets NaN.

    Args:
        error, score: (n, K).
    """
    known = ~np.isnan(error)
    position = np.broadcast_to(np.arange(error.shape[1]), error.shape)[known]
    left = []
    for values in (error[known], score[known]):
        ranks = stats.rankdata(values)
        means = np.bincount(position, ranks) / np.maximum(np.bincount(position), 1)
        left.append(ranks - means[position])
    return _correlation(*left)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / scale) if scale > 1e-9 * len(a) else float("nan")


def recall(error: np.ndarray, score: np.ndarray, budget: int) -> np.ndarray:
    """Share of each sample's `budget` worst steps that the score would have chosen with the same budget.

    Args:
        error, score: (n, K).
        budget: M.

    Returns:
        (n,); NaN for a sample without known steps.
    """
    known = torch.tensor(~np.isnan(error))
    worst, chosen = (highest(torch.tensor(values), known, budget) for values in (error, score))
    return ((worst & chosen).sum(1).double() / worst.sum(1)).numpy()


def sparsification(error: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Mean error of what remains when `FRACTIONS` of the steps, of the highest scores, are left out; relative to all.

    Args:
        error, score: (n, K).

    Returns:
        (F,); the score `error` itself gives the lowest curve that there is.

    Source: Ilg et al. (2018), "Uncertainty estimates and multi-hypotheses networks for optical flow".
    """
    known = ~np.isnan(error)
    values = error[known][np.argsort(score[known], kind="stable")]  # the most certain first
    kept = np.maximum(1, np.round((1 - FRACTIONS) * len(values)).astype(int))
    return np.cumsum(values)[kept - 1] / kept / values.mean()


def ause(error: np.ndarray, score: np.ndarray) -> float:
    """Area between the sparsification curves of the score and of the error itself; 0 is perfect."""
    gap = sparsification(error, score) - sparsification(error, error)
    return float(np.trapezoid(gap, FRACTIONS))


def gaussian_nll(error: np.ndarray, log_variance: np.ndarray) -> np.ndarray:
    """Negative log-likelihood of each step's error under a Gaussian of mean 0 and variance exp(log_variance), nats.

    The paper's reading: one scalar variance for the length of the error. An isotropic Gaussian over the A dimensions
    would change all values by the same constant and factor.

    Args:
        error: (n, K).
        log_variance: broadcastable to (n, K).

    Returns:
        (n, K), NaN on padded steps.

    Source: half of paper, Eq. (8), plus the constant.
    """
    return 0.5 * (np.log(2 * np.pi) + log_variance + np.square(error) * np.exp(-log_variance))


def coverage(error: np.ndarray, log_variance: np.ndarray) -> np.ndarray:
    """Share of the steps whose error lies in the central interval that holds each of `LEVELS` of the Gaussian.

    Args:
        error: (n, K).
        log_variance: broadcastable to (n, K).

    Returns:
        (L,); equal to the levels where the variances are right and the errors Gaussian.
    """
    known = ~np.isnan(error)
    deviations = (error * np.exp(-np.broadcast_to(log_variance, error.shape) / 2))[known]
    return np.array([float(np.mean(deviations <= stats.norm.ppf((1 + level) / 2))) for level in LEVELS])


def bootstrap(
    statistics: Callable[[np.ndarray], np.ndarray], episode: np.ndarray, resamples: int = 500
) -> list[Interval]:
    """Statistics and their 95 % percentile intervals when whole episodes are drawn with replacement.

    Steps of one episode are far from independent; episodes are. With few episodes such intervals are somewhat narrow.

    Args:
        statistics: takes row numbers of the arrays, gives J numbers at once, so that their differences share draws.
        episode: (n,) which episode each row is from.
        resamples: how many draws.

    Returns:
        J intervals; a number that is NaN in all draws has NaN limits.

    Raises:
        DataError: fewer than two episodes, about which no interval can be given.

    Source: Efron and Tibshirani (1993), percentile method, clusters resampled.
    """
    rows = [np.flatnonzero(episode == name) for name in np.unique(episode)]
    if len(rows) < 2:
        raise DataError("validation", "at least 2 episodes", len(rows), "Record and split more demonstrations.")
    draws = np.random.default_rng(0).integers(len(rows), size=(resamples, len(rows)))
    drawn = np.stack([statistics(np.concatenate([rows[index] for index in draw])) for draw in draws])  # (R, J)
    values = statistics(np.arange(len(episode)))
    limits = [np.nanpercentile(one, (2.5, 97.5)) if (~np.isnan(one)).any() else (np.nan, np.nan) for one in drawn.T]
    return [Interval(float(value), float(low), float(high)) for value, (low, high) in zip(values, limits, strict=True)]
