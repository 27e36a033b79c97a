"""`ugr speed`: what this machine reaches."""

import json as to_json
from functools import partial
from pathlib import Path
from typing import Literal

from ugr_lightning.cli.parsing.call import Count, call


def _speed(
    parts: list[Literal["training", "compact", "query", "data", "simulation"]] | None = None,
    quick: bool = False,
    threads: Count | None = None,
    processes: Count = 2,
    rounds: Count | None = None,
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
    import torch

    from ugr_lightning.sim.render import require_rendering
    from ugr_lightning.speed.table import HEAD, PARTS, cells_of, describe_machine, measure, print_cells
    from ugr_lightning.system.files import publish_text
    from ugr_lightning.system.limits import usable_cores

    chosen = parts or PARTS
    if "simulation" in chosen:
        require_rendering()  # now, and not after minutes of measuring
    torch.set_num_threads(threads or usable_cores())
    machine = describe_machine()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    print_cells(HEAD)
    measurements = []
    for found in measure(chosen, quick=quick, rounds=rounds, processes=processes):
        print_cells(cells_of(found))
        measurements.append(found._asdict())
    if json is not None:
        content = {"machine": machine, "quick": quick, "measurements": measurements}
        publish_text(Path(json), to_json.dumps(content, indent=2) + "\n")
        print(f"written to {json}")
    return 0


run = partial(call, _speed, leading=["parts"])
