"""`--shard 3/8`: the part of some seeds that is this process's, while others, here or on other machines, do theirs."""

import re
from dataclasses import replace
from typing import TYPE_CHECKING

from ugr_lightning.errors import ConfigError

if TYPE_CHECKING:
    from ugr_lightning.rollout.spec import RolloutSpec


def every_nth(shard: str | None) -> slice:
    """The places that a shard stands for: of `3/8` the third, the eleventh, the nineteenth and so on.

    Args:
        shard: `I/N`, I from 1; None is the only shard there is.

    Raises:
        ConfigError: it is neither.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", "1/1" if shard is None else shard)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        fix = "In an array of jobs 1 to 8: --shard $SLURM_ARRAY_TASK_ID/8."
        raise ConfigError("--shard", "I/N with I from 1 to N, such as 3/8", shard, fix)
    return slice(int(found[1]) - 1, None, int(found[2]))


def part_of(spec: "RolloutSpec", part: slice) -> "RolloutSpec | None":
    """What a shard rolls out; None where there are more shards than seeds and it has nothing to do, which is said.

    Args:
        spec: what all shards roll out together, into one results file.
        part: see `every_nth`.
    """
    seeds = spec.seeds[part]
    if not seeds:
        print(f"nothing to do for shard {part.start + 1}/{part.step} of {len(spec.seeds)} episodes")
        return None
    return replace(spec, seeds=seeds)
