"""Which seeds are for what, and the lists of evaluation seeds.

Demonstrations, evaluation and selection (rollouts during training, choices of a recipe) never share a seed.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import Literal

from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim.tasks import seeds_file, task_version

EVALUATION_START = 100_000
SELECTION_START = 200_000

SeedChoice = Literal["evaluation", "selection"] | int


def evaluation_seeds(task: str) -> list[int]:
    """The task's evaluation seeds, 100 from 100000 upward that the expert solves.

    Raises:
        ConfigError: there is no such task.
        SimulationError: the list is missing, damaged, or of another task or version of the task.
    """
    version, path = task_version(task), seeds_file(task)
    fix = f"Make it: `ugr tasks seeds {task}`."
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


def seed_list(which: SeedChoice, task: str, count: int) -> tuple[list[int], list[int]]:
    """The seeds of some episodes, and the list they are from: one without an end is told by its first.

    Args:
        which: name of a list, or the first seed.
        task: whose evaluation list.
        count: how many.

    Raises:
        ConfigError: less than one, or more than the list has.
    """
    if count < 1:
        raise ConfigError("--episodes", "at least 1", count, "Correct the number.")
    if which == "evaluation":
        whole = evaluation_seeds(task)
        if count > len(whole):
            fix = f"Make a longer list with `ugr tasks seeds {task}`, or let `ugr rollout --seeds 300000` take others."
            raise ConfigError("--episodes", f"at most the {len(whole)} evaluation seeds", count, fix)
        return whole[:count], whole
    first = SELECTION_START if which == "selection" else int(which)
    if first < 0:
        raise ConfigError("--seeds", "a first seed of 0 or more", first, "Selection seeds begin at 200000.")
    return list(range(first, first + count)), [first]  # else more of them would be another list
