"""Which seeds are for what, and the evaluation seeds that ship with the package.

Demonstrations, evaluation and selection (rollouts during training, choices of a recipe) never share a seed.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ugr_lightning.errors import SimulationError
from ugr_lightning.sim.tasks import task_version

DEMONSTRATION_START = 0
EVALUATION_START = 100_000
SELECTION_START = 200_000
COUNT = 100


def evaluation_seeds(task: str) -> list[int]:
    """The task's evaluation seeds, 100 from 100000 upward that the expert solves.

    Raises:
        ConfigError: there is no such task.
        SimulationError: the list is missing, damaged, or of another task or version of the task.
    """
    version, path = task_version(task), _path(task)
    fix = f"Recompute it: `python -m ugr_lightning.sim.seeds --task {task}`."
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        owner, seeds = (content["task"], content["version"]), [int(seed) for seed in content["seeds"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SimulationError(path, "a list of evaluation seeds", type(error).__name__, fix) from error
    if owner != (task, version):
        got = f"a seed list of {owner[0]}, version {owner[1]}"
        raise SimulationError(path, f"a seed list of {task}, version {version}", got, fix)
    if seeds != sorted(set(seeds)) or not seeds or not EVALUATION_START <= seeds[0] <= seeds[-1] < SELECTION_START:
        expected = f"different seeds in rising order from {EVALUATION_START} to {SELECTION_START - 1}"
        raise SimulationError(path, expected, f"{seeds[:3]} ...", fix)
    return seeds


def seeds_hash(seeds: Sequence[int]) -> str:
    """SHA-256 (hex) of the comma-joined list, to prove that two runs were evaluated on the same seeds."""
    return hashlib.sha256(",".join(str(int(seed)) for seed in seeds).encode()).hexdigest()


def compute_evaluation_seeds(task: str, count: int = COUNT) -> dict[str, Any]:
    """Run the expert without noise from seed 100000 upward until it has solved `count` of them.

    Returns:
        `{"task", "version", "skipped", "seeds"}`, what the task's file contains.

    Raises:
        SimulationError: the expert fails on more than half of the seeds.
    """
    from ugr_lightning.sim.outside import simulator_of

    solved: list[int] = []
    skipped: list[int] = []
    with simulator_of(task)(task, render=False) as simulator:
        seed = EVALUATION_START
        while len(solved) < count:
            success = simulator.reset(seed).success
            for step in simulator.expert():
                success = simulator.step(step.action).success
            (solved if success else skipped).append(seed)
            seed += 1
            if len(skipped) > max(10, len(solved)):
                raise SimulationError(f"expert of {task}", "most seeds solved", skipped, "Repair the task's expert.")
        version = simulator.task_version
    return {"task": task, "version": version, "skipped": skipped, "seeds": solved}


def write_evaluation_seeds(task: str) -> Path:
    """Recompute a task's list and put it in place of the old one; returns its path."""
    path = _path(task)
    aside = path.with_suffix(".json.partial")
    aside.write_text(json.dumps(compute_evaluation_seeds(task)) + "\n", encoding="utf-8")
    os.replace(aside, path)
    return path


def _path(task: str) -> Path:
    return Path(__file__).parent / f"{task}.json"
