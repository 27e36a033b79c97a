"""Pick up a red cube with the right arm and hand it to the left one: gym-aloha's transfer task, in MuJoCo."""

import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from ugr_lightning.embodiment import TCP_OFFSET
from ugr_lightning.errors import SimulationError
from ugr_lightning.sim.expert import Arms, ExpertStep, facing, gripper_level
from ugr_lightning.sim.frame import Frame
from ugr_lightning.sim.kinematics import (
    JOINT_HIGH,
    JOINT_LOW,
    SIDES,
    UP,
    Array,
    TcpPose,
    rotation_x,
    rotation_y,
)
from ugr_lightning.sim.outside_simulator import OutsideSimulator

ENVIRONMENT = "gym_aloha/AlohaTransferCube-v0"
STEPS_PER_COMMAND = 2  # of the environment, which runs at 50 Hz
LIMIT = 400  # of the environment's steps; what the published success rates count within
SUCCESS = 4  # the reward for a cube that touches the left gripper and not the table
WITHOUT_SHADOWS = {"shadow": False, "reflection": False}  # on a processor a picture takes a fifth of the time then

TABLE: Array = np.array([0.0, 0.5, 0.0])  # where the origin of our two arms is in their world
LOW, HIGH = (np.tile(np.append(limit, grip), 2) for limit, grip in ((JOINT_LOW, 0.0), (JOINT_HIGH, 1.0)))

TILT = np.radians(60.0)  # of the right gripper below the horizontal, so that both grippers find room at the cube
MEETING: Array = np.array([0.0, 0.0, 0.25])
HOVER = 0.09
READY = 0.13  # how far from the cube the left gripper gets ready


