"""What can act in the simulator: a policy, and the dummies `zero`, `random` and `expert` to compare it with."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch

from ugr_lightning.contract import CAMERAS, ChunkPolicy, Observation
from ugr_lightning.embodiment import last_of_each_arm
from ugr_lightning.errors import CheckpointError
from ugr_lightning.rollout.aggregation import Execution, make_execution
from ugr_lightning.rollout.alarm import Alarm, Watch
from ugr_lightning.rollout.overlap import action_unit

ROWS = 4
"""Rows of a whole query; fewer would make poor use of a processor, more would often be idle."""


HELD_STEPS = 25
"""Control steps for which those who see nothing command at once."""


class FrameView(Protocol):
    """What an actor sees of a frame, of a simulator or of another program."""

    @property
    def images(self) -> np.ndarray:
        """(V, H, W, 3) uint8 RGB; V is 0 where nobody looks."""

    @property
    def commanded(self) -> np.ndarray:
        """(S,) joint targets in force, robot units."""

    @property
    def measured(self) -> np.ndarray:
        """(S,) joints, robot units."""

    @property
    def projection(self) -> np.ndarray | None:
        """(V, 3, 4) float32, see `embodiment.image_projection`; None where nobody knows."""


class Decision(NamedTuple):
    """What a slot does until the actor has to see it again.

    Args:
        actions: (n, A) commands of the next n control steps; None leaves them to the expert in the simulator.
        chunk: (K, A) that was predicted in this step; None where there is none.
        log_variance: (K,) s_k of that chunk; None where there is none.
        maps: (V, 2, 2, h, w) where each camera saw the hands' next keyframes in this step, see `Chunk`; zero for
            cameras that the policy does not look through, None where it does not look for keyframes.
        points: (2, 2, 3) these points in the world, m.
        disagreement: of that chunk with earlier ones, see `near_disagreement`; 0 where it overlaps with none.
        alarm: control step of the episode at which it was first raised, see `Alarm`; None before.
    """

    actions: np.ndarray | None
    chunk: np.ndarray | None = None
    log_variance: np.ndarray | None = None
    maps: np.ndarray | None = None
    points: np.ndarray | None = None
    disagreement: float | None = None
    alarm: int | None = None


NOTHING = Decision(None)


class Actor(ABC):
    """Decides for several slots at once; what it decides for one depends on that slot alone.

    Attributes:
        name: what results call it.
        execution: how chunks are executed, as results say it; `1` where there are no chunks.
        cameras: the pictures it needs; without any the simulators do not render.
        refine: class of what chooses the steps that are refined, or None.
        refine_ratio: share of each chunk that is refined, where that is not as in training.
        checkpoint: SHA-256 of the checkpoint that acts, or None.
        alarm: what raises an alarm in this run, or None.
        rows: for how many slots it likes to decide at once; no more are given to it.
    """

    name: str
    execution: str = "1"
    refine: str | None = None
    refine_ratio: float | None = None
    checkpoint: str | None = None
    alarm: Alarm | None = None
    cameras: tuple[str, ...] = ()
    rows: int = 1

    def begin(self, slots: int, execution: str | int) -> None:  # noqa: B027 - most have nothing to prepare
        """Prepare for a run.

        Args:
            slots: number of slots.
            execution: `aggregate`, `aggregate-variance` or the number of steps executed of each chunk.
        """

    def end(self) -> None:  # noqa: B027 - most have nothing to tidy up
        """Tidy up after a run."""

    def called(self, execution: str | int) -> str:
        """What results call an execution of this actor, also before it has begun."""
        return self.execution

    @abstractmethod
    def start(self, slot: int, seed: int, frame: FrameView) -> None:
        """An episode begins in a slot; `frame` is its first one."""

    @abstractmethod
    def act(self, frames: Mapping[int, FrameView]) -> dict[int, Decision]:
        """Decide for some slots, given the newest frame of each."""


class Zero(Actor):
    """Keeps commanding the pose that the episode started in."""

    name = "zero"

    def __init__(self) -> None:
        self._home: dict[int, np.ndarray] = {}

    def start(self, slot: int, seed: int, frame: FrameView) -> None:
        self._home[slot] = np.tile(np.asarray(frame.commanded, np.float32), (HELD_STEPS, 1))  # (n, A)

    def act(self, frames: Mapping[int, FrameView]) -> dict[int, Decision]:
        return {slot: Decision(self._home[slot]) for slot in frames}


class Random(Actor):
    """Commands a new pose every ten steps, the joints within 0.5 rad of the first one; the episode's seed decides."""

    name = "random"

    def __init__(self) -> None:
        self._slots: dict[int, tuple[np.random.Generator, np.ndarray]] = {}

    def start(self, slot: int, seed: int, frame: FrameView) -> None:
        self._slots[slot] = (np.random.default_rng(seed), np.array(frame.commanded, np.float32))

    def act(self, frames: Mapping[int, FrameView]) -> dict[int, Decision]:
        return {slot: Decision(self._pose(*self._slots[slot])) for slot in frames}

    def _pose(self, random: np.random.Generator, home: np.ndarray) -> np.ndarray:
        grippers = list(last_of_each_arm(len(home)))
        pose = home + random.uniform(-0.5, 0.5, len(home))  # (A,)
        pose[grippers] = random.uniform(0.0, 1.0, len(grippers))
        return np.tile(pose.astype(np.float32), (10, 1))  # (n, A)


