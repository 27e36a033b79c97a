"""Whether one policy is better than another on the same seeds. Intervals of single rates: `rollout.results`."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy.stats import binomtest

from ugr_lightning.errors import DataError
from ugr_lightning.results.results import EpisodeResult, wilson_interval


class PairedTable(NamedTuple):
    """Outcomes of two policies, a and b, on the same seeds.

    Args:
        both: seeds on which both succeed.
        only_a: on which only a does.
        only_b: on which only b does.
        neither: on which neither does.
    """

    both: int
    only_a: int
    only_b: int
    neither: int

    @property
    def n(self) -> int:
        """Number of seeds."""
        return sum(self)


class Comparison(NamedTuple):
    """How policy a compares with policy b.

    Args:
        table: the paired outcomes.
        difference: success rate of a minus that of b.
        low, high: 95 % interval of the difference.
        p_value: exact two-sided McNemar test of no difference.
    """

    table: PairedTable
    difference: float
    low: float
    high: float
    p_value: float

    def __str__(self) -> str:
        return (
            f"{self.difference:+.1%} [{self.low:+.1%}, {self.high:+.1%}], n = {self.table.n}, "
            f"{self.table.only_a} against {self.table.only_b} seeds, p = {self.p_value:.3g}"
        )


def pair_by_seed(a: Sequence[EpisodeResult], b: Sequence[EpisodeResult]) -> PairedTable:
    """Count the outcomes of two policies seed by seed; a crashed episode is a failure.

    Args:
        a: episodes of one policy on one task, setting and execution mode.
        b: episodes of the other on the same seeds.

    Raises:
        DataError: other seeds, another task or another setting, or a seed that occurs twice.
    """
    outcomes = [_by_seed(results) for results in (a, b)]
    if set(outcomes[0]) != set(outcomes[1]):
        differing = sorted(set(outcomes[0]) ^ set(outcomes[1]))
        got = f"{len(differing)} episodes that only one of them has, such as {differing[0]}"
        raise DataError(
            "results", "two policies on the same task, setting and seeds", got, "Run both on one seed list."
        )
    counts = {(True, True): 0, (True, False): 0, (False, True): 0, (False, False): 0}
    for key, success in outcomes[0].items():
        counts[success, outcomes[1][key]] += 1
    return PairedTable(*counts.values())


def compare(a: Sequence[EpisodeResult], b: Sequence[EpisodeResult]) -> Comparison:
    """Difference, interval and test of two policies on the same seeds; arguments as in `pair_by_seed`."""
    table = pair_by_seed(a, b)
    low, high = paired_difference_interval(table)
    difference = (table.only_a - table.only_b) / table.n if table.n else 0.0
    return Comparison(table, difference, low, high, mcnemar(table.only_a, table.only_b))


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided p-value of the exact McNemar test.

    Args:
        only_a: pairs in which only the first succeeded.
        only_b: pairs in which only the second did.

    Returns:
        Probability, were both equally good, of a split at least as uneven; 1 when no pair differs.

    Source: McNemar (1947), with the binomial distribution instead of its normal approximation.
    """
    if only_a + only_b == 0:
        return 1.0
    return float(binomtest(only_a, only_a + only_b, 0.5).pvalue)


def paired_difference_interval(table: PairedTable) -> tuple[float, float]:
    """95 % interval of the difference of two success rates on the same seeds.

    Args:
        table: the paired outcomes.

    Returns:
        Lower and upper bound of rate a minus rate b, in -1 .. 1; (-1, 1) when nothing has been tried.

    Source: Newcombe (1998), "Improved confidence intervals for the difference between binomial proportions based on
        paired data", method 10: Wilson limits of both rates, joined with the correlation of the outcomes.
    """
    if table.n == 0:
        return -1.0, 1.0
    a, b = table.both + table.only_a, table.both + table.only_b
    rate_a, rate_b = a / table.n, b / table.n
    (low_a, high_a), (low_b, high_b) = wilson_interval(a, table.n), wilson_interval(b, table.n)
    correlation = _correlation(table)

    def joined(x: float, y: float) -> float:
        return math.sqrt(max(0.0, x * x - 2 * correlation * x * y + y * y))

    difference = rate_a - rate_b
    low = difference - joined(rate_a - low_a, high_b - rate_b)
    high = difference + joined(high_a - rate_a, rate_b - low_b)
    return max(-1.0, low), min(1.0, high)


def _correlation(table: PairedTable) -> float:
    """Correlation of the paired outcomes, with Newcombe's correction for continuity where it is positive."""
    a, b = table.both + table.only_a, table.both + table.only_b
    margins = a * (table.n - a) * b * (table.n - b)
    if margins == 0:
        return 0.0
    covariance = table.both * table.neither - table.only_a * table.only_b
    if covariance > 0:
        return max(covariance - table.n / 2, 0) / math.sqrt(margins)
    return covariance / math.sqrt(margins)


def _by_seed(results: Sequence[EpisodeResult]) -> dict[tuple[str, str, int], bool]:
    outcomes = {(item.task, item.setting, item.seed): item.success and item.crash is None for item in results}
    if len(outcomes) != len(results):
        got = f"{len(results)} episodes of {len(outcomes)} seeds"
        fix = "Compare one policy and one execution mode at a time."
        raise DataError("results", "each seed once", got, fix)
    return outcomes
