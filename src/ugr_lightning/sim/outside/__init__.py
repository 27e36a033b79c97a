"""Environments made by others, as tasks of our runner: one file each, found by listing this folder.

A file defines one subclass of `OutsideSimulator`, and its name is the task's. Nothing here imports what it wraps.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ugr_lightning.contract import CAMERAS
from ugr_lightning.errors import SimulationError


def outside_names() -> tuple[str, ...]:
    """Names of the outside tasks, sorted."""
    return tuple(sorted(path.stem for path in Path(__file__).parent.glob("*.py") if not path.stem.startswith("_")))


def simulator_of(task: str) -> Callable[..., Any]:
    """What simulates a task: the class of an outside one, or `Simulator`, which knows all others.

    Raises:
        SimulationError: the outside task's file does not define one.
    """
    from ugr_lightning.sim.outside_simulator import OutsideSimulator
    from ugr_lightning.sim.simulator import Simulator

    if task not in outside_names():
        return Simulator
    module = importlib.import_module(f"{__name__}.{task}")
    classes = [item for item in vars(module).values() if isinstance(item, type) and item.__module__ == module.__name__]
    found = [item for item in classes if issubclass(item, OutsideSimulator)]
    if len(found) != 1:
        raise SimulationError(module.__name__, "one subclass of OutsideSimulator", len(found), "Define exactly one.")
    return found[0]


def task_cameras(task: str) -> tuple[str, ...]:
    """The cameras whose pictures the frames of a task have, in their order."""
    return simulator_of(task).cameras if task in outside_names() else CAMERAS  # type: ignore[attr-defined]
