import numpy as np
import pytest
import torch
from torchmetrics.functional.classification import binary_auroc

from ugr_lightning.errors import DataError
from ugr_lightning.rollout.traces import PredictionTrace
from ugr_lightning.uncertainty.failure import (
    auroc,
    detect_failures,
    overlap_score,
    scores_until,
    uncertainty_score,
)


def trace(seed, success, steps, query, *, chunks=None, log_variance=None):
    empty = np.zeros((len(query), 0))
    chunks = np.zeros((len(query), 5, 2)) if chunks is None else chunks
    contacts = np.zeros((steps + 1, 2), bool)
    return PredictionTrace(
        seed, success, steps, query, chunks, empty if log_variance is None else log_variance, contacts
    )


def episodes(good, bad, rise=0.0, seed=0):
    """Successes last 60 steps, failures 200; failures grow uncertain from step 20 on."""
    rng = np.random.default_rng(seed)
    made = []
    for index in range(good + bad):
        success = index < good
        steps = 60 if success else 200
        query = np.arange(0, steps, 2)
        log_variance = rng.normal(size=(len(query), 15)) * 0.1 + rng.normal() * 0.1
        if not success:
            log_variance += rise * (query >= 20)[:, None]
        made.append(trace(index, success, steps, query, log_variance=log_variance))
    return made


def test_auroc_is_that_of_torchmetrics():
    rng = np.random.default_rng(0)
    failed, succeeded = rng.normal(0.5, 1, 30).round(1), rng.normal(0, 1, 50).round(1)
    scores = torch.tensor(np.concatenate([failed, succeeded]))
    labels = torch.tensor([1] * 30 + [0] * 50)
    expected = binary_auroc(torch.sigmoid(scores), labels)  # any rising function of the score
    assert auroc(failed, succeeded) == pytest.approx(float(expected), abs=1e-6)


def test_only_queries_in_time_and_the_near_steps_of_a_chunk_count():
    log_variance = np.repeat([[2.0], [9.0]], 15, axis=1)
    log_variance[:, 10:] = 100
    one = trace(0, True, 8, np.array([0, 4]), log_variance=log_variance)
    assert [part.tolist() for part in scores_until(one, uncertainty_score, 4)] == [[0], [2]]
    assert [part.tolist() for part in scores_until(one, uncertainty_score, 5)] == [[0, 4], [2, 9]]


def test_chunks_that_disagree_with_earlier_ones_score_high_and_a_first_one_has_no_score():
    path = np.arange(12.0)[:, None]  # (steps, A)
    chunks = np.stack([path[step : step + 5] for step in (0, 2, 4)])  # all say the same
    query = np.array([0, 2, 4])
    chunks[2] += 6
    asked, scores = scores_until(trace(0, True, 8, query, chunks=chunks), overlap_score(np.array([2.0])), 8)
    assert asked.tolist() == [2, 4]
    assert scores.tolist() == [0, 3]  # 6, in standard deviations of 2


def test_an_episode_without_any_score_raises_no_alarm():
    short = [trace(seed, seed < 30, 9, np.arange(1 if seed % 2 else 9)) for seed in range(40)]
    found = detect_failures(short, overlap_score(np.ones(2)))
    assert (found.detected, found.false_alarms) == (0, 0)


def test_failures_that_grow_uncertain_are_detected_early():
    found = detect_failures(episodes(60, 20, rise=2.0))
    assert found.detected == 1
    assert found.auroc.value == found.auroc.low == 1
    assert 170 <= found.lead <= 180  # the alarm comes soon after step 20 of 200
    assert found.false_alarms <= 0.2
    assert (found.calibration, found.successes, found.failures) == (30, 30, 20)
    assert "100% of 20 failures" in str(found)


def test_a_policy_that_knows_nothing_warns_by_chance_although_its_failures_last_longer():
    found = [detect_failures(episodes(60, 20, seed=seed), resamples=10) for seed in range(12)]
    assert np.mean([alarms.auroc.value for alarms in found]) == pytest.approx(0.5, abs=0.1)
    assert np.mean([alarms.detected for alarms in found]) < 0.25


def test_too_few_episodes_are_refused():
    with pytest.raises(DataError, match="2 failed"):
        detect_failures(episodes(30, 1))
