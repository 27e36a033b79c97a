"""`ugr speed`: what this machine reaches."""

import json as to_json
from functools import partial
from pathlib import Path
from typing import Any, Literal

from ugr_lightning.cli.parsing.call import Count, call


def _speed(
    parts: list[Literal["training", "compact", "query", "data", "simulation", "scale"]] | None = None,
    quick: bool = False,
    threads: Count | None = None,
    processes: Count = 2,
    rounds: Count | None = None,
    json: str | None = None,
    out: str | None = None,
) -> int:
    """Measure speed on this machine.

    Args:
        parts: what to measure; null means all but `scale`: how costs grow with demonstrations, cameras, pictures,
            chunk and processes, which takes a quarter of an hour and 9 GB of memory and disk.
        quick: tiny sizes, to see that everything runs; the numbers then mean nothing.
        threads: torch threads; null for one per core.
        processes: simulators that run side by side.
        rounds: times that each workload is timed; null for the default.
        json: file for the numbers.
        out: folder for the curves of `scale`.
    """
    import torch

    from ugr_lightning.sim.render import require_rendering
    from ugr_lightning.speed.table import HEAD, PARTS, cells_of, describe_machine, measure, print_cells
    from ugr_lightning.system.files import publish_text
    from ugr_lightning.system.limits import usable_cores

    chosen = [part for part in parts or PARTS if part != "scale"]
    if "simulation" in chosen:
        require_rendering()  # now, and not after minutes of measuring
    torch.set_num_threads(threads or usable_cores())
    machine = describe_machine()
    print(", ".join(f"{key} {value}" for key, value in machine.items()))
    measurements: list[dict[str, Any]] = []
    if chosen:
        print_cells(HEAD)
    for found in measure(chosen, quick=quick, rounds=rounds, processes=processes):
        print_cells(cells_of(found))
        measurements.append(found._asdict())
    if "scale" in (parts or ()):
        measurements += _scale(quick, rounds, out)
    if json is not None:
        content = {"machine": machine, "quick": quick, "measurements": measurements}
        publish_text(Path(json), to_json.dumps(content, indent=2) + "\n")
        print(f"written to {json}")
    return 0


def _scale(quick: bool, rounds: int | None, out: str | None) -> list[dict[str, Any]]:
    from ugr_lightning.speed.scale import HEAD, WIDTHS, cells_of_growth, measure_growth, scale_figure
    from ugr_lightning.speed.table import print_cells
    from ugr_lightning.system.files import publish

    rows = []
    print_cells(HEAD, WIDTHS)
    for row in measure_growth(quick=quick, rounds=rounds):
        print_cells(cells_of_growth(row), WIDTHS)
        rows.append(row)
    if out is not None:
        path, figure = Path(out) / "scale.png", scale_figure(rows)
        publish(path, lambda partial: figure.savefig(partial, format="png", dpi=100))
        print(f"curves: {path}")
    return [row._asdict() for row in rows]


run = partial(call, _speed, leading=["parts"])
