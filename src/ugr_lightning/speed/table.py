"""The table of `ugr speed`: what this machine reaches, as ratios wherever there is something to compare with."""

import os
import platform
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from rich.console import Console

from ugr_lightning.models.precision import bf16_is_fast
from ugr_lightning.speed.measurements import (
    PAPER,
    QUICK,
    Measurement,
    measure_compact_step,
    measure_data,
    measure_query,
    measure_simulation,
    measure_training,
)
from ugr_lightning.system.limits import usable_cores

Part = Literal["training", "compact", "query", "data", "simulation"]
PARTS: tuple[Part, ...] = get_args(Part)
HEAD = ("what", "here", "by CPU time", "arithmetic alone", "reference", "ratio", "aim")
WIDTHS = (52, 16, 16, 16, 16, 7, 26)


def measure(
    parts: Sequence[Part] = PARTS, *, quick: bool = False, rounds: int | None = None, processes: int = 2
) -> Iterator[Measurement]:
    """Measure while it is iterated over.

    Ratios come from workloads that take turns within one run, so that they hold on a busy machine, where absolute
    times do not.

    Args:
        parts: what to measure.
        quick: tiny sizes, to see that everything runs; the numbers then mean nothing.
        rounds: times that each workload is timed; None for the default.
        processes: simulators that run side by side.
    """
    size = QUICK if quick else PAPER
    size = size if rounds is None else size._replace(rounds=rounds)
    workloads: dict[Part, Callable[[], Iterator[Measurement]]] = {
        "training": lambda: measure_training(size),
        "compact": lambda: measure_compact_step(size),
        "query": lambda: measure_query(size),
        "data": lambda: measure_data(size),
        "simulation": lambda: measure_simulation(size, processes),
    }
    for part in PARTS:
        if part in parts:
            with Console().status(f"measuring: {part}"):  # draws nothing where there is no terminal
                yield from workloads[part]()


def describe_machine() -> dict[str, Any]:
    """What the numbers depend on, in plain containers."""
    bf16 = "bf16" if bf16_is_fast(torch.device("cpu")) else "fp32"
    return {
        "CPU": _processor(),
        "cores": usable_cores(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "precision": bf16,
        "load": round(os.getloadavg()[0], 1),
    }


def cells_of(item: Measurement) -> tuple[str, ...]:
    """A measurement under `HEAD`."""
    ratio = "" if item.ratio is None else f"{item.ratio:.2f}x"
    times = ("" if t is None else f"{_number(t)} {item.unit}" for t in (item.cpu, item.arithmetic, item.reference))
    return item.name, f"{_number(item.value)} {item.unit}", *times, ratio, item.aim


def print_cells(cells: Sequence[str], widths: Sequence[int] = WIDTHS) -> None:
    """Print a line of a table."""
    print("  ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)).rstrip(), flush=True)


def _number(value: float) -> str:
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    names = [line for line in path.read_text().splitlines() if line.startswith("model name")] if path.is_file() else []
    return names[0].partition(":")[2].strip() if names else platform.processor() or platform.machine()
