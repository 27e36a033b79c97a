"""Closed-loop episodes: simulators in worker processes, the policy in this one, all slots in lock-step."""

import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ugr_lightning.contract import ChunkPolicy, EpisodeResult
from ugr_lightning.errors import ConfigError
from ugr_lightning.rollout.actors import Actor, make_actor
from ugr_lightning.rollout.lockstep import LockStep, OnResult
from ugr_lightning.rollout.progress import Progress
from ugr_lightning.rollout.stage import Order, Reply, Stage
from ugr_lightning.rollout.workers import Worker, WorkerLostError, open_simulator, start_all


class Runner:
    """Simulators that stay alive over many runs; a context manager.

    In every control step all slots move together: one query for the slots that need a chunk, then one step of every
    simulator. Free slots take the next seed in slot order. What happens therefore depends on the seeds and on the
    number of slots, never on how fast a process was.

    Args:
        task: a name from `ugr tasks`.
        setting: how the surroundings vary.
        image_size: height and width of the pictures; those the policy was trained on.
        render: whether there are pictures at all.
        workers: processes.
        slots_per_worker: simulators per process.
        timeout_s: a process that takes longer for one control step counts as hung.
        simulator: what to open in place of `sim.Simulator`; called with the same arguments.
    """

    def __init__(
        self,
        task: str,
        *,
        setting: str = "demo_clean",
        image_size: tuple[int, int] = (120, 160),
        render: bool = True,
        workers: int = 2,
        slots_per_worker: int = 1,
        timeout_s: float = 120.0,
        simulator: Callable[..., Any] | None = None,
    ) -> None:
        if workers < 1 or slots_per_worker < 1:
            got = f"{workers} x {slots_per_worker}"
            raise ConfigError("rollout", "at least one worker with one slot", got, "Correct the number.")
        self.task, self.setting, self.render, self.timeout_s = task, setting, render, timeout_s
        open_task = partial(
            open_simulator, simulator, task, setting=setting, image_size=tuple(image_size), render=render
        )
        build = partial(Stage, open_task, slots_per_worker)
        self._workers = [Worker(build, f"simulator process {index + 1}") for index in range(workers)]
        self._slots_per_worker = slots_per_worker

    @property
    def slots(self) -> int:
        """Number of episodes that run at the same time."""
        return len(self._workers) * self._slots_per_worker

    def __enter__(self) -> Self:
        try:
            start_all(self._workers)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.kill()

    def run(
        self,
        actor: Actor | ChunkPolicy | str,
        seeds: Sequence[int],
        *,
        execution: str | int = "aggregate",
        checkpoint: str | None = None,
        seeds_hash: str | None = None,
        on_result: OnResult | None = None,
        video_dir: str | Path | None = None,
        video_seeds: Collection[int] | None = None,
        progress: bool = True,
    ) -> list[EpisodeResult]:
        """Run one episode per seed; see `run_episodes`."""
        from ugr_lightning.sim import seeds as seed_lists

        actor = make_actor(actor)
        stamp = {
            "task": self.task,
            "setting": self.setting,
            "seeds_hash": seeds_hash or seed_lists.seeds_hash(seeds),
            "policy": actor.name,
            "checkpoint": checkpoint,
        }
        filmed = set() if video_dir is None else set(seeds if video_seeds is None else video_seeds)
        actor.begin(self.slots, execution)
        self._clear()
        try:
            with Progress(f"{self.task}: {actor.name}", len(seeds), shown=progress) as line:
                run = LockStep(self.slots, self.advance, actor, list(seeds), filmed, stamp, line, on_result, video_dir)
                return run.finish()
        finally:
            actor.end()

    def advance(self, orders: dict[int, Order]) -> tuple[dict[int, Reply], dict[int, str]]:
        """Move slots on by one control step, all processes at the same time.

        Args:
            orders: by slot of the runner.

        Returns:
            replies by slot, and by slot why the process behind it was lost; that one has been replaced.
        """
        replies: dict[int, Reply] = {}
        lost: dict[int, str] = {}
        asked: dict[int, dict[int, Order]] = {}
        for slot, order in orders.items():
            asked.setdefault(slot // self._slots_per_worker, {})[slot % self._slots_per_worker] = order
        faults: dict[int, str] = {}
        for index, jobs in asked.items():
            try:
                self._workers[index].send("advance", [order._replace(slot=slot) for slot, order in jobs.items()])
            except WorkerLostError as error:
                faults[index] = str(error)
        deadline = time.monotonic() + self.timeout_s
        for index in asked.keys() - faults.keys():
            try:
                for reply in self._workers[index].receive(max(0.0, deadline - time.monotonic())):
                    replies[index * self._slots_per_worker + reply.slot] = reply
            except WorkerLostError as error:
                faults[index] = str(error)
        for index, fault in faults.items():
            lost |= {index * self._slots_per_worker + slot: fault for slot in asked[index]}
        start_all([self._workers[index] for index in faults])
        return replies, lost

    def _clear(self) -> None:
        """Restart processes that a run before left in the middle of a call."""
        start_all([worker for worker in self._workers if worker.pid is None or worker.busy])


def run_episodes(
    actor: Actor | ChunkPolicy | str,
    task: str,
    seeds: Sequence[int],
    *,
    setting: str = "demo_clean",
    image_size: tuple[int, int] = (120, 160),
    execution: str | int = "aggregate",
    workers: int = 2,
    slots_per_worker: int = 1,
    checkpoint: str | None = None,
    seeds_hash: str | None = None,
    on_result: OnResult | None = None,
    video_dir: str | Path | None = None,
    video_seeds: Collection[int] | None = None,
    timeout_s: float = 120.0,
    progress: bool = True,
    simulator: Callable[..., Any] | None = None,
) -> list[EpisodeResult]:
    """Run one episode per seed and say how each ended.

    An episode ends with the task's success, at the horizon, or when the expert is done. One in which the simulator
    crashes or hangs, or the policy's output is not finite, is a failure with `crash` set; the others go on.

    Args:
        actor: an `Actor`, a policy, or `zero`, `random`, `expert`.
        task: a name from `ugr tasks`.
        seeds: which episodes.
        setting: how the surroundings vary.
        image_size: height and width of the pictures; those the policy was trained on.
        execution: `aggregate` or the number of steps executed of each chunk.
        workers: simulator processes.
        slots_per_worker: simulators per process.
        checkpoint: SHA-256 of the policy's checkpoint, for the results.
        seeds_hash: SHA-256 of the list that the seeds are from; None takes that of `seeds`.
        on_result: called with each result and its trace as soon as the episode ends.
        video_dir: where to write `<task>-<seed>.gif`; None films nothing.
        video_seeds: which seeds to film; None means all.
        timeout_s: a process that takes longer for one control step counts as hung.
        progress: whether to show a progress line.
        simulator: what to open in place of `sim.Simulator`.

    Returns:
        Results in the order of the seeds.

    Raises:
        SimulationError: no simulator starts.
        ConfigError: an execution or an actor that does not exist.

    Source: DESIGN 4, 8; FACTS 6.
    """
    actor = make_actor(actor)
    with Runner(
        task,
        setting=setting,
        image_size=image_size,
        render=bool(actor.cameras) or video_dir is not None,
        workers=workers,  # also for few seeds: the size of the policy's batch is part of its arithmetic
        slots_per_worker=slots_per_worker,
        timeout_s=timeout_s,
        simulator=simulator,
    ) as runner:
        return runner.run(
            actor,
            seeds,
            execution=execution,
            checkpoint=checkpoint,
            seeds_hash=seeds_hash,
            on_result=on_result,
            video_dir=video_dir,
            video_seeds=video_seeds,
            progress=progress,
        )
