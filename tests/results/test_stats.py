import itertools

import numpy as np
import pytest
from made_up import episodes
from scipy.stats import binom, binomtest

from ugr_lightning.errors import DataError
from ugr_lightning.results.stats import (
    PairedTable,
    compare,
    mcnemar,
    pair_by_seed,
    paired_difference_interval,
)


def test_mcnemar_is_the_sum_of_the_tails_of_the_binomial_distribution():
    for a, b in itertools.product(range(12), repeat=2):
        n, few = a + b, min(a, b)
        by_hand = min(1.0, 2 * binom.cdf(few, n, 0.5)) if a != b else 1.0
        assert mcnemar(a, b) == pytest.approx(by_hand, abs=1e-12)
    assert mcnemar(0, 0) == 1.0


@pytest.mark.parametrize("table", [(20, 20, 30, 30), (0, 12, 0, 38), (30, 10, 15, 5)])
def test_without_correlation_the_interval_joins_the_wilson_limits_as_for_independent_rates(table):
    both, only_a, only_b, neither = table
    assert both * neither == only_a * only_b
    n = sum(table)
    rates, limits = [(both + only_a) / n, (both + only_b) / n], []
    for rate in rates:
        interval = binomtest(round(rate * n), n).proportion_ci(method="wilson")
        limits.append((interval.low, interval.high))
    low = rates[0] - rates[1] - np.hypot(rates[0] - limits[0][0], limits[1][1] - rates[1])
    high = rates[0] - rates[1] + np.hypot(limits[0][1] - rates[0], rates[1] - limits[1][0])
    assert paired_difference_interval(PairedTable(*table)) == pytest.approx((low, high), abs=1e-9)


def test_the_interval_mirrors_when_the_policies_are_swapped():
    low, high = paired_difference_interval(PairedTable(50, 13, 4, 33))
    assert paired_difference_interval(PairedTable(50, 4, 13, 33)) == pytest.approx((-high, -low))


def test_the_interval_covers_the_true_difference_about_as_often_as_it_says():
    generator = np.random.default_rng(0)
    cells = np.array([0.35, 0.2, 0.1, 0.35])
    tables = generator.multinomial(100, cells, size=2000)
    covered = [
        low <= 0.1 <= high for low, high in (paired_difference_interval(PairedTable(*t)) for t in tables.tolist())
    ]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.02)


def test_extreme_tables_stay_within_minus_one_and_one():
    for table in itertools.product((0, 1, 7), repeat=4):
        low, high = paired_difference_interval(PairedTable(*table))
        difference = (table[1] - table[2]) / max(1, sum(table))
        assert -1 <= low <= difference + 1e-12
        assert difference - 1e-12 <= high <= 1


def test_outcomes_are_paired_by_seed_and_not_by_order():
    a, b = episodes([1, 1, 0, 0, 1]), episodes([1, 0, 1, 0, 0])
    assert pair_by_seed(a, b[::-1]) == PairedTable(both=1, only_a=2, only_b=1, neither=1)


def test_a_crashed_episode_counts_as_a_failure():
    assert pair_by_seed(episodes([1, 1]), episodes([1, 1], crash="signal 11")) == PairedTable(0, 2, 0, 0)


def test_a_comparison_says_difference_interval_n_and_p():
    result = compare(episodes([1] * 9 + [0]), episodes([0] * 9 + [1]))
    assert result.difference == pytest.approx(0.8)
    assert result.low < 0.8 < result.high
    assert result.p_value == pytest.approx(22 / 1024)
    assert "+80.0%" in str(result)
    assert "n = 10" in str(result)


@pytest.mark.parametrize(
    "other",
    [episodes([1, 1], first_seed=7), episodes([1, 1, 1]), episodes([1, 1], task="handover_block"), episodes([1]) * 2],
)
def test_episodes_that_do_not_pair_up_are_refused(other):
    with pytest.raises(DataError):
        compare(episodes([1, 1]), other)
