import numpy as np
import pytest

from ugr_lightning.uncertainty.foretold import Moments, cross_fitted, ridge

STEPS = 200


def moments(features, error):
    x = np.column_stack([np.ones(len(features)), features])
    return Moments(x.T @ x, x.T @ error, float(np.square(error).sum()), len(x))


def made_up(error_of, episodes=6):
    """Episodes whose errors a function tells from 3 features, the number of the episode and noise."""
    rng = np.random.default_rng(0)
    features = [rng.normal(size=(STEPS, 3)) for _ in range(episodes)]
    return [moments(x, error_of(x, number, rng.normal(size=(STEPS, 2)))) for number, x in enumerate(features)]


def explained(episodes):
    return 1 - sum(cross_fitted(episodes)) / sum(one.squares for one in episodes)


def test_errors_that_follow_from_the_features_are_foretold_up_to_the_noise():
    assert explained(made_up(lambda x, number, noise: x[:, :2])) > 0.999
    assert explained(made_up(lambda x, number, noise: x[:, :2] + noise)) == pytest.approx(0.5, abs=0.05)


def test_errors_that_do_not_follow_are_not_foretold():
    assert -0.05 < explained(made_up(lambda x, number, noise: noise)) < 0.01


def test_what_holds_in_one_episode_alone_counts_for_nothing():
    """Each episode has another offset: a fit that had seen it would explain nearly all of it."""
    own_offset = made_up(lambda x, number, noise: np.full((STEPS, 2), (-1.0) ** number * (1 + number)))
    assert explained(own_offset) <= 0
    assert own_offset[3].left(ridge([own_offset[3], own_offset[3]])) < 0.01 * own_offset[3].squares
