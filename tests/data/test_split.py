"""The split is by episode, 80/20, and depends on nothing but count and seed."""

import pytest

from ugr_lightning.data.split import split_episodes
from ugr_lightning.errors import DataError


@pytest.mark.parametrize(("count", "train"), [(2, 1), (3, 2), (5, 4), (10, 8), (50, 40), (51, 40)])
def test_every_episode_is_in_exactly_one_part(count, train):
    split = split_episodes(count, seed=3)
    assert len(split.train) == train
    assert sorted(split.train + split.validation) == list(range(count))


def test_the_same_seed_gives_the_same_split_and_another_seed_another():
    assert split_episodes(50, 0) == split_episodes(50, 0)
    assert split_episodes(50, 0) != split_episodes(50, 1)
    assert split_episodes(5, 0).validation == (1,)  # changes when old checkpoints would see other validation episodes


@pytest.mark.parametrize("count", [0, 1])
def test_one_episode_cannot_be_split(count):
    with pytest.raises(DataError, match="at least 2"):
        split_episodes(count, 0)
