"""Whether errors on new scenes can be foretold from what a refinement branch sees: what it could correct at best.

A branch sees the hidden state h and the coarse action A_0 of a step. What it can take away from the squared error there
is the share of it that a regression from (h, A_0), fitted on other new episodes, explains: its cross-fitted R^2. The
same regression fitted on the episodes that the policy was trained on is what training a branch comes to.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.errors import DataError
from ugr_lightning.models.act import ACT
from ugr_lightning.uncertainty.calibration import Interval, bootstrap
from ugr_lightning.uncertainty.predictions import batches

PENALTIES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge penalties that are tried, on standardised features; the best one is chosen on the episodes that are fitted."""
UNITS = 256
"""Random ReLU units of the regression that is not linear."""


class Moments(NamedTuple):
    """What a regression needs to know of one episode with n steps.

    Args:
        features: (F, F) sum of x x^T.
        cross: (F, A) sum of x e^T, with the error e.
        squares: sum of e^2.
        steps: n.
    """

    features: np.ndarray
    cross: np.ndarray
    squares: float
    steps: int

    def left(self, weights: np.ndarray) -> float:
        """Squared error that remains after a correction x^T W, with W (F, A)."""
        return float(self.squares - 2 * (weights * self.cross).sum() + (weights * (self.features @ weights)).sum())


def foretold(policy: ACT, data: ChunkDataModule, *, stride: int, resamples: int = 500) -> dict[str, Interval]:
    """R^2 of the errors of coarse actions on the validation episodes, by where the regression learned.

    Args:
        policy: in evaluation mode.
        data: its demonstrations, after `setup`.
        stride: control steps between two queries.
        resamples: draws of the bootstrap over episodes.

    Returns:
        Shares of the squared error, 1 for all of it, below 0 where the correction makes it worse.

    Raises:
        DataError: fewer than three validation episodes.
    """
    split = data.episode_split
    if len(split.validation) < 3:
        got = len(split.validation)
        raise DataError("validation", "at least 3 episodes", got, "Record and split more demonstrations.")
    known, new = ([*_steps(policy, data, part, stride)] for part in (split.train, split.validation))
    pooled = np.concatenate([features for features, _ in known])  # (n, D + A)
    mean, std = pooled.mean(0), pooled.std(0) + 1e-6
    mixing = np.random.default_rng(0).normal(size=(pooled.shape[1] + 1, UNITS)) / np.sqrt(pooled.shape[1])

    def moments(part: Sequence[tuple[np.ndarray, np.ndarray]], bends: bool) -> list[Moments]:
        found = []
        for features, error in part:
            x = np.column_stack([np.ones(len(features)), (features - mean) / std])  # (n, 1 + D + A)
            if bends:
                x = np.column_stack([x, np.maximum(x @ mixing, 0.0)])  # (n, 1 + D + A + UNITS)
            found.append(Moments(x.T @ x, x.T @ error, float(np.square(error).sum()), len(x)))
        return found

    straight, bent = moments(new, False), moments(new, True)
    ways = {
        "the training episodes, as a branch": [each.left(ridge(moments(known, False))) for each in straight],
        "other new episodes, linear": cross_fitted(straight),
        f"other new episodes, {UNITS} ReLU units": cross_fitted(bent),
    }
    left, whole = np.array(list(ways.values())), np.array([each.squares for each in straight])  # (J, E), (E,)
    found = bootstrap(lambda rows: 1 - left[:, rows].sum(1) / whole[rows].sum(), np.arange(len(whole)), resamples)
    return dict(zip(ways, found, strict=True))


def _steps(
    policy: ACT, data: ChunkDataModule, episodes: tuple[int, ...], stride: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each episode, what the branch sees (n, D + A) and what the coarse actions miss (n, A), in deviations."""
    std, hidden = data.statistics.action_std, []  # (A,), of (B, K, D)
    hook = policy.decoder_norm.register_forward_hook(lambda layer, given, out: hidden.append(out.float().numpy()))
    try:
        for episode in episodes:
            parts = []
            for batch in batches(data, (episode,), stride=stride):
                chunk, known = policy.predict(batch.observation), batch.valid.numpy()  # (B, K)
                coarse = (chunk.actions if chunk.coarse is None else chunk.coarse).float()  # (B, K, A)
                error = (batch.actions - coarse) / std  # (B, K, A)
                seen = np.concatenate([hidden.pop(), coarse / std], axis=2)  # (B, K, D + A)
                parts.append((seen[known], error.numpy()[known]))
            yield tuple(np.concatenate(part).astype(np.float64) for part in zip(*parts, strict=True))  # type: ignore[misc]
    finally:
        hook.remove()


def cross_fitted(episodes: Sequence[Moments]) -> list[float]:
    """Squared error that is left of each episode by a regression fitted on the others."""
    return [one.left(ridge([*episodes[:i], *episodes[i + 1 :]])) for i, one in enumerate(episodes)]


def ridge(episodes: Sequence[Moments]) -> np.ndarray:
    """Weights (F, A) with the penalty that leaves least of each of these episodes when it is fitted on the others.

    Args:
        episodes: at least two.
    """

    def left(penalty: float) -> float:
        rests = ((one, [*episodes[:i], *episodes[i + 1 :]]) for i, one in enumerate(episodes))
        return sum(one.left(_solved(rest, penalty)) for one, rest in rests)

    return _solved(episodes, min(PENALTIES, key=left))


def _solved(episodes: Sequence[Moments], penalty: float) -> np.ndarray:
    """Weights (F, A); the constant, which is the first feature, is not penalised."""
    features = np.sum([one.features for one in episodes], axis=0)  # (F, F)
    cross = np.sum([one.cross for one in episodes], axis=0)  # (F, A)
    grown = penalty * sum(one.steps for one in episodes) * np.eye(len(features))
    grown[0, 0] = 0.0
    weights: np.ndarray = np.linalg.solve(features + grown, cross)
    return weights


def foretold_table(found: dict[str, Interval]) -> list[tuple[str, ...]]:
    """`foretold` as cells, heading first."""
    rows = [(name, f"{100 * r2.value:.1f} % [{100 * r2.low:.1f}, {100 * r2.high:.1f}]") for name, r2 in found.items()]
    return [("correction from h and A_0, learned on", "squared error on new scenes that it takes away"), *rows]
