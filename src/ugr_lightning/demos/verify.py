"""What makes a benchmark one: the same seed is the same episode, and the listed seeds are the right ones."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ugr_lightning.data.selection import shorten
from ugr_lightning.demos.survey import FIRST_SEED, Performance, perform
from ugr_lightning.errors import SimulationError
from ugr_lightning.sim.seeds import EVALUATION_START, evaluation_seeds, seeds_hash
from ugr_lightning.sim.tasks import seeds_file, task_version
from ugr_lightning.system.files import publish_text


class Verification(NamedTuple):
    """How often two things that must agree did.

    Args:
        what: task, setting and claim.
        n: comparisons.
        differing: seeds that disagree.
    """

    what: str
    n: int
    differing: tuple[int, ...]

    def __str__(self) -> str:
        seeds = ", ".join(map(str, self.differing[:5])) + (" ..." if len(self.differing) > 5 else "")
        return f"{self.what}: {self.n - len(self.differing)} of {self.n} agree" + (f", not {seeds}" if seeds else "")


def verify_determinism(
    task: str,
    *,
    setting: str = "demo_clean",
    episodes: int = 50,
    first_seed: int = FIRST_SEED,
    workers: int = 2,
) -> Verification:
    """Let the expert do the same seeds twice, in opposite order and in different processes.

    Two episodes agree when outcome, length and the measured joints of every step are equal bit for bit.

    Args:
        task: a name from `ugr tasks`.
        setting: how the surroundings vary.
        episodes: number of seeds.
        first_seed: the first of them.
        workers: simulator processes of each of the two runs.
    """
    seeds = list(range(first_seed, first_seed + episodes))

    def run(order: Sequence[int]) -> dict[int, Performance]:
        return {item.seed: item for item in perform(task, order, setting=setting, workers=workers)}

    once, again = run(seeds), run(seeds[::-1])
    differing = tuple(seed for seed in seeds if once[seed] != again[seed] or not once[seed].steps)
    return Verification(f"{task}, {setting}: same seed, same episode", episodes, differing)


def verify_evaluation_seeds(task: str, *, workers: int = 2) -> Verification:
    """Let the expert try every seed of the range that the shipped list covers: it must solve those listed, no other.

    Raises:
        SimulationError: the list is missing, damaged, or of another version of the task.
    """
    shipped = evaluation_seeds(task)
    seeds = list(range(EVALUATION_START, shipped[-1] + 1))
    found = perform(task, seeds, workers=workers)
    differing = tuple(item.seed for item in found if item.success != (item.seed in set(shipped)))
    what = f"{task}: {len(shipped)} evaluation seeds (hash {seeds_hash(shipped)[:12]}) and what the expert solves"
    return Verification(what, len(seeds), differing)


def find_evaluation_seeds(task: str, *, count: int, workers: int = 2) -> Path:
    """Write the list of a task's evaluation seeds: the first from 100000 upward that the expert solves without noise.

    Args:
        task: a name from `ugr tasks`.
        count: how many.
        workers: simulator processes.

    Returns:
        The file, see `sim.tasks.seeds_file`.

    Raises:
        SimulationError: the expert fails on more seeds than it solves; the file stays as it was.
    """
    path, version = seeds_file(task), task_version(task)
    solved: list[int] = []
    skipped: list[int] = []
    while len(solved) < count:
        start = EVALUATION_START + len(solved) + len(skipped)
        seeds = range(start, start + count - len(solved))
        for item in perform(task, seeds, workers=workers):
            (solved if item.success else skipped).append(item.seed)
        if len(skipped) > len(solved):
            got = f"failures on {len(skipped)} of {len(solved) + len(skipped)}: {shorten(skipped, 5)}"
            fix = f"Watch it: `ugr rollout --task {task} --seeds {skipped[0]} --episodes 1 --video {task}.gif`."
            raise SimulationError(f"expert of {task}", "an expert that solves most seeds", got, fix)
    publish_text(path, json.dumps({"task": task, "version": version, "skipped": skipped, "seeds": solved}) + "\n")
    return path
