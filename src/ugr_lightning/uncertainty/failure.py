"""Runtime failure detection: whether what a policy predicts warns before an episode fails.

A conformal threshold is set on successful episodes, so that a new successful one raises an alarm with at most a chosen
probability; the others, held out, show how many failures it catches and how early.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import mannwhitneyu

from ugr_lightning.errors import DataError
from ugr_lightning.rollout.alarm import conformal_threshold
from ugr_lightning.rollout.overlap import HORIZON, Overlap, near_disagreement
from ugr_lightning.rollout.traces import PredictionTrace
from ugr_lightning.uncertainty.calibration import Interval

FALSE_ALARM_RATE = 0.1
"""Largest probability of an alarm in a successful episode."""

Score = Callable[[PredictionTrace], np.ndarray]
"""What an alarm goes by: (Q,), a number for each query, higher where more trouble is expected; NaN if unknown."""


class Alarms(NamedTuple):
    """How a threshold does on held-out episodes.

    Args:
        threshold: the score above which an alarm is raised.
        calibration: successful episodes that it was set on.
        successes, failures: held-out episodes.
        false_alarms: share of held-out successes with an alarm.
        detected: share of failures with an alarm.
        lead: median control steps between the alarm and the end of a failed episode that had one; NaN without any.
        auroc: probability that a failed episode's highest score is above a successful one's, with an interval.
    """

    threshold: float
    calibration: int
    successes: int
    failures: int
    false_alarms: float
    detected: float
    lead: float
    auroc: Interval

    def __str__(self) -> str:
        when = "" if math.isnan(self.lead) else f", {self.lead:.0f} steps (median) before their end"
        return (
            f"A threshold of {self.threshold:.3g} from {self.calibration} successful episodes raises an alarm in "
            f"{self.false_alarms:.0%} of {self.successes} other successes ({FALSE_ALARM_RATE:.0%} expected at most) "
            f"and in {self.detected:.0%} of {self.failures} failures{when}; AUROC {self.auroc}, 0.5 by chance."
        )


def uncertainty_score(trace: PredictionTrace) -> np.ndarray:
    """What the policy says of the near future: mean of s_k over the first steps of each chunk, (Q,)."""
    return trace.log_variance[:, :HORIZON].mean(1)


def overlap_score(unit: np.ndarray) -> Score:
    """How far the first steps of a chunk are from what earlier chunks said about the same moments; any policy has it.

    Args:
        unit: (A,) what a distance of 1 is in each action, see `action_unit`.
    """

    def score(trace: PredictionTrace) -> np.ndarray:
        overlap = Overlap(trace.chunks.shape[1], unit)
        asked = zip(trace.query, trace.chunks, strict=True)
        return np.array([near_disagreement(overlap.push(step, chunk)) for step, chunk in asked])  # (Q,)

    return score


def scores_until(trace: PredictionTrace, score: Score, until: int) -> tuple[np.ndarray, np.ndarray]:
    """The queries of an episode that have a score, and their scores.

    Args:
        trace: one episode.
        score: what the alarm goes by.
        until: control steps that count. An episode ends when it succeeds, so that failures are longer, and a maximum
            over more steps is higher by itself: compare all episodes over the same time.

    Returns:
        (Q',) control steps and (Q',) scores, of the queries before `until`.
    """
    values = score(trace)
    counts = (trace.query < until) & ~np.isnan(values)
    return trace.query[counts], values[counts]


def auroc(failed: np.ndarray, succeeded: np.ndarray) -> float:
    """Probability that a failed episode's score is above a successful one's; ties count half."""
    statistic = mannwhitneyu(failed, succeeded).statistic
    return float(statistic / (len(failed) * len(succeeded)))


def detect_failures(
    traces: Sequence[PredictionTrace], score: Score = uncertainty_score, *, resamples: int = 500
) -> Alarms:
    """Set a threshold on half of the successful episodes and try it on all other episodes.

    All episodes count up to the median length of the successful ones, so that an alarm must come from what the policy
    says and not from how long the episode lasts.

    Args:
        traces: episodes of one policy, task and execution, each seed once.
        score: what the alarm goes by.
        resamples: draws of the bootstrap over episodes.

    Raises:
        DataError: too few successful or failed episodes.
    """
    good = [trace for trace in traces if trace.success]
    bad = [trace for trace in traces if not trace.success]
    if len(bad) < 2 or len(good) < 4:
        got = f"{len(good)} and {len(bad)}"
        raise DataError("traces", "at least 4 successful and 2 failed episodes", got, "Roll out more of them.")
    until = int(np.median([trace.steps for trace in good]))
    rng = np.random.default_rng(0)
    order = rng.permutation(len(good))
    half = len(good) // 2
    scored = [[scores_until(trace, score, until) for trace in part] for part in (good, bad)]
    paths = [[np.maximum.accumulate(values) for _, values in part] for part in scored]
    highest_good, highest_bad = (np.array([path[-1] if len(path) else -np.inf for path in part]) for part in paths)
    threshold = conformal_threshold(highest_good[order[:half]], FALSE_ALARM_RATE)
    held_out = highest_good[order[half:]]
    leads = [
        trace.steps - int(query[int(np.argmax(path > threshold))])
        for trace, (query, _), path in zip(bad, scored[1], paths[1], strict=True)
        if (path > threshold).any()
    ]
    draws = [
        auroc(rng.choice(highest_bad, len(highest_bad)), rng.choice(held_out, len(held_out))) for _ in range(resamples)
    ]
    low, high = np.percentile(draws, (2.5, 97.5))
    return Alarms(
        threshold=threshold,
        calibration=half,
        successes=len(held_out),
        failures=len(bad),
        false_alarms=float(np.mean(held_out > threshold)),
        detected=len(leads) / len(bad),
        lead=float(np.median(leads)) if leads else float("nan"),
        auroc=Interval(auroc(highest_bad, held_out), float(low), float(high)),
    )
