"""`ugr speed`: what this machine reaches."""

import sys
from functools import partial
from pathlib import Path
from typing import Literal

from ugr_lightning.cli.parsing.call import call


def _speed(
    parts: list[Literal["training", "compact", "query", "data", "simulation"]] | None = None,
    quick: bool = False,
    threads: int | None = None,
    processes: int = 2,
    rounds: int | None = None,
    json: str | None = None,
) -> int:
    """Measure speed on this machine.

    Args:
        parts: what to measure; null means all.
        quick: tiny sizes, to see that everything runs; the numbers then mean nothing.
        threads: torch threads; null for one per core.
        processes: simulators that run side by side.
        rounds: times that each workload is timed; null for the default.
        json: file for the numbers.
    """
    from ugr_lightning.speed.table import PARTS, measure_speed

    return measure_speed(
        sys.stdout,
        parts=parts or PARTS,
        quick=quick,
        threads=threads,
        processes=processes,
        rounds=rounds,
        json_path=None if json is None else Path(json),
    )


run = partial(call, _speed, leading=["parts"])
