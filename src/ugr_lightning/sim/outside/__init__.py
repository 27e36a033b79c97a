"""Environments made by others, as tasks of our runner: one file each, found by listing folders.

A file defines one subclass of `OutsideSimulator`, and its name is the task's. Nothing here imports what it wraps.
"""

from collections.abc import Callable
from typing import Any

from ugr_lightning.contract import CAMERAS
from ugr_lightning.sim.task_files import load_class, task_files


def outside_names() -> tuple[str, ...]:
    """Names of the outside tasks, sorted."""
    return tuple(task_files(outside=True))


def simulator_of(task: str) -> Callable[..., Any]:
    """What simulates a task: the class of an outside one, or `Simulator`, which knows all others.

    Raises:
        SimulationError: the outside task's file cannot be imported, or does not define one.
    """
    from ugr_lightning.sim.outside_simulator import OutsideSimulator
    from ugr_lightning.sim.simulator import Simulator

    path = task_files(outside=True).get(task)
    return load_class(path, OutsideSimulator) if path else Simulator


def task_cameras(task: str) -> tuple[str, ...]:
    """The cameras whose pictures the frames of a task have, in their order."""
    return simulator_of(task).cameras if task in outside_names() else CAMERAS  # type: ignore[attr-defined]
