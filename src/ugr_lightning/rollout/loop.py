"""The control loop over all slots: whoever is ready is decided for, while the others are simulated."""

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from ugr_lightning.errors import NumericsError
from ugr_lightning.results.results import EpisodeResult, summarize
from ugr_lightning.rollout.actors import Actor, Decision
from ugr_lightning.rollout.simulators import Crew
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.rollout.stage import Order, Reply
from ugr_lightning.rollout.trajectory import RunningEpisode
from ugr_lightning.sim.frame import Frame
from ugr_lightning.system.progress import Progress

EXPERT_STEPS = 25
"""Control steps that the expert takes between two messages."""

Ended = Callable[[RunningEpisode, str | None], EpisodeResult]


class ClosedLoop:
    """One run over a list of seeds.

    A slot is decided for when as many are ready as the actor likes to decide for at once, or as soon as a process would
    have nothing left to do. Free slots take the next seed. Slots know nothing of each other, and an actor decides for
    one whatever the others are (see `PolicyActor`): so what happens in an episode depends on its seed alone, and not on
    how many there are, or how fast a process was.

    Args:
        crew: the simulators; has started.
        actor: who decides; has begun.
        spec: what is rolled out.
        line: shows the progress.
        ended: makes the result of an episode, given why it crashed, if it did.
    """

    def __init__(self, crew: Crew, actor: Actor, spec: RolloutSpec, line: Progress, ended: Ended) -> None:
        self._crew, self._actor, self._line, self._ended = crew, actor, line, ended
        self._videos = spec.videos
        self._waiting = deque(enumerate(spec.seeds))
        self._free = list(range(crew.slots))
        self._running: dict[int, RunningEpisode] = {}  # by slot
        self._ready: dict[int, Frame] = {}  # newest frame of the slots that wait for a decision, oldest first
        self._decisions: dict[int, Decision] = {}  # what the others are carrying out
        self._results: dict[int, EpisodeResult] = {}  # by position in the list of seeds

    def finish(self) -> list[EpisodeResult]:
        """Run all episodes; results in the order of the seeds."""
        while self._waiting or self._running:
            self._fill()
            asked = self._decide()
            replies, lost = self._crew.receive(block=not asked)
            for slot, reply in replies.items():
                if slot not in lost:
                    self._take(slot, reply)
            for slot in lost.keys() & self._running.keys():
                self._lose(slot, lost[slot])
        return [self._results[position] for position in sorted(self._results)]

    def _fill(self) -> None:
        """Begin the next episodes in the free slots."""
        while self._waiting and self._free:
            slot = self._free.pop(0)
            position, seed = self._waiting.popleft()
            self._running[slot] = RunningEpisode(position, seed, filmed=seed in self._videos)
            look = bool(self._actor.cameras)
            self._crew.send(Order(slot, seed=seed, look=look, film=self._running[slot].filmed))

    def _decide(self) -> bool:
        """Ask the actor for some of those that are ready, if it is time; whether it was."""
        urgent = len(self._ready) >= self._actor.rows or any(self._crew.idle(slot) for slot in self._ready)
        if not self._ready or not urgent:
            return False
        asking = {slot: self._ready.pop(slot) for slot in list(self._ready)[: self._actor.rows]}
        start = time.perf_counter()
        decisions = self._actor.act(asking)
        share = (time.perf_counter() - start) / len(asking)
        for slot, decision in decisions.items():
            self._running[slot].query += share
            self._order(slot, decision)
        return True

    def _order(self, slot: int, decision: Decision) -> None:
        """Have a decision carried out; the episode ends before a step whose action is not finite."""
        episode = self._running[slot]
        whole = EXPERT_STEPS if decision.actions is None else len(decision.actions)
        steps, episode.fault = _sound_steps(decision, min(whole, episode.horizon - episode.steps), episode)
        if not steps:
            self._end(slot, episode.fault)
            return
        self._decisions[slot] = decision
        look = bool(self._actor.cameras)
        self._crew.send(Order(slot, actions=decision.actions, steps=steps, look=look, film=episode.filmed))

    def _take(self, slot: int, reply: Reply) -> None:
        episode, decision = self._running[slot], self._decisions.pop(slot, None)
        episode.take(reply, decision)
        begins = decision is None
        if reply.gave_up is not None:
            self._line.message(f"Seed {episode.seed}: {reply.gave_up}")
        if reply.crash is not None:
            self._end(slot, reply.crash)
        elif reply.over or episode.success or episode.steps >= episode.horizon:
            self._end(slot, None)
        elif episode.fault is not None:
            self._end(slot, episode.fault)
        else:
            self._ready[slot] = reply.frames[-1]
            if begins:
                self._actor.start(slot, episode.seed, reply.frames[-1])

    def _lose(self, slot: int, fault: str | None) -> None:
        """End an episode with its process, or begin it anew if it only ran beside the one that fell over."""
        self._ready.pop(slot, None)
        self._decisions.pop(slot, None)
        if fault is not None:
            self._end(slot, fault)
        else:
            episode = self._running.pop(slot)
            self._free.append(slot)
            self._waiting.appendleft((episode.position, episode.seed))

    def _end(self, slot: int, crash: str | None) -> None:
        episode = self._running.pop(slot)
        self._free.append(slot)
        if crash is not None:
            self._line.message(f"Seed {episode.seed} counts as a failure: {crash}")
        self._results[episode.position] = self._ended(episode, crash)
        self._line.advance(str(summarize(self._results.values())))


def _sound_steps(decision: Decision, steps: int, episode: RunningEpisode) -> tuple[int, str | None]:
    """How many of the first steps of a decision are finite, and what is wrong with the one after them."""
    if decision.log_variance is not None and not np.isfinite(decision.log_variance).all():
        return 0, _fault("log-variance", episode.steps, episode.seed, decision.log_variance)
    if decision.actions is None:
        return steps, None
    for step, action in enumerate(decision.actions[:steps]):
        if not np.isfinite(action).all():
            return step, _fault("action", episode.steps + step, episode.seed, action)
    return steps, None


def _fault(name: str, step: int, seed: int, values: np.ndarray) -> str:
    bad = ", ".join(map(str, np.flatnonzero(~np.isfinite(values))[:5]))
    where = f"{name} at step {step} of seed {seed}"
    return str(NumericsError(where, "finite numbers", f"NaN or infinity at {bad}", "Check the checkpoint."))
