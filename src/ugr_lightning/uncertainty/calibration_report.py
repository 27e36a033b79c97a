"""What `ugr analyze` says about a policy's uncertainty: numbers with intervals, curves, and one sentence."""

from typing import Any, NamedTuple

import numpy as np

from ugr_lightning.data.episode import Episode
from ugr_lightning.results.tables import Cells
from ugr_lightning.uncertainty import calibration as kit
from ugr_lightning.uncertainty.calibration import Interval
from ugr_lightning.uncertainty.events import (
    KINDS,
    align,
    find_events,
    mean_by_lag,
    near_to_far,
    relative_to_position,
)
from ugr_lightning.uncertainty.predictions import Predictions

REACH = 20
"""Control steps around an event that the figures show."""
NEAR = 5
"""Control steps around an event that count as near it."""
RECALL, WITHIN = "recall of the worst steps", "Spearman within position"


class Row(NamedTuple):
    """One statistic of the predicted uncertainty beside those of simpler rivals.

    Args:
        name: what it is.
        better: `higher` or `lower`.
        learned: of s_k.
        prior: of the position prior, the static mean error by position on the training episodes.
        constant: of chance, or of one variance for all steps; NaN where that makes no sense.
        difference: learned minus prior.
    """

    name: str
    better: str
    learned: Interval
    prior: Interval
    constant: float
    difference: Interval


def compare_with_prior(validation: Predictions, training: Predictions, budget: int, resamples: int = 500) -> list[Row]:
    """Every statistic of s_k, of the position prior and of a constant, with intervals over validation episodes.

    Args:
        validation: predictions on the validation episodes, with log-variance.
        training: those on the training episodes; what the rivals are fitted on.
        budget: steps that the policy refines, M.
        resamples: draws of the bootstrap.
    """
    error, learned = validation.coarse, validation.log_variance
    assert learned is not None
    prior = np.broadcast_to(kit.position_mean(training.coarse), error.shape)  # (n, K)
    by_position = np.log(kit.position_mean(np.square(training.coarse)))  # (K,)
    constant = np.log(np.nanmean(np.square(training.coarse)))
    recalls = np.stack([kit.recall(error, score, budget) for score in (learned, prior)])  # (2, n)
    scaled = [variance + _scale(error, variance) for variance in (learned, by_position, constant)]
    nll = np.stack([kit.gaussian_nll(error, variance) for variance in (learned, by_position, constant)])  # (3, n, K)
    nll_scaled = np.stack([kit.gaussian_nll(error, variance) for variance in scaled])  # (3, n, K)
    share = float(np.mean(np.minimum(1.0, budget / (~np.isnan(error)).sum(1))))

    def statistics(rows: np.ndarray) -> np.ndarray:
        e, s, p = error[rows], learned[rows], prior[rows]
        pairs = [
            (kit.spearman(e, s), kit.spearman(e, p)),
            (kit.spearman_within_position(e, s), np.nan),
            np.nanmean(recalls[:, rows], axis=1),
            (kit.ause(e, s), kit.ause(e, p)),
            *((np.nanmean(values[0, rows]), np.nanmean(values[1, rows])) for values in (nll, nll_scaled)),
        ]
        table = np.array(pairs)  # (J, 2)
        return np.concatenate([table, table[:, :1] - table[:, 1:]], axis=1).ravel()

    found = kit.bootstrap(statistics, validation.episode, resamples)
    ceiling = kit.sparsification(error, error)
    chance = [0.0, 0.0, share, float(np.trapezoid(1 - ceiling, kit.FRACTIONS))]
    chance += [float(np.nanmean(nll[2])), float(np.nanmean(nll_scaled[2]))]
    names = ["Spearman with the error", WITHIN, RECALL, "AUSE", "NLL, nats", "NLL, scale corrected"]
    better = ["higher"] * 3 + ["lower"] * 3
    return [
        Row(name, direction, found[3 * i], found[3 * i + 1], chance[i], found[3 * i + 2])
        for i, (name, direction) in enumerate(zip(names, better, strict=True))
    ]


