"""Recorded commands executed once more, to see whether a demonstration still ends the way it did."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ugr_lightning.demos.executed import Executed, read_executed
from ugr_lightning.errors import DataError
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.sim.settings import check_setting
from ugr_lightning.sim.simulator import Simulator
from ugr_lightning.sim.tasks import all_task_names, task_version
from ugr_lightning.system.progress import Progress
from ugr_lightning.system.spread import spread


class Replay(NamedTuple):
    """What came of a recording that was executed again.

    Args:
        path: the recording.
        seed: simulator seed.
        steps: control steps.
        success: whether the task's condition was met, as it was when the episode was recorded.
        deviation: largest difference of a measured joint from the recorded one, rad (gripper: of its opening).
        fault: why the simulator was lost, or None.
    """

    path: Path
    seed: int
    steps: int
    success: bool
    deviation: float
    fault: str | None = None

    @property
    def identical(self) -> bool:
        """Whether every measured joint of every step is the recorded one, bit for bit."""
        return self.fault is None and self.deviation == 0.0

    def __str__(self) -> str:
        if self.fault is not None:
            return f"{self.path}: seed {self.seed}, {self.fault}"
        outcome = "success" if self.success else "NO SUCCESS, recorded as a success"
        joints = "bit for bit" if self.identical else f"within {self.deviation:.3g} rad"
        return f"{self.path}: seed {self.seed}, {self.steps} steps, {outcome}, joints as recorded {joints}"


class Replayer:
    """Executes recordings of one task and setting; lives in a worker process.

    Args:
        open_task: opens the simulator.
    """

    def __init__(self, open_task: Callable[[], Simulator]) -> None:
        self._simulator = open_task()

    def replay(self, recorded: Executed) -> Replay:
        """Execute the commands of a recording from its seed on."""
        frames = [self._simulator.reset(recorded.seed)]
        frames += [self._simulator.step(action) for action in recorded.actions]
        measured = np.stack([frame.measured for frame in frames])  # (N + 1, 14)
        deviation = float(np.abs(measured.astype(np.float64) - recorded.measured).max())
        return Replay(recorded.path, recorded.seed, len(recorded.actions), bool(frames[-1].success), deviation)


def replay(paths: Sequence[Path], *, workers: int = 2) -> list[Replay]:
    """Execute recordings again, each from its own seed and in its own setting.

    What is executed is what was executed then, noise included; nothing is rendered.

    Args:
        paths: episodes written by `ugr collect`.
        workers: simulator processes.

    Returns:
        One item per path, in order.

    Raises:
        DataError: a file that does not say its task and seed, or is of another version of its task.
    """
    recordings = [read_executed(path) for path in paths]
    for recorded in recordings:
        _require_this_version(recorded)
    results: dict[int, Replay] = {}
    worlds = sorted({(recorded.task, recorded.setting) for recorded in recordings})
    with Progress("replay", len(paths)) as line:
        for task, setting in worlds:
            members = [i for i, r in enumerate(recordings) if (r.task, r.setting) == (task, setting)]
            open_task = partial(open_simulator, task, setting=setting, render=False)
            jobs = [recordings[i] for i in members]
            for done in spread(partial(Replayer, open_task), "replay", jobs, workers=workers):
                job = jobs[done.job]
                lost = Replay(job.path, job.seed, len(job.actions), False, float("inf"), done.fault)
                results[members[done.job]] = done.value or lost
                line.advance(f"{sum(item.success for item in results.values())} reproduced")
    return [results[index] for index in range(len(paths))]


def _require_this_version(recorded: Executed) -> None:
    if recorded.task not in all_task_names():
        fix = "Replay it where its task is installed."
        raise DataError(recorded.path, "a recording of a task that is here", recorded.task, fix)
    check_setting(recorded.setting)
    here = task_version(recorded.task)
    if recorded.task_version not in (None, here):
        got = f"one of version {recorded.task_version}"
        fix = "Record it again with `ugr collect`; the same seed is another episode now."
        raise DataError(recorded.path, f"a recording of {recorded.task}, version {here}", got, fix)
