"""One task in one simulator, reused over episodes: plain numpy in and out."""

import functools
import gc
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.sim.expert import Arms, ExpertStep
from ugr_lightning.sim.frame import Frame
from ugr_lightning.sim.kinematics import SIDES
from ugr_lightning.sim.render import render_device
from ugr_lightning.sim.simulator import Simulator
from ugr_lightning.sim.tasks import load_task


@functools.cache
def _keep_imports_from_collection() -> None:
    """ManiSkill collects garbage at every reset; among all that torch imports, that takes 200 ms instead of 10."""
    gc.collect()
    gc.freeze()


class SapienSimulator(Simulator):
    """Runs episodes of a task on our table, bit for bit the same for the same seed.

    Set `OMP_NUM_THREADS=1` in processes that simulate: SAPIEN uses one core, and torch's threads only get in its way.

    Args:
        task: a name from `task_names`.
        setting: how the surroundings vary.
        image_size: (H, W).
        render: whether frames have images; without, no Vulkan is needed.
        speed: of the expert; divides the durations of its motions.

    Raises:
        ConfigError: unknown task or setting, or an impossible image size or speed.
        SimulationError: SAPIEN is not installed.
    """

    cameras = CAMERAS

    def camera_parameters(self) -> dict[str, dict[str, np.ndarray]]:
        self._require_episode()
        sensors = self._env._sensors if self._render else {}
        return {
            name: {key: value[0].numpy().copy() for key, value in sensors[name].get_params().items()}
            for name in CAMERAS
            if name in sensors
        }

    def close(self) -> None:
        self._env.close()
        self._seed = None

    def _open(self) -> None:
        environment = load_task(self.task)
        self.horizon, self.task_version = environment.horizon, environment.version
        os.environ.setdefault("MS_RENDERER_LOG_LEVEL", "error")
        _keep_imports_from_collection()
        self._env = environment(
            setting=self.setting,
            image_size=self.image_size,
            obs_mode="none",
            render_backend=render_device() if self._render else "none",
        )
        self.control_hz = float(self._env.control_freq)

    def _start(self, seed: int) -> None:
        self._env.reset(seed=seed)
        self._scene = {**self._env.describe(), "surroundings": self._env.surroundings.describe()}

    def _advance(self, action: np.ndarray) -> bool:
        self._env._step_action(action)
        return bool(self._env.succeeded)

    def _demonstrate(self) -> Iterator[ExpertStep]:
        return self._env.expert(Arms(self._env.command, self.speed, self._env.surroundings.table_drop))

    def _describe(self) -> dict[str, Any]:
        return self._scene

    def _frame(self, images: np.ndarray, success: bool) -> Frame:
        poses = [self._env.tool_pose(side) for side in SIDES]
        touching = {touch.side for touch in self._env.touches()}
        return Frame(
            images=images,
            commanded=self._env.command.copy(),
            measured=self._env.agent.measured(),
            endpose=np.array([[*pose.p, *pose.q] for pose in poses], np.float64),
            contacts=np.array([side in touching for side in SIDES]),
            success=success,
        )

    def _pictures(self) -> np.ndarray:
        images = np.empty((len(CAMERAS), *self.image_size, 3), np.uint8)
        self._env.scene.sub_scenes[0].update_render()
        cameras = [self._env._sensors[name].camera._render_cameras[0] for name in CAMERAS]
        for camera in cameras:
            camera.take_picture()
        for image, camera in zip(images, cameras, strict=True):
            image[:] = camera.get_picture("Color")[..., :3]  # (H, W, 4) uint8, r8g8b8a8unorm
        return images