class Expert(Actor):
    """Leaves every command to the task's scripted expert."""

    name = "expert"

    def start(self, slot: int, seed: int, frame: FrameView) -> None:
        """Nothing to do: the expert lives in the simulator."""

    def act(self, frames: Mapping[int, FrameView]) -> dict[int, Decision]:
        return dict.fromkeys(frames, Decision(None))


class PolicyActor(Actor):
    """A policy, queried for those of the given slots that need a chunk.

    The number of rows of a query can decide how sums are split up, and so the last bits of what comes out. For an
    episode to go the same way whatever the number of slots, and whichever others are running, a query has `ROWS` rows,
    some of them idle; or as few as ask, where this machine has shown that it computes the same bits then.

    Args:
        policy: predicts the chunks.
        name: what results call it; None takes the name of its class.
        state: what it sees of the joints, `commanded` or `measured`; as in its training.
        cameras: those of the simulator, in the order of its frames.
        refine_ratio: share of each chunk that the policy refines, where that is not as in its training; for results.
        checkpoint: SHA-256 of its checkpoint; for results.
        control_hz: actions per second of the data it was trained on; None where nobody knows.
        alarms: by execution what raises an alarm; for the refinement of its training.

    Raises:
        CheckpointError: the policy needs a camera that is not there.
    """

    rows = ROWS

    def __init__(
        self,
        policy: ChunkPolicy,
        *,
        name: str | None = None,
        state: Literal["commanded", "measured"] = "commanded",
        cameras: Sequence[str] = CAMERAS,
        refine_ratio: float | None = None,
        checkpoint: str | None = None,
        control_hz: float | None = None,
        alarms: Mapping[str, Alarm] | None = None,
    ) -> None:
        unknown = [camera for camera in policy.cameras if camera not in cameras]
        if unknown:
            fix = "Roll out a policy that was trained on these cameras."
            raise CheckpointError("policy.cameras", f"cameras among {', '.join(cameras)}", ", ".join(unknown), fix)
        self.policy, self.state, self.refine_ratio = policy, state, refine_ratio
        self.name, self.checkpoint, self.control_hz = name or type(policy).__name__, checkpoint, control_hz
        self.cameras, self.alarms = tuple(policy.cameras), alarms or {}
        chooses = getattr(policy, "refine", None)  # of policies that refine
        self.refine = type(chooses).__name__ if chooses is not None else None
        self._views, self._present = [list(cameras).index(camera) for camera in self.cameras], len(cameras)
        self._execution: Execution | None = None
        self._was_training = False

    def begin(self, slots: int, execution: str | int) -> None:
        """Make the execution and the fixed-size batch; the policy goes into evaluation mode."""
        policy = self.policy
        self._execution = make_execution(execution, policy.chunk_length, policy.action_dim, slots)
        self.execution = self._execution.name
        self.alarm = self.alarms.get(self.execution) if self.refine_ratio is None else None
        if self.alarms and self.alarm is None:
            fix = "it was set for the refinement of the training and execution " + ", ".join(self.alarms)
            warnings.warn(f"No alarm with execution {self.execution}: {fix}. `ugr alarm` sets others.", stacklevel=2)
        self._unit, self._watches = action_unit(policy), dict[int, Watch]()
        self._sizes: list[int] | None = None  # numbers of rows that a query may have
        self._state = torch.zeros(slots, policy.observation_steps, policy.state_dim)  # (B, T, S), oldest first
        self._images: torch.Tensor | None = None
        self._projection: torch.Tensor | None = None
        self._new: set[int] = set()  # slots whose episode begins
        tensors = [*policy.parameters(), *policy.buffers()]
        self._device = tensors[0].device if tensors else torch.device("cpu")
        self._was_training = policy.training
        policy.eval()

    def called(self, execution: str | int) -> str:
        text = str(execution).strip()
        return str(int(text)) if text.isdigit() else text

    def end(self) -> None:
        self.policy.train(self._was_training)

    def start(self, slot: int, seed: int, frame: FrameView) -> None:
        assert self._execution is not None
        self._execution.reset(slot)
        self._watches[slot] = Watch(self.policy.chunk_length, self._unit, self.alarm)
        self._new.add(slot)

    def act(self, frames: Mapping[int, FrameView]) -> dict[int, Decision]:
        """Query the policy for the slots that need it; all get their actions up to the next frame that matters."""
        assert self._execution is not None
        for slot, frame in frames.items():
            self._see(slot, frame)
        asking = [slot for slot in sorted(frames) if self._execution.needs_query(slot)]
        predicted = dict(zip(asking, self._query(asking) if asking else (), strict=True))
        for slot, answer in predicted.items():
            assert answer.chunk is not None
            self._execution.push(slot, answer.chunk, answer.log_variance)
            watch = self._watches[slot]
            predicted[slot] = answer._replace(disagreement=watch.see(answer.chunk), alarm=watch.raised)
        decisions = {}
        for slot in frames:
            actions = self._known(slot)  # (n, A)
            self._watches[slot].step += len(actions)
            decisions[slot] = predicted.get(slot, NOTHING)._replace(actions=actions)
        return decisions

    def _known(self, slot: int) -> np.ndarray:
        """Actions (n, A) after which comes the first frame that will be among the observations of a query."""
        assert self._execution is not None
        blind = self._execution.steps_left(slot) - self.policy.observation_steps
        return np.stack([self._execution.next(slot) for _ in range(1 + max(0, blind))])

    def _see(self, slot: int, frame: FrameView) -> None:
        """Put a frame behind the slot's earlier ones; the first of an episode takes the place of all."""
        if self._images is None:
            shape = (*self._state.shape[:2], len(self._views), *frame.images.shape[1:3], 3)
            self._images = torch.zeros(shape, dtype=torch.uint8)  # (B, T, V, H, W, 3)
            if frame.projection is not None:
                self._projection = torch.zeros(*shape[:3], 3, 4)  # (B, T, V, 3, 4)
        kept = slice(None) if slot in self._new else slice(-1, None)
        self._new.discard(slot)
        kinds = (self._images, self._state, self._projection)  # (B, T, V, H, W, 3), (B, T, S), (B, T, V, 3, 4)
        for past in (kind[slot] for kind in kinds if kind is not None):
            past[:-1] = past[1:].clone()
        self._images[slot][kept] = torch.from_numpy(frame.images[self._views])  # (V, H, W, 3)
        if self._projection is not None and frame.projection is not None:
            self._projection[slot][kept] = torch.from_numpy(frame.projection[self._views])  # (V, 3, 4)
        self._state[slot][kept] = torch.from_numpy(np.asarray(getattr(frame, self.state), np.float32))  # (S,)

    def _query(self, slots: list[int]) -> list[Decision]:
        """What is predicted for what some slots see, in their order; without actions."""
        assert self._images is not None
        if self._sizes is None:
            self._sizes = self._exact_sizes(slots[0])
        found: list[Decision] = []
        for first in range(0, len(slots), ROWS):
            asking = slots[first : first + ROWS]
            size = next(size for size in self._sizes if size >= len(asking))
            rows = asking + asking[:1] * (size - len(asking))
            answer = self._predict(self._images[rows], self._state[rows], self._projected(rows))
            of_rows = [[None if part is None else part[row] for part in answer] for row in range(len(asking))]
            found += [Decision(None, *parts) for parts in of_rows]
        return found

    def _exact_sizes(self, slot: int) -> list[int]:
        """Numbers of rows at which noise is answered as among `ROWS` rows, bit for bit; and `ROWS`.

        Args:
            slot: one that sees something.
        """
        assert self._images is not None
        noise = torch.Generator().manual_seed(0)
        images = torch.randint(256, (ROWS, *self._images.shape[1:]), generator=noise, dtype=torch.uint8)
        state = self._state[[slot]] + 0.1 * torch.randn(ROWS, *self._state.shape[1:], generator=noise)  # (ROWS, T, S)
        cameras = self._projected([slot] * ROWS)  # (ROWS, T, V, 3, 4)
        whole = self._predict(images, state, cameras)
        sizes = []
        for size in range(1, ROWS):
            part = self._predict(images[:size], state[:size], None if cameras is None else cameras[:size])
            if all(a is None or b is None or np.array_equal(a[:size], b) for a, b in zip(whole, part, strict=True)):
                sizes.append(size)
        return [*sizes, ROWS]

    def _projected(self, rows: list[int]) -> torch.Tensor | None:
        """Calibration of what some slots see, (B, T, V, 3, 4)."""
        return None if self._projection is None else self._projection[rows]

    def _predict(
        self, images: torch.Tensor, state: torch.Tensor, projection: torch.Tensor | None
    ) -> tuple[np.ndarray | None, ...]:
        """Chunks, s_k, maps of all cameras and points, from (B, T, V, H, W, 3), (B, T, S) and (B, T, V, 3, 4)."""
        images, state = images.to(self._device), state.to(self._device)
        projection = None if projection is None else projection.to(self._device)
        if self.policy.observation_steps == 1:
            images, state = images[:, 0], state[:, 0]  # (B, V, H, W, 3), (B, S)
            projection = None if projection is None else projection[:, 0]  # (B, V, 3, 4)
        with torch.no_grad():  # not inference_mode: what a policy caches here must still serve its training
            seen = Observation(images.movedim(-1, -3), state, projection)  # a view: channels stay last in memory
            chunk = self.policy.predict(seen)
        parts = (chunk.actions, chunk.log_variance, self._of_all_cameras(chunk.maps), chunk.points)
        return tuple(None if part is None else part.float().cpu().numpy() for part in parts)

    def _of_all_cameras(self, maps: torch.Tensor | None) -> torch.Tensor | None:
        """Maps (B, V, 2, 2, h, w) at the places that the cameras have in a frame."""
        if maps is None:
            return None
        whole = maps.new_zeros(len(maps), self._present, *maps.shape[2:])
        whole[:, self._views] = maps
        return whole


DUMMIES: dict[str, type[Actor]] = {"zero": Zero, "random": Random, "expert": Expert}