def _scale(error: np.ndarray, log_variance: np.ndarray | float) -> float:
    """The one constant on all log-variances that fits these errors best."""
    return float(np.log(np.nanmean(np.square(error) * np.exp(-np.asarray(log_variance)))))


def calibration_verdict(rows: list[Row], episodes: int, budget: int) -> str:
    """One sentence on whether s_k beats the position prior, by the interval of the difference in recall."""
    by_name = {row.name: row for row in rows}
    row, within = by_name[RECALL], by_name[WITHIN].learned
    if row.difference.low > 0:
        says = "beats"
    elif row.difference.high < 0:
        says = "does worse than"
    else:
        says = "cannot be told apart from"
    points = [f"{100 * value:+.0f}" for value in row.difference]
    return (
        f"On {episodes} validation episodes s_k {says} the position prior: {row.learned.value:.0%} of the {budget} "
        f"worst steps of a chunk are among the {budget} that s_k ranks highest, {row.prior.value:.0%} among the "
        f"prior's and {row.constant:.0%} by chance (difference {points[0]} points, 95 % interval {points[1]} to "
        f"{points[2]}), and within a position its rank correlation with the error is {within.value:+.2f} "
        f"[{within.low:+.2f}, {within.high:+.2f}]."
    )


def generalisation(validation: Predictions, training: Predictions, budget: int) -> dict[str, dict[str, float]]:
    """What s_k knows on the episodes it was trained on and on the others, so that not learning and not generalising
    can be told apart.
    """
    found = {}
    for name, part in (("training", training), ("validation", validation)):
        assert part.log_variance is not None
        found[name] = {
            "mean error": float(np.nanmean(part.coarse)),
            "Spearman with the error": kit.spearman(part.coarse, part.log_variance),
            WITHIN: kit.spearman_within_position(part.coarse, part.log_variance),
            RECALL: float(np.nanmean(kit.recall(part.coarse, part.log_variance, budget))),
        }
    return found


def curves(validation: Predictions, training: Predictions) -> dict[str, Any]:
    """What the figures draw: means by position, sparsification, coverage, and error by predicted deviation."""
    error, learned = validation.coarse, validation.log_variance
    assert learned is not None
    prior = kit.position_mean(training.coarse)  # (K,)
    position = np.log(kit.position_mean(np.square(training.coarse)))  # (K,)
    constant = np.log(np.nanmean(np.square(training.coarse)))
    scores = {"learned": learned, "prior": np.broadcast_to(prior, error.shape), "oracle": error}
    variances = {"learned": learned, "position": position, "constant": constant}
    known = ~np.isnan(error)
    order = np.argsort(learned[known], kind="stable")
    bins = np.array_split(order, 10)
    return {
        "position": {
            "error": kit.position_mean(error),
            "training_error": prior,
            "deviation": np.exp(learned / 2).mean(0),
            "refined": np.zeros(error.shape[1]) if validation.refined is None else validation.refined.mean(0),
        },
        "sparsification": {
            "fractions": kit.FRACTIONS,
            **{name: kit.sparsification(error, score) for name, score in scores.items()},
        },
        "coverage": {
            "levels": np.array(kit.LEVELS),
            **{name: kit.coverage(error, variance) for name, variance in variances.items()},
        },
        "reliability": {
            "deviation": np.array([np.sqrt(np.mean(np.exp(learned[known][part]))) for part in bins]),
            "error": np.array([np.sqrt(np.mean(np.square(error[known][part]))) for part in bins]),
        },
    }


