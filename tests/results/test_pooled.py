import itertools

import numpy as np
import pytest
from scipy.stats import permutation_test

from ugr_lightning.results.pooled import hierarchical_bootstrap, holm, sign_flip_test
from ugr_lightning.results.stats import mcnemar


def test_holm_gives_the_textbook_values():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02], abs=1e-15)
    assert holm([]) == []
    assert holm([0.7, 0.9]) == [1.0, 1.0]


def test_holm_agrees_with_statsmodels():
    reference = pytest.importorskip("statsmodels.stats.multitest").multipletests
    rng = np.random.default_rng(1)
    for n in rng.integers(1, 12, size=20):
        p = rng.uniform(size=n) ** rng.integers(1, 5)
        assert holm(p) == pytest.approx(reference(p, method="holm")[1], abs=1e-12)


def test_a_sign_flip_test_of_single_episodes_is_mcnemars():
    for a, b in itertools.product(range(9), repeat=2):
        assert sign_flip_test([1] * a + [-1] * b + [0] * 5) == pytest.approx(mcnemar(a, b), abs=1e-12)


def test_a_sign_flip_test_counts_every_pattern_of_signs():
    rng = np.random.default_rng(2)
    for _ in range(10):
        differences = rng.integers(-3, 4, size=8)
        scipys = permutation_test((differences,), np.sum, permutation_type="samples", n_resamples=np.inf).pvalue
        assert sign_flip_test(differences) == pytest.approx(scipys, abs=1e-12)


def test_a_bootstrap_over_one_training_seed_has_the_spread_of_the_paired_difference():
    rng = np.random.default_rng(4)
    a, b = (rng.binomial(1, p, size=(1, 400)) for p in (0.8, 0.6))
    low, high = hierarchical_bootstrap([a], [b])
    difference = (a - b)[0]
    assert high - low == pytest.approx(2 * 1.96 * difference.std() / 20, rel=0.05)
    assert low < difference.mean() < high
    assert hierarchical_bootstrap([a], [b]) == (low, high), "equal seeds give equal intervals"
    assert hierarchical_bootstrap([a], [b], seed=1) != (low, high)


def test_training_seeds_that_disagree_widen_the_interval():
    agreeing = np.tile(np.array([[1] * 70 + [0] * 30]), (4, 1))
    disagreeing = np.stack([np.array([1] * n + [0] * (100 - n)) for n in (100, 40, 100, 40)])
    other = np.tile(np.array([[1] * 50 + [0] * 50]), (4, 1))
    (narrow, _), (wide, _) = (hierarchical_bootstrap([one], [other]) for one in (agreeing, disagreeing))
    assert narrow > 0 > wide


def test_tasks_weigh_the_same_however_many_seeds_they_have():
    a, b = [np.ones((1, 10)), np.zeros((2, 90))], [np.zeros((1, 10)), np.zeros((2, 90))]
    assert hierarchical_bootstrap(a, b) == pytest.approx((0.5, 0.5))


def test_outcomes_on_other_seeds_are_refused():
    with pytest.raises(ValueError, match="against"):
        hierarchical_bootstrap([np.ones((1, 4))], [np.ones((1, 5))])
