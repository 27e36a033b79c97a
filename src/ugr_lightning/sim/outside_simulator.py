"""What an environment made by others has to offer to be a task of our runner."""

from abc import abstractmethod
from typing import Any

import numpy as np

from ugr_lightning.errors import ConfigError
from ugr_lightning.sim.simulator import Simulator

SETTING = "demo_clean"


class OutsideSimulator(Simulator):
    """A simulator of one outside environment, whose surroundings are its own.

    Args:
        task: name of the task.
        setting: `demo_clean`.
        options: those of every simulator.

    Raises:
        ConfigError: another setting, or an impossible image size or speed.
        SimulationError: the environment is not installed, or cannot render here.
    """

    version: int
    """Raised whenever the same seed means something else."""
    viperx: bool = False
    """Whether its arms are two ViperX 300s, whose kinematics are those of ours."""

    def __init__(self, task: str, *, setting: str = SETTING, **options: Any) -> None:
        if setting != SETTING:
            raise ConfigError("setting", f"`{SETTING}` for {task}", repr(setting), "An outside task has no other.")
        self.task_version = self.version
        super().__init__(task, setting=setting, **options)

    @abstractmethod
    def _picture(self, camera: str) -> np.ndarray:
        """(H, W, 3) uint8 RGB of one of `cameras` at this moment."""

    def _pictures(self) -> np.ndarray:
        images = np.empty((len(self.cameras), *self.image_size, 3), np.uint8)  # (V, H, W, 3)
        for image, name in zip(images, self.cameras, strict=True):
            image[:] = self._picture(name)
        return images