def around_events(validation: Predictions, episodes: list[Episode], resamples: int = 500) -> dict[str, dict[str, Any]]:
    """Error and s_k aligned to contacts and gripper commands of the validation episodes, by kind of event.

    Error and deviation are also given relative to the mean of their position in the chunk, because events late in an
    episode are met late in a chunk more often.

    Args:
        validation: predictions, with log-variance.
        episodes: all demonstrations, by position.
        resamples: draws of the bootstrap over episodes.

    Returns:
        By kind that occurs and that the demonstrations tell of: `count` of events, `lag` with means by lag, and
        `error_near` and `deviation_near`, intervals of the relative value near events over that elsewhere.
    """
    assert validation.log_variance is not None
    lengths = np.array([episode.length for episode in episodes])
    here = {int(name): find_events(episodes[int(name)]) for name in np.unique(validation.episode)}
    n, K = validation.coarse.shape
    inside = validation.step[:, None] + np.arange(K) < lengths[validation.episode][:, None]  # (n, K)
    error = np.where(inside, validation.coarse, np.nan)  # (n, K)
    deviation = np.where(inside, np.exp(validation.log_variance / 2), np.nan)  # (n, K)
    relative = [relative_to_position(values) for values in (error, deviation)]
    found = {}
    for kind in KINDS:
        events = {name: events[kind] for name, events in here.items() if len(events.get(kind, ()))}
        if not events:
            continue
        aligned = align(validation.episode, validation.step, K, lengths, events, REACH)
        near = np.zeros((n, K), bool)
        close = np.abs(aligned.lag) <= NEAR
        near[aligned.row[close], aligned.position[close]] = True

        def ratios(rows: np.ndarray, near: np.ndarray = near) -> np.ndarray:
            return np.array([near_to_far(values[rows], near[rows], inside[rows]) for values in relative])

        error_near, deviation_near = kit.bootstrap(ratios, validation.episode, resamples)
        found[kind] = {
            "count": int(sum(map(len, events.values()))),
            "error_near": error_near,
            "deviation_near": deviation_near,
            "lag": np.arange(-REACH, REACH + 1),
            "error": mean_by_lag(error, aligned, REACH),
            "log_variance": mean_by_lag(validation.log_variance, aligned, REACH),
            "relative_error": mean_by_lag(relative[0], aligned, REACH),
            "relative_deviation": mean_by_lag(relative[1], aligned, REACH),
        }
    return found


def table(rows: list[Row]) -> Cells:
    """The comparison as cells, heading first."""
    cells: Cells = [("statistic", "better", "s_k", "position prior", "constant or chance", "s_k - prior")]
    for row in rows:
        shown = [_cell(row.learned), _cell(row.prior), f"{row.constant:.3g}", _cell(row.difference)]
        cells.append((row.name, row.better, *shown))
    return cells


def event_table(events: dict[str, dict[str, Any]]) -> Cells:
    """Error and predicted deviation near events over those elsewhere, as cells, heading first."""
    cells: Cells = [("event", "count", f"error within {NEAR} steps / elsewhere", "predicted deviation, likewise")]
    for kind, of in events.items():
        cells.append((kind, str(of["count"]), _cell(of["error_near"]), _cell(of["deviation_near"])))
    return cells


def coverage_table(found: dict[str, Any]) -> Cells:
    """Nominal and actual coverage, as cells, heading first."""
    of = found["coverage"]
    cells: Cells = [("nominal coverage", "s_k", "position only", "constant variance")]
    for level, *actual in zip(of["levels"], of["learned"], of["position"], of["constant"], strict=True):
        cells.append((f"{level:.0%}", *(f"{value:.0%}" for value in actual)))
    return cells


def _cell(interval: Interval) -> str:
    return "-" if np.isnan(interval.value) else str(interval)


def generalisation_table(found: dict[str, dict[str, float]]) -> Cells:
    """`generalisation` as cells, heading first."""
    names = list(found["training"])
    rows = [(name, *(f"{part[name]:.3g}" for part in found.values())) for name in names]
    return [("s_k on episodes of the", *found), *rows]
