import pytest

from ugr_lightning.cli.parsing.shard import every_nth
from ugr_lightning.errors import ConfigError


def test_shards_share_everything_and_nothing_twice():
    everything = list(range(11))
    parts = [everything[every_nth(f"{shard}/4")] for shard in range(1, 5)]
    assert parts[2] == [2, 6, 10]
    assert sorted(place for part in parts for place in part) == everything
    assert everything[every_nth(None)] == everything[every_nth("1/1")] == everything


@pytest.mark.parametrize("shard", ["0/8", "9/8", "3", "/8", "-1/8", "3/8/2", ""])
def test_a_shard_that_is_none_is_explained(shard):
    with pytest.raises(ConfigError, match="I from 1 to N"):
        every_nth(shard)
