"""Every statistic against another way to compute it."""

import numpy as np
import pytest
import torch
from scipy import stats
from torchmetrics.functional.regression import spearman_corrcoef

from ugr_lightning.errors import DataError
from ugr_lightning.uncertainty import calibration as kit

N, K = 40, 12


@pytest.fixture
def arrays():
    """Errors whose size s knows in part; the last steps of some samples are padded. Values repeat."""
    rng = np.random.default_rng(0)
    score = rng.normal(size=(N, K)).round(1)
    error = np.abs(rng.normal(size=(N, K)) * np.exp(score / 2)).round(2) + 0.1 * np.arange(K)
    error[::3, 9:] = np.nan
    return error, score


def test_position_mean_is_the_mean_of_what_is_known(arrays):
    assert np.allclose(kit.position_mean(arrays[0]), np.nanmean(arrays[0], axis=0))


def test_spearman_is_that_of_scipy_and_torchmetrics(arrays):
    error, score = arrays
    known = ~np.isnan(error)
    found = kit.spearman(error, score)
    assert found == pytest.approx(stats.spearmanr(error[known], score[known]).statistic, abs=1e-12)
    assert found == pytest.approx(
        float(spearman_corrcoef(torch.tensor(score[known]), torch.tensor(error[known]))), abs=1e-5
    )


def test_spearman_within_position_is_the_correlation_of_what_a_regression_on_the_position_leaves(arrays):
    error, score = arrays
    known = ~np.isnan(error)
    design = np.eye(K)[np.nonzero(known)[1]]
    left = []
    for values in (error, score):
        ranks = stats.rankdata(values[known])
        left.append(ranks - design @ np.linalg.lstsq(design, ranks, rcond=None)[0])
    assert kit.spearman_within_position(error, score) == pytest.approx(np.corrcoef(*left)[0, 1], abs=1e-12)


def test_a_score_that_only_knows_the_position_explains_nothing_within_it(arrays):
    error, _ = arrays
    prior = np.broadcast_to(np.arange(float(K)), error.shape)
    assert kit.spearman(error, prior) > 0.1
    assert np.isnan(kit.spearman_within_position(error, prior))


def test_recall_counts_the_common_steps(arrays):
    error, score = arrays
    for row, found in enumerate(kit.recall(error, score, 4)):
        known = [k for k in range(K) if not np.isnan(error[row, k])]
        worst = set(sorted(known, key=lambda k: (-error[row, k], k))[:4])
        chosen = set(sorted(known, key=lambda k: (-score[row, k], k))[:4])
        assert found == len(worst & chosen) / 4
    assert np.all(kit.recall(error, error, 4) == 1)


def test_a_sample_without_known_steps_has_no_recall():
    nothing = np.full((1, 5), np.nan)
    assert np.isnan(kit.recall(nothing, np.zeros((1, 5)), 2)).all()


def test_sparsification_removes_the_highest_scores_first(arrays):
    error, score = arrays
    known = ~np.isnan(error)
    values = error[known]
    for fraction, found in zip(kit.FRACTIONS, kit.sparsification(error, score), strict=True):
        keep = round((1 - fraction) * len(values))
        kept = values[np.argsort(score[known], kind="stable")][:keep]
        assert found == pytest.approx(kept.mean() / values.mean())


def test_ause_is_zero_for_the_error_itself_and_grows_with_ignorance(arrays):
    error, score = arrays
    assert kit.ause(error, error) == 0
    assert 0 < kit.ause(error, score) < kit.ause(error, -score)


def test_nll_is_that_of_scipy_and_coverage_is_nominal_for_gaussian_errors():
    rng = np.random.default_rng(1)
    log_variance = rng.normal(size=(400, K))
    error = np.abs(rng.normal(size=(400, K))) * np.exp(log_variance / 2)
    expected = -stats.norm.logpdf(error, scale=np.exp(log_variance / 2))
    assert np.allclose(kit.gaussian_nll(error, log_variance), expected)
    assert kit.coverage(error, log_variance) == pytest.approx(kit.LEVELS, abs=0.02)
    assert (kit.coverage(error, log_variance - 2) < kit.LEVELS).all()


def test_bootstrap_agrees_with_scipy_and_resamples_episodes_not_rows():
    rng = np.random.default_rng(3)
    episode = np.repeat(np.arange(12), 20)
    values = rng.normal(size=12)[episode]  # rows of an episode are equal: 12 observations, not 240
    found = kit.bootstrap(lambda rows: np.array([values[rows].mean(), 1.0]), episode, 2000)
    expected = stats.bootstrap((values[::20],), np.mean, n_resamples=2000, method="percentile", rng=rng)
    assert found[0].value == pytest.approx(values.mean())
    assert found[0][1:] == pytest.approx(tuple(expected.confidence_interval), abs=0.08)
    assert found[1] == (1.0, 1.0, 1.0)


def test_one_episode_gives_no_interval():
    with pytest.raises(DataError, match="2 episodes"):
        kit.bootstrap(lambda rows: np.zeros(1), np.zeros(5))
