"""The simulators of one worker process: each slot runs one episode at a time."""

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ugr_lightning.sim.expert import ExpertStep
from ugr_lightning.sim.frame import Frame
from ugr_lightning.sim.simulator import Simulator
from ugr_lightning.system.workers import describe_error


class Order(NamedTuple):
    """What a slot is to do until somebody has to look at it again.

    Args:
        slot: slot of the worker, from 0.
        seed: start the episode of this seed; None goes on with the running one.
        actions: (n, A) commands of the next n control steps; None leaves them to the expert.
        steps: n.
        look: whether somebody will look at the pictures of the last frame.
        film: whether all frames have pictures.
    """

    slot: int
    seed: int | None = None
    actions: np.ndarray | None = None
    steps: int = 0
    look: bool = True
    film: bool = False


class Reply(NamedTuple):
    """What came of an order.

    Args:
        slot: slot of the worker.
        frames: what the simulator showed, one per control step; they end early with success or a crash.
        horizon: control steps that an episode may take.
        control_hz: control steps per second.
        seconds: wall-clock time of the order.
        over: whether the expert has nothing more to do.
        gave_up: what the expert could not reach, or None.
        crash: why the simulator failed, or None.
    """

    slot: int
    frames: list[Frame]
    horizon: int
    control_hz: float
    seconds: float
    over: bool = False
    gave_up: str | None = None
    crash: str | None = None


class Stage:
    """Holds simulators and moves them on; lives in a worker process.

    Args:
        open_task: opens a simulator; called for the first slot now, for others with their first order.
        slots: how many at most.
    """

    def __init__(self, open_task: Callable[[], Simulator], slots: int) -> None:
        self._open_task = open_task
        self._simulators: list[Simulator | None] = [open_task(), *[None] * (slots - 1)]
        self._experts: list[Iterator[ExpertStep] | None] = [None] * slots

    def advance(self, order: Order) -> Reply:
        """Carry out an order; a slot that fails does not harm the others."""
        start, slot = time.perf_counter(), order.slot
        simulator = self._simulators[slot] = self._simulators[slot] or self._open_task()
        frames: list[Frame] = []
        over, crash = False, None
        horizon, control_hz = int(simulator.horizon), float(simulator.control_hz)
        try:
            over = self._play(simulator, order, frames)
        except Exception as error:  # whatever it is, it ends this episode only; the result says what it was
            crash = describe_error(error)
            self._simulators[slot] = None
        seconds = time.perf_counter() - start
        return Reply(slot, frames, horizon, control_hz, seconds, over, simulator.gave_up, crash)

    def _play(self, simulator: Simulator, order: Order, frames: list[Frame]) -> bool:
        """Put the frames of an order into a list; whether the expert has come to its end."""
        if order.seed is not None:
            self._experts[order.slot] = None
            frames.append(simulator.reset(order.seed, look=order.look or order.film))
            return False
        for step in range(order.steps):
            action = self._intention(simulator, order.slot) if order.actions is None else order.actions[step]
            if action is None:
                return True
            look = order.film or (order.look and step == order.steps - 1)
            frames.append(simulator.step(action, look=look))
            if frames[-1].success:
                break
        return False

    def _intention(self, simulator: Simulator, slot: int) -> np.ndarray | None:
        """What the expert of a slot wants now; None when it has nothing more to do."""
        expert = self._experts[slot]
        if expert is None:
            expert = self._experts[slot] = simulator.expert()
        intention = next(expert, None)
        return None if intention is None else intention.action
