"""What is kept of an episode while it runs."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ugr_lightning.results.results import EpisodeResult
from ugr_lightning.rollout.actors import Decision
from ugr_lightning.rollout.film import compose_frames, draw_keyframes
from ugr_lightning.rollout.stage import Reply
from ugr_lightning.sim.frame import Frame


@dataclass
class EpisodeTrace:
    """What happened in an episode, step by step.

    Args:
        frames: N + 1 frames of the simulator; without their pictures unless the episode is filmed.
        actions: N commands (A,); None where the expert gave it.
        chunks: N items, the chunk (K, A) predicted in that step or None.
        log_variance: N items, its s_k (K,) or None.
        images: N + 1 items (V, H, W, 3) uint8 of a filmed episode, else empty.
        maps, points: N items of a filmed episode, where the policy saw the hands' next keyframes or None, see
            `Decision`; else empty.
        disagreement: highest of a chunk with earlier ones so far; None where no chunk was predicted.
        alarm: control step of the first alarm, or None.
    """

    frames: list[Frame] = field(default_factory=list)
    actions: list[np.ndarray | None] = field(default_factory=list)
    chunks: list[np.ndarray | None] = field(default_factory=list)
    log_variance: list[np.ndarray | None] = field(default_factory=list)
    images: list[np.ndarray] = field(default_factory=list)
    maps: list[np.ndarray | None] = field(default_factory=list)
    points: list[np.ndarray | None] = field(default_factory=list)
    disagreement: float | None = None
    alarm: int | None = None

    def motion_hash(self) -> str:
        """SHA-256 of the measured joints of all frames."""
        return hashlib.sha256(b"".join(frame.measured.tobytes() for frame in self.frames)).hexdigest()

    def video(self, every: int = 1) -> np.ndarray:
        """The filmed pictures with step, success, alarm, uncertainty and keyframes drawn in, (T, H', W', 3) uint8."""
        return compose_frames(
            draw_keyframes(self.images, self.maps, _held(self.points), [frame.projection for frame in self.frames]),
            log_variance=_held(self.log_variance)[: len(self.images)],
            success=[bool(frame.success) for frame in self.frames],
            alarm=self.alarm,
            every=every,
        )


def _held(values: list[np.ndarray | None]) -> list[np.ndarray | None]:
    """The newest value of each step and of the frame behind the last one."""
    newest: np.ndarray | None = None
    held = []
    for value in [*values, None]:
        newest = newest if value is None else value
        held.append(newest)
    return held


OnResult = Callable[[EpisodeResult, EpisodeTrace], None]


@dataclass
class RunningEpisode:
    """An episode that runs in a slot.

    Args:
        position: in the list of seeds.
        seed: simulator seed.
        filmed: whether its pictures are kept.
        trace: what has happened so far.
        fault: what is wrong with the next step, or None.
        horizon: control steps it may take.
        control_hz: control steps per second.
        query, simulate: seconds spent so far on the policy and in the simulator.
    """

    position: int
    seed: int
    filmed: bool
    trace: EpisodeTrace = field(default_factory=EpisodeTrace)
    fault: str | None = None
    horizon: int = 0
    control_hz: float = 25.0
    query: float = 0.0
    simulate: float = 0.0

    @property
    def steps(self) -> int:
        """Control steps executed."""
        return max(0, len(self.trace.frames) - 1)

    @property
    def success(self) -> bool:
        """Whether the task's condition has been met."""
        return bool(self.trace.frames) and bool(self.trace.frames[-1].success)

    def take(self, reply: Reply, decision: Decision | None) -> None:
        """Keep what the simulator showed.

        Args:
            reply: of the simulator.
            decision: what it carried out; None for the first frame of the episode.
        """
        for step, frame in enumerate(reply.frames):
            if self.filmed:
                self.trace.images.append(frame.images)
            self.trace.frames.append(frame._replace(images=frame.images[:0]))
            if decision is not None:
                self.trace.actions.append(None if decision.actions is None else decision.actions[step])
                self.trace.chunks.append(None if step else decision.chunk)
                self.trace.log_variance.append(None if step else decision.log_variance)
                if self.filmed:
                    self.trace.maps.append(None if step else decision.maps)
                    self.trace.points.append(None if step else decision.points)
        if decision is not None and decision.disagreement is not None:
            self.trace.disagreement = max(decision.disagreement, self.trace.disagreement or 0.0)
            self.trace.alarm = decision.alarm
        self.horizon, self.control_hz = reply.horizon, reply.control_hz
        self.simulate += reply.seconds
