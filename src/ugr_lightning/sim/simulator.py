"""What every simulator offers, whatever simulates: the one interface that recorders, rollouts and benchmarks know."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Self

import numpy as np

from ugr_lightning.embodiment import ACTION_DIM
from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim.expert import ExpertStep
from ugr_lightning.sim.frame import Frame, camera_projections, checked_command
from ugr_lightning.sim.kinematics import UnreachableError


class Simulator(ABC):
    """Runs episodes of one task, one after the other; numpy in and out; a context manager.

    A subclass says what is particular to its environment; what a caller may do wrong is checked here.

    Args:
        task: name of the task.
        setting: how the surroundings vary.
        image_size: (H, W).
        render: whether frames have images.
        speed: of the expert; divides the durations of its motions.

    Raises:
        ConfigError: an impossible image size or speed.
        SimulationError: what simulates is not installed, or cannot render here.
    """

    cameras: tuple[str, ...]
    """Names of the pictures of a frame, in their order."""
    horizon: int
    """Control steps that an episode may take."""
    control_hz: float
    """Control steps per second."""
    action_dim: int = ACTION_DIM
    """A, numbers of a command."""
    task_version: int
    """Raised whenever the same seed means something else."""
    gave_up: str | None = None
    """What the expert of the episode could not reach, which ended it early; None where there was no such pose."""

    def __init__(
        self,
        task: str,
        *,
        setting: str = "demo_clean",
        image_size: tuple[int, int] = (120, 160),
        render: bool = True,
        speed: float = 1.0,
    ) -> None:
        if min(image_size) < 1:
            raise ConfigError("image_size", "two positive numbers (H, W)", image_size, "Use e.g. (120, 160).")
        if not speed > 0:
            raise ConfigError("speed", "a positive number", speed, "Use 1.0 for the normal speed.")
        self.task, self.setting, self.speed = task, setting, speed
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self._render = render
        self._seed: int | None = None
        self._succeeded = False
        self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self, seed: int, *, look: bool = True) -> Frame:
        """Start the episode of a seed; the same one, whatever ran before.

        Args:
            seed: of the episode.
            look: whether the frame has images.
        """
        self._seed, self._succeeded, self.gave_up = int(seed), False, None
        self._start(int(seed))
        return self._shown(look)

    def step(self, action: np.ndarray, *, look: bool = True) -> Frame:
        """Command joint targets for one control step.

        Args:
            action: (A,) robot units; clipped to the limits.
            look: whether the frame has images; taking them is nine tenths of the time of a step.

        Raises:
            NumericsError: the action has a NaN or an infinity; the environment has not seen it.
            SimulationError: `reset` has not been called, or an action of another length.
        """
        self._require_episode()
        self._succeeded = self._advance(checked_command(action, self.action_dim)) or self._succeeded
        return self._shown(look)

    def expert(self) -> Iterator[ExpertStep]:
        """The scripted expert of the current episode.

        It reads the simulator's state as it goes, so each of its steps has to be executed (with or without noise)
        before the next is asked for. It ends early where an object has got out of reach; `gave_up` then says where.
        """
        self._require_episode()
        return self._up_to_a_pose_out_of_reach()

    def scene_info(self) -> dict[str, Any]:
        """Seed, and where things were at reset, as plain containers."""
        self._require_episode()
        return {"seed": self._seed, **self._describe()}

    @abstractmethod
    def camera_parameters(self) -> dict[str, dict[str, np.ndarray]]:
        """Per camera `intrinsic_cv` (3, 3), `extrinsic_cv` (3, 4) and `cam2world_gl` (4, 4) at this moment."""

    @abstractmethod
    def close(self) -> None:
        """Free what was opened."""

    @abstractmethod
    def _open(self) -> None:
        """Make the environment."""

    @abstractmethod
    def _start(self, seed: int) -> None:
        """Begin the episode of a seed; the same one, whatever ran before."""

    @abstractmethod
    def _advance(self, action: np.ndarray) -> bool:
        """Execute a finite command (A,) for one control step; whether the task's condition was met in it."""

    @abstractmethod
    def _frame(self, images: np.ndarray, success: bool) -> Frame:
        """The frame of this moment with these images."""

    @abstractmethod
    def _pictures(self) -> np.ndarray:
        """(V, H, W, 3) uint8 RGB of all `cameras` at this moment."""

    @abstractmethod
    def _demonstrate(self) -> Iterator[ExpertStep]:
        """The scripted expert, from the current state on; an UnreachableError ends the demonstration."""

    @abstractmethod
    def _describe(self) -> dict[str, Any]:
        """Where things were at reset, as plain containers."""

    def _up_to_a_pose_out_of_reach(self) -> Iterator[ExpertStep]:
        try:
            yield from self._demonstrate()
        except UnreachableError as error:
            self.gave_up = str(error)

    def _require_episode(self) -> None:
        if self._seed is None:
            raise SimulationError("simulator", "a running episode", "none", "Call reset(seed) first.")

    def _shown(self, look: bool) -> Frame:
        if not (self._render and look):
            return self._frame(np.empty((0, *self.image_size, 3), np.uint8), self._succeeded)
        frame = self._frame(self._pictures(), self._succeeded)
        parameters = self.camera_parameters()
        if not set(self.cameras) <= parameters.keys():
            return frame
        ordered = {name: parameters[name] for name in self.cameras}
        return frame._replace(projection=camera_projections(ordered, self.image_size))
