"""Runtime failure detection: whether the policy's uncertainty warns before an episode fails.

A conformal threshold is set on successful episodes, so that a new successful one raises an alarm with at most a chosen
probability; the others, held out, show how many failures it catches and how early.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import mannwhitneyu

from ugr_lightning.analysis.calibration import Interval
from ugr_lightning.errors import DataError
from ugr_lightning.rollout.traces import UncertaintyTrace

HORIZON = 10
"""Steps of a chunk that a step's score looks ahead."""


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
        level: largest probability of an alarm in a successful episode that was asked for.
    """

    threshold: float
    calibration: int
    successes: int
    failures: int
    false_alarms: float
    detected: float
    lead: float
    auroc: Interval
    level: float

    def __str__(self) -> str:
        when = "" if math.isnan(self.lead) else f", {self.lead:.0f} steps (median) before their end"
        return (
            f"A threshold of {self.threshold:.3g} from {self.calibration} successful episodes raises an alarm in "
            f"{self.false_alarms:.0%} of {self.successes} other successes ({self.level:.0%} expected at most) and in "
            f"{self.detected:.0%} of {self.failures} failures{when}; AUROC {self.auroc}, 0.5 by chance."
        )


def step_scores(trace: UncertaintyTrace, until: int, horizon: int = HORIZON) -> np.ndarray:
    """The uncertainty of the near future at each query: mean of s_k over the first steps of the chunk.

    Args:
        trace: one episode.
        until: control steps that count. An episode ends when it succeeds, so that failures are longer, and a maximum
            over more steps is higher by itself: compare all episodes over the same time.
        horizon: steps of the chunk.

    Returns:
        (Q',) scores of the queries before `until`.
    """
    return trace.log_variance[trace.query < until, :horizon].mean(1)


def running_maximum(scores: np.ndarray, window: int = 5) -> np.ndarray:
    """Highest average of `window` queries so far, (Q,), -inf before the first: a single uncertain query is no alarm."""
    width = min(window, len(scores))
    smooth = np.convolve(scores, np.ones(width) / width, mode="valid")  # (Q - width + 1,)
    return np.maximum.accumulate(np.concatenate([np.full(width - 1, -np.inf), smooth]))


def conformal_threshold(scores: np.ndarray, level: float = 0.1) -> float:
    """The threshold that a new score of the same kind exceeds with at most a given probability.

    Args:
        scores: (n,) highest scores of successful episodes.
        level: that probability.

    Returns:
        The ceil((n + 1) (1 - level))-th smallest score.

    Raises:
        DataError: too few episodes for the level.

    Source: Vovk et al. (2005), split conformal prediction.
    """
    rank = math.ceil((len(scores) + 1) * (1 - level) - 1e-9)
    if rank > len(scores):
        least = math.ceil(1 / level) - 1
        fix = "Roll out more episodes, or allow more false alarms."
        raise DataError("successful episodes", f"at least {least} for a level of {level:g}", len(scores), fix)
    return float(np.sort(scores)[rank - 1])


def auroc(failed: np.ndarray, succeeded: np.ndarray) -> float:
    """Probability that a failed episode's score is above a successful one's; ties count half."""
    statistic = mannwhitneyu(failed, succeeded).statistic
    return float(statistic / (len(failed) * len(succeeded)))


def detect_failures(
    traces: Sequence[UncertaintyTrace], *, level: float = 0.1, seed: int = 0, resamples: int = 500
) -> Alarms:
    """Set a threshold on half of the successful episodes and try it on all other episodes.

    All episodes count up to the median length of the successful ones, so that an alarm must come from what the policy
    says and not from how long the episode lasts.

    Args:
        traces: episodes of one policy, task and execution, each seed once.
        level: largest probability of an alarm in a successful episode.
        seed: of the halves and of the bootstrap.
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
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(good))
    half = len(good) // 2
    paths = [[running_maximum(step_scores(trace, until)) for trace in part] for part in (good, bad)]
    highest_good, highest_bad = (np.array([path[-1] for path in part]) for part in paths)
    threshold = conformal_threshold(highest_good[order[:half]], level)
    held_out = highest_good[order[half:]]
    leads = [
        trace.steps - int(trace.query[int(np.argmax(path > threshold))])
        for trace, path in zip(bad, paths[1], strict=True)
        if path[-1] > threshold
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
        level=level,
    )