class AlohaTransferCube(OutsideSimulator):
    """gym-aloha's environment as it is but for its pictures: only `top`, at any size, and without shadows.

    A command is held for two of the environment's steps, so that there are 25 in a second as in all our tasks. The
    success is the environment's own, at any of its steps.

    Source: gym-aloha 0.1.5, https://pypi.org/project/gym-aloha/0.1.5/.
    """

    cameras = ("top",)
    version = 1
    horizon = LIMIT // STEPS_PER_COMMAND
    control_hz = 50.0 / STEPS_PER_COMMAND
    viperx = True

    def camera_parameters(self) -> dict[str, dict[str, np.ndarray]]:
        """Of the one camera, which never moves."""
        self._require_episode()
        camera = self._physics.model.name2id("top", "camera")
        world = np.eye(4)
        world[:3, :3] = self._physics.data.cam_xmat[camera].reshape(3, 3)  # looks along -z, y is up
        world[:3, 3] = self._physics.data.cam_xpos[camera]
        height, width = self.image_size
        focal = height / 2.0 / np.tan(np.radians(self._physics.model.cam_fovy[camera]) / 2.0)
        intrinsic = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
        extrinsic = np.linalg.inv(world @ np.diag([1.0, -1.0, -1.0, 1.0]))[:3]
        return {"top": {"intrinsic_cv": intrinsic, "extrinsic_cv": extrinsic, "cam2world_gl": world}}

    def close(self) -> None:
        self._physics.free()
        self._env.close()

    def _open(self) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")
        try:
            import gym_aloha  # noqa: F401 - registers the environment
            import gymnasium
        except (ImportError, AttributeError, OSError) as error:  # a missing library of EGL is any of these
            fix = "Install `ugr-lightning[aloha]` and EGL (Debian: libegl1, libegl-mesa0), or set MUJOCO_GL=osmesa."
            raise SimulationError(
                self.task, "gym-aloha and dm-control", f"{type(error).__name__}: {error}", fix
            ) from error
        self._env = gymnasium.make(
            ENVIRONMENT, obs_type="pixels_agent_pos", max_episode_steps=LIMIT, disable_env_checker=True
        )
        control: Any = self._env.unwrapped._env  # type: ignore[attr-defined]
        self._physics, task = control.physics, control.task
        # The environment draws three pictures of 640 x 480 in every step, and shows one of them.
        no_picture = {"top": np.empty((0, 0, 3), np.uint8)}
        task.get_observation = lambda physics: {"qpos": task.get_qpos(physics), "images": no_picture}

    def _start(self, seed: int) -> None:
        self._measured = self._env.reset(seed=seed)[0]["agent_pos"]
        self._commanded = self._measured.astype(np.float32)
        self._cube_start = self._cube()

    def _advance(self, action: np.ndarray) -> bool:
        self._commanded = np.clip(action, LOW, HIGH).astype(np.float32)
        best = 0.0
        for _ in range(STEPS_PER_COMMAND):
            observation, reward, *_ = self._env.step(self._commanded)
            self._measured, best = observation["agent_pos"], max(best, float(reward))
        return best == SUCCESS

    def _frame(self, images: np.ndarray, success: bool) -> Frame:
        links = [f"vx300s_{side}/gripper_link" for side in SIDES]
        ahead = [self._physics.named.data.xmat[link].reshape(3, 3)[:, 0] for link in links]  # along the fingers
        poses = self._physics.named.data.xpos[links] + TCP_OFFSET * np.stack(ahead)  # (2, 3) between the finger pads
        turns = self._physics.named.data.xquat[links]  # (2, 4)
        touched = self._touched()
        return Frame(
            images=images,
            commanded=self._commanded.copy(),
            measured=self._measured.astype(np.float32),
            endpose=np.concatenate([poses, turns], axis=1),  # (2, 7)
            contacts=np.array([any(f"{side}/10_" in name for name in touched) for side in SIDES]),
            success=success,
        )

    def _picture(self, camera: str) -> np.ndarray:
        height, width = self.image_size
        return self._physics.render(height, width, camera_id=camera, render_flag_overrides=WITHOUT_SHADOWS)

    def _demonstrate(self) -> Iterator[ExpertStep]:
        """Grasp the cube from above, lift it to the middle, and let the left gripper take it from the side."""
        arms = Arms(self._commanded, self.speed)
        down = gripper_level(facing("right")) @ rotation_y(TILT)
        level = gripper_level(facing("left")) @ rotation_x(np.pi / 2.0)  # its fingers above and below the cube
        cube = self._cube()
        above = TcpPose(cube + HOVER * UP, down)
        yield from arms.move({"right": above}, steps=38, phase="reach", grip={"right": 1.0}, overlap=10)
        grasp = TcpPose(self._cube(), down)
        yield from arms.move({"right": grasp}, steps=24, phase="descend", slack=(1.0, 0.3, 0.0, 0.0))
        yield from arms.grip({"right": 0.0}, steps=16, phase="grasp-right")
        ready = TcpPose(MEETING - np.array([READY, 0.0, 0.0]), level)
        meeting = {"right": TcpPose(MEETING, down), "left": ready}
        yield from arms.move(meeting, steps=40, phase="meet", slack=(0.0, 1.0, 0.7, 0.3), grip={"left": 1.0})
        take = TcpPose(self._cube(), level)
        yield from arms.move({"left": take}, steps=22, phase="approach", slack=(0.3, 0.2, 0.0))
        yield from arms.grip({"left": 0.0}, steps=18, phase="grasp-left")
        yield from arms.grip({"right": 1.0}, steps=10, phase="release-right")
        back = TcpPose(MEETING + np.array([0.1, 0.0, 0.06]), down)
        yield from arms.move({"right": back}, steps=16, phase="retreat", slack=(0.0, 0.5))

    def _describe(self) -> dict[str, Any]:
        return {"cube": self._cube_start.tolist()}

    def _cube(self) -> Array:
        """Where the cube is, in the frame of our arms."""
        return np.array(self._physics.named.data.xpos["box"]) - TABLE

    def _touched(self) -> set[str]:
        """Names of the robot's surfaces that touch the cube or the table."""
        model, contacts = self._physics.model, self._physics.data.contact
        pairs = [[model.id2name(geom, "geom") for geom in pair] for pair in contacts.geom.tolist()]
        return {name for pair in pairs if {"red_box", "table"} & set(pair) for name in pair}
