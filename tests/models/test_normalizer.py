"""Robot units and network units."""

import pytest
import torch

from ugr_lightning.contract import Statistics
from ugr_lightning.errors import CheckpointError, DataError
from ugr_lightning.models.normalizer import Normalizer


@pytest.mark.parametrize("mode", ["mean_std", "min_max"])
def test_actions_survive_the_way_there_and_back(statistics: Statistics, mode):
    normalizer = Normalizer(14, 14, mode)
    normalizer.fit(statistics)
    actions = torch.randn(2, 5, 14)
    assert torch.allclose(normalizer.robot_action(normalizer.action(actions)), actions, atol=1e-5)


def test_mean_std_centres_the_state(statistics: Statistics):
    normalizer = Normalizer(14, 14)
    normalizer.fit(statistics)
    one_std_above = statistics.state_mean + statistics.state_std
    assert torch.allclose(normalizer.state(one_std_above[None]), torch.ones(1, 14), atol=1e-5)


def test_min_max_maps_the_range_to_one_and_a_still_dimension_to_zero_and_back_to_its_value(statistics: Statistics):
    low = statistics.action_min.clone()
    low[3] = statistics.action_max[3]
    normalizer = Normalizer(14, 14, "min_max")
    normalizer.fit(statistics._replace(action_min=low))
    expected = torch.ones(14)
    expected[3] = 0
    assert torch.allclose(normalizer.action(statistics.action_max), expected, atol=1e-5)
    assert torch.allclose(normalizer.action(low)[expected == 1], -torch.ones(13), atol=1e-5)
    noise = torch.randn(5, 14)
    assert (normalizer.robot_action(noise)[:, 3] == statistics.action_max[3]).all()
    assert (normalizer.action(noise)[:, 3] == 0).all()


def test_a_joint_that_never_moves_does_not_blow_up(statistics: Statistics):
    normalizer = Normalizer(14, 14)
    normalizer.fit(statistics._replace(state_std=torch.zeros(14)))
    assert normalizer.state(statistics.state_mean + 0.01).abs().max().item() == pytest.approx(1, abs=1e-3)


def test_unfitted_use_is_an_error_that_says_what_to_do():
    with pytest.raises(CheckpointError, match="set_statistics"):
        Normalizer(14, 14).state(torch.zeros(1, 14))


def test_statistics_of_another_robot_are_refused(statistics: Statistics):
    with pytest.raises(DataError, match="7 dimensions"):
        Normalizer(7, 14).fit(statistics)


def test_nan_statistics_are_refused_and_leave_it_unfitted(statistics: Statistics):
    normalizer = Normalizer(14, 14)
    with pytest.raises(DataError, match="NaN"):
        normalizer.fit(statistics._replace(action_mean=torch.full((14,), torch.nan)))
    assert not normalizer.fitted


def test_statistics_travel_in_the_state_dict(statistics: Statistics):
    source, target = Normalizer(14, 14), Normalizer(14, 14)
    source.fit(statistics)
    target.load_state_dict(source.state_dict())
    state = torch.randn(1, 14)
    assert torch.equal(source.state(state), target.state(state))
