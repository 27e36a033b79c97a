import numpy as np
import pytest

from ugr_lightning.errors import ConfigError
from ugr_lightning.rollout.aggregation import ChunkExecution, TemporalAggregation, make_execution

K, A, T = 7, 3, 25


def offline(chunks, decay):
    """The table of the public codes: column t holds every prediction made for step t, oldest first."""
    actions = []
    for step in range(T):
        queries = range(max(0, step - K + 1), step + 1)
        rows = np.stack([chunks[query][step - query] for query in queries if chunks[query] is not None])
        weights = np.exp(-decay * np.arange(len(rows)))
        actions.append((rows * (weights / weights.sum())[:, None]).sum(0))
    return np.stack(actions)


def online(aggregation, chunks, slot=0):
    actions = []
    for chunk in chunks:
        if chunk is not None:
            aggregation.push(slot, chunk)
        actions.append(aggregation.next(slot))
    return np.stack(actions)


@pytest.mark.parametrize("decay", [0.01, 0.5, -0.1, 0.0])
def test_online_aggregation_equals_the_offline_table(decay):
    chunks = list(np.random.default_rng(0).normal(size=(T, K, A)))
    assert np.abs(online(TemporalAggregation(K, A, decay), chunks) - offline(chunks, decay)).max() < 1e-6


def test_online_aggregation_is_exact_when_some_steps_are_not_queried():
    chunks = list(np.random.default_rng(1).normal(size=(T, K, A)))
    chunks[1::3] = [None] * len(chunks[1::3])
    assert np.abs(online(TemporalAggregation(K, A, 0.3), chunks) - offline(chunks, 0.3)).max() < 1e-6


def test_weights_by_variance_are_those_of_the_table_times_the_inverse_variance():
    rng = np.random.default_rng(3)
    chunks, log_variance = rng.normal(size=(T, K, A)), rng.normal(size=(T, K))
    aggregation = TemporalAggregation(K, A, 0.3, by_variance=True)
    for step in range(T):
        aggregation.push(0, chunks[step], log_variance[step].astype(np.float32))
        queries = np.arange(max(0, step - K + 1), step + 1)
        weights = np.exp(-0.3 * np.arange(len(queries)) - log_variance[queries, step - queries])
        expected = (chunks[queries, step - queries] * weights[:, None]).sum(0) / weights.sum()
        assert np.allclose(aggregation.next(0), expected, atol=1e-5)


def test_equal_variances_change_nothing_and_a_very_uncertain_prediction_is_ignored():
    plain, weighted = TemporalAggregation(2, 1), TemporalAggregation(2, 1, by_variance=True)
    for aggregation in (plain, weighted):
        aggregation.push(0, np.array([[0.0], [1.0]]), np.full(2, -3.0))
        aggregation.next(0)
        aggregation.push(0, np.array([[4.0], [0.0]]), np.full(2, -3.0))
    assert plain.next(0) == pytest.approx(weighted.next(0))
    weighted.push(0, np.array([[100.0], [0.0]]), np.array([10.0, 0.0]))
    assert weighted.next(0)[0] == pytest.approx(0, abs=0.01)


def test_weights_by_variance_need_a_policy_that_predicts_one():
    with pytest.raises(ConfigError, match="log-variance"):
        TemporalAggregation(K, A, by_variance=True).push(0, np.zeros((K, A)))


def test_oldest_prediction_weighs_most():
    aggregation = TemporalAggregation(2, 1, decay=1.0)
    aggregation.push(0, np.array([[0.0], [1.0]]))
    aggregation.next(0)
    aggregation.push(0, np.array([[0.0], [0.0]]))
    assert aggregation.next(0)[0] == pytest.approx(1 / (1 + np.exp(-1)))


def test_slots_are_independent_and_reset_forgets_one_only():
    chunks = list(np.random.default_rng(2).normal(size=(T, K, A)))
    aggregation = TemporalAggregation(K, A, slots=3)
    online(aggregation, chunks[:4], slot=1)
    before = online(TemporalAggregation(K, A), chunks)
    aggregation.push(2, chunks[0])
    aggregation.reset(1)
    assert np.array_equal(online(aggregation, chunks, slot=1), before)
    assert np.allclose(aggregation.next(2), chunks[0][0])


def test_memory_does_not_grow_with_the_episode():
    aggregation = TemporalAggregation(K, A)
    online(aggregation, list(np.zeros((T, K, A))))
    assert aggregation._sums.shape == (1, K, A)


def test_chunk_execution_plays_the_first_steps_of_each_chunk():
    execution = ChunkExecution(3, slots=2)
    chunk = np.arange(K * A).reshape(K, A)
    played = []
    for _ in range(3):
        if execution.needs_query(1):
            execution.push(1, chunk)
        played.append(execution.next(1))
    assert np.array_equal(np.stack(played), chunk[:3])
    assert execution.needs_query(1)
    execution.push(1, chunk)
    execution.reset(1)
    assert execution.needs_query(1)


@pytest.mark.parametrize("execution", [TemporalAggregation(K, A), ChunkExecution(2)])
def test_asking_for_an_action_without_a_chunk_is_an_error(execution):
    with pytest.raises(RuntimeError, match="push"):
        execution.next(0)


def test_execution_is_parsed_from_a_word_or_a_number():
    assert isinstance(make_execution("aggregate", K, A), TemporalAggregation)
    assert make_execution("aggregate", K, A).name == "aggregate"
    assert make_execution("aggregate-variance", K, A).name == "aggregate-variance"
    assert make_execution("3", K, A).name == make_execution(3, K, A).name == "3"
    for wrong in ("agregate", 0, K + 1, "-2", "2.5", True):
        with pytest.raises(ConfigError, match="execution"):
            make_execution(wrong, K, A)
