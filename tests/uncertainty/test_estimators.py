import numpy as np
import pytest

from ugr_lightning.uncertainty.estimators import disagreement, estimator_table
from ugr_lightning.uncertainty.predictions import Predictions

K, A = 6, 3


def test_disagreement_is_the_distance_to_what_earlier_chunks_said_of_the_same_moment():
    rng = np.random.default_rng(0)
    step = np.array([0, 2, 4, 0])
    episode = np.array([0, 0, 0, 1])
    actions = rng.normal(size=(4, K, A))
    found = disagreement(actions, episode, step)
    for now in range(4):
        for k in range(K):
            said = [
                actions[other, step[now] + k - step[other]]
                for other in range(4)
                if episode[other] == episode[now] and step[other] < step[now] and step[now] + k - step[other] < K
            ]
            if not said:
                assert np.isnan(found[now, k])
            else:
                distances = [np.square(actions[now, k] - one).sum() for one in said]
                assert found[now, k] == pytest.approx(np.sqrt(np.mean(distances)))
    assert np.isnan(found[[0, 3]]).all()
    assert not np.isnan(found[2, :4]).any()


def test_estimators_are_compared_with_s_on_the_steps_that_both_know():
    rng = np.random.default_rng(2)
    error = rng.random((8, K))
    seen = Predictions(error, error, rng.random((8, K)), None, np.arange(8) // 2, np.arange(8))
    partly = error.copy()
    partly[0] = np.nan
    table = {row[0]: row for row in estimator_table(seen, {"perfect": error, "partly": partly}, 2)}
    assert table["perfect"][2] == table["perfect"][4] == "1"
    assert table["s_k"][6].startswith("0 ")
    assert table["partly"][1] == str(7 * K)
    assert table["partly"][4] == "1"
