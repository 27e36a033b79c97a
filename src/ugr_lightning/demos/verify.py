"""What makes a benchmark one: the same seed is the same episode, and the listed seeds are the right ones."""

import hashlib
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ugr_lightning.data.selection import shorten
from ugr_lightning.errors import SimulationError
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.sim.seeds import EVALUATION_START, evaluation_seeds, seeds_hash
from ugr_lightning.sim.simulator import Simulator
from ugr_lightning.sim.tasks import seeds_file, task_version
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.progress import Progress
from ugr_lightning.system.spread import spread

FIRST_SEED = 400_000
"""Fresh seeds for statistics: apart from demonstrations, evaluation and selection."""


class Performance(NamedTuple):
    """How the expert did on a seed, without noise and to the end of its script.

    Args:
        seed: simulator seed.
        success: whether the task's condition was met.
        steps: control steps of the whole script: the length of a demonstration.
        motion_hash: SHA-256 of the measured joints of all frames, the last one included.
        gave_up: what the expert could not reach, which ended its script; None where there was no such pose.
    """

    seed: int
    success: bool
    steps: int
    motion_hash: str
    gave_up: str | None = None


class Performer:
    """Lets the expert perform seeds; lives in a worker process.

    Args:
        open_task: opens the simulator.
    """

    def __init__(self, open_task: Callable[[], Simulator]) -> None:
        self._simulator = open_task()

    def perform(self, seed: int) -> Performance:
        """One episode of the expert."""
        frame, steps = self._simulator.reset(seed), 0
        motion = hashlib.sha256(np.asarray(frame.measured).tobytes())
        for intention in self._simulator.expert():
            frame, steps = self._simulator.step(intention.action), steps + 1
            motion.update(np.asarray(frame.measured).tobytes())
        return Performance(seed, bool(frame.success), steps, motion.hexdigest(), self._simulator.gave_up)


def perform(task: str, seeds: Sequence[int], *, setting: str = "demo_clean", workers: int = 1) -> list[Performance]:
    """Let the expert perform some seeds, without pictures.

    Returns:
        One item per seed, in order; a simulator that was lost counts as a failure of no steps.
    """
    open_task = partial(open_simulator, task, setting=setting, render=False)
    results: dict[int, Performance] = {}
    with Progress(f"{task}, {setting}: expert", len(seeds)) as line:
        for done in spread(partial(Performer, open_task), "perform", seeds, workers=workers):
            if done.fault is not None:
                line.message(f"Seed {seeds[done.job]} counts as a failure: {done.fault}")
            found = results[done.job] = done.value or Performance(seeds[done.job], False, 0, "")
            if found.gave_up is not None:
                line.message(f"Seed {found.seed}: {found.gave_up}")
            line.advance(f"{sum(item.success for item in results.values())} solved")
    return [results[index] for index in range(len(seeds))]


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
