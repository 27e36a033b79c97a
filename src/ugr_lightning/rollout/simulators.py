"""Simulators in worker processes: orders go out as soon as they are known, replies come in as they are ready."""

import time
from collections import deque
from functools import partial
from typing import Self

from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.rollout.stage import Order, Reply, Stage
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.system.workers import Worker, WorkerLostError, start_all, wait_for_any


class Simulators:
    """Simulator processes that stay for the next rollout of the same task, setting and size; a context manager."""

    def __init__(self) -> None:
        self._opened: dict[tuple[object, ...], Crew] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self, spec: RolloutSpec, render: bool) -> "Crew":
        """Those that an earlier rollout of this kind has left, or new ones.

        Args:
            spec: what is to be rolled out.
            render: whether there are pictures at all.

        Raises:
            SimulationError: no simulator starts.
        """
        key = (spec.task, spec.setting, tuple(spec.image_size), render, spec.shape, spec.timeout_s)
        if key not in self._opened:
            self._opened[key] = Crew(spec, render)
        self._opened[key].start()
        return self._opened[key]

    def close(self) -> None:
        """End all processes."""
        while self._opened:
            self._opened.popitem()[1].close()


class Crew:
    """The processes of one kind of rollout. Each carries out its orders in the order in which they were given.

    Args:
        spec: what is rolled out.
        render: whether there are pictures at all.
    """

    def __init__(self, spec: RolloutSpec, render: bool) -> None:
        workers, self._slots_per_worker = spec.shape
        self._timeout_s = spec.timeout_s
        open_task = partial(
            open_simulator, spec.task, setting=spec.setting, image_size=tuple(spec.image_size), render=render
        )
        build = partial(Stage, open_task, self._slots_per_worker)
        self.workers = [Worker(build, f"simulator process {index + 1}") for index in range(workers)]
        self._pending: list[deque[int]] = [deque() for _ in self.workers]  # slots with an order, oldest first
        self._heard = [0.0] * workers  # when a process last answered, or was given the first of its orders
        self._faults: dict[int, str] = {}

    @property
    def slots(self) -> int:
        """Number of episodes that can run at the same time; neighbours are in different processes."""
        return len(self.workers) * self._slots_per_worker

    def start(self) -> None:
        """Start the processes that do not run, and those that a rollout before left in the middle of an order."""
        self._pending, self._faults = [deque() for _ in self.workers], {}
        try:
            start_all([worker for worker in self.workers if worker.pid is None or worker.outstanding])
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the processes."""
        for worker in self.workers:
            worker.kill()

    def idle(self, slot: int) -> bool:
        """Whether the process of a slot has nothing to do."""
        return not self._pending[slot % len(self.workers)]

    def send(self, order: Order) -> None:
        """Give an order, without waiting for it; its slot is one of the crew's."""
        index = order.slot % len(self.workers)
        if not self._pending[index]:
            self._heard[index] = time.monotonic()
        self._pending[index].append(order.slot)
        try:
            self.workers[index].send("advance", order._replace(slot=order.slot // len(self.workers)))
        except WorkerLostError as error:
            self._faults.setdefault(index, str(error))

    def receive(self, block: bool) -> tuple[dict[int, Reply], dict[int, str | None]]:
        """What has been answered since the last call.

        Args:
            block: wait until there is something, if any order is open.

        Returns:
            replies by slot; and by slot what was lost with a process, which has been replaced. The oldest of its open
            orders is to blame, and that slot gets the reason; its other slots get None and can begin anew.
        """
        replies: dict[int, Reply] = {}
        while busy := {self.workers[i]: i for i, open_ in enumerate(self._pending) if open_ and i not in self._faults}:
            wait = max(0.0, min(self._heard[i] for i in busy.values()) + self._timeout_s - time.monotonic())
            ready = wait_for_any(list(busy), wait if block and not (replies or self._faults) else 0.0)
            for worker in ready:
                self._hear(busy[worker], worker, replies)
            if not ready:
                self._give_up(busy)
                break
        return replies, self._replace_lost()

    def _hear(self, index: int, worker: Worker, replies: dict[int, Reply]) -> None:
        try:
            reply = worker.receive()
        except WorkerLostError as error:
            self._faults[index] = str(error)
            return
        slot = self._pending[index].popleft()
        replies[slot], self._heard[index] = reply, time.monotonic()

    def _give_up(self, busy: dict[Worker, int]) -> None:
        """Processes that have been silent for too long are lost."""
        for worker, index in busy.items():
            if time.monotonic() - self._heard[index] >= self._timeout_s:
                self._faults[index] = str(worker.hung(self._timeout_s))

    def _replace_lost(self) -> dict[int, str | None]:
        lost: dict[int, str | None] = {}
        for index, fault in self._faults.items():
            slots = range(index, self.slots, len(self.workers))
            lost |= dict.fromkeys(slots) | {self._pending[index][0]: fault}
            self._pending[index].clear()
        faults, self._faults = self._faults, {}
        start_all([self.workers[index] for index in faults])
        return lost
