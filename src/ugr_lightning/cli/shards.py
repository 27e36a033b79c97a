"""`ugr shards`: a command as shards on a cluster, and here what puts them together."""

import shlex
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

from ugr_lightning.cli.benchmark.command import PROGRAM
from ugr_lightning.cli.benchmark.launch import launch
from ugr_lightning.cli.parsing.call import Count, call
from ugr_lightning.errors import ConfigError

SHARDED = ("collect", "rollout", "test", "sweep")


def _shards(
    count: Count,
    command: str,
    launcher_options: dict[str, Any] = {},  # noqa: B006 - jsonargparse copies it
) -> int:
    """Run a command as shards on a cluster, wait for them, and put together here what they leave; needs submitit.

    Args:
        count: how many.
        command: `collect`, `rollout`, `test` or `sweep` with its options, as one word: `"test --run uncert"`.
        launcher_options: parameters of submitit's executor, such as `{cluster: slurm, slurm_partition: gpu}`.
    """
    try:
        words = shlex.split(command)
    except ValueError:  # an open quotation
        words = []
    if not words or words[0] not in SHARDED:
        fix = 'For example: ugr shards 8 "test --run uncert".'
        raise ConfigError("--command", f"{', '.join(SHARDED)} with its options, in quotes", command, fix)
    shards = [[*PROGRAM, *words, "--shard", f"{place}/{count}"] for place in range(1, count + 1)]
    return launch(shards, Path("submitit"), launcher_options) or subprocess.call([*PROGRAM, *words, "--shard", "1/1"])


run = partial(call, _shards, leading=["count", "command"])
