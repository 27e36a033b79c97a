"""The table with two arms, lights and three cameras, as a ManiSkill environment; tasks add props and rules."""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.types import SceneConfig, SimConfig

from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError
from ugr_lightning.sim.expert import Arms, ExpertStep
from ugr_lightning.sim.kinematics import SIDES, Array
from ugr_lightning.sim.objects import pose_of
from ugr_lightning.sim.robot import ACTION_HIGH, ACTION_LOW, HOME_ACTION, UID
from ugr_lightning.sim.room import furnish, illuminate, is_furniture
from ugr_lightning.sim.settings import CONTROL_HZ, Point, Surroundings, check_setting, surroundings_of
from ugr_lightning.sim.shaders import camera_shader

SIMULATION_HZ = 250
SETTLE_SECONDS = 0.1  # inside reset, never recorded
TOUCH_IMPULSE = 1e-6  # N s; pairs that are only close to each other are listed by PhysX with no impulse


class Touch(NamedTuple):
    """A contact between a finger and something that is not the robot.

    Args:
        side: arm of the finger.
        other: name of the prop.
        points: (n, 3) contact points in the world, metres.
    """

    side: str
    other: str
    points: Array


def look_at(eye: Point, target: Point) -> sapien.Pose:
    """Pose of a camera (x forward, z up) at `eye` that looks at `target`."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    return pose_of(eye, np.stack([forward, left, np.cross(forward, left)], axis=1))


class TwoArmEnv(BaseEnv):
    """A tabletop with two ViperX arms.

    The table top is z = 0 in every setting; where a setting lowers it, arms and high camera stand higher above it.
    Every reset builds the scene anew: solver and contact caches then carry nothing over from one episode to the next.

    Args:
        setting: how the surroundings vary, a key of `settings.SETTINGS`.
        image_size: (H, W) of the three cameras.

    Raises:
        ConfigError: unknown setting, another robot, several environments in one, or GPU simulation.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = [UID]
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    metadata: ClassVar[dict[str, Any]] = {**BaseEnv.metadata, "render_fps": CONTROL_HZ}
    horizon: ClassVar[int]  # control steps
    version: ClassVar[int]  # raise it when the task changes, and recompute its evaluation seeds

    def __init__(
        self,
        num_envs: int = 1,
        *,
        setting: str = "demo_clean",
        image_size: tuple[int, int] = (120, 160),
        robot_uids: str = UID,
        sim_backend: str = "physx_cpu",
        render_backend: str = "cpu",
        **kwargs: Any,
    ) -> None:
        check_setting(setting)
        _check_simulation(num_envs, sim_backend, robot_uids)
        self.setting, self.image_size = setting, image_size
        self.surroundings: Surroundings = surroundings_of(setting, 0)  # of the running episode
        self.command: np.ndarray = HOME_ACTION.copy()  # (14,)
        self.succeeded = False
        self._touches: list[Touch] | None = None
        super().__init__(1, robot_uids=UID, sim_backend="physx_cpu", render_backend=render_backend, **kwargs)

    # ------------------------------------------------------------------------------------------ what a task fills in

    @abstractmethod
    def build(self, rng: np.random.Generator) -> None:
        """Put the props of an episode into the scene, drawn from `rng`."""

    @abstractmethod
    def condition(self) -> bool:
        """Whether the task's condition is met now."""

    @abstractmethod
    def expert(self, arms: Arms) -> Iterator[ExpertStep]:
        """The scripted solution; reads object poses as it goes."""

    def describe(self) -> dict[str, Any]:
        """Where things are, as plain containers; recordings and results keep it."""
        return {}

    # ---------------------------------------------------------------------------------------------- what a task uses

    def touches(self) -> list[Touch]:
        """Contacts between fingers and props at the end of the last control step."""
        if self._touches is None:
            self._touches = list(self._find_touches())
        return self._touches

    def opening(self, side: str) -> float:
        """Commanded opening of a gripper, 0 closed .. 1 open."""
        return float(self.command[6 if side == "left" else 13])

    def tool_pose(self, side: str) -> sapien.Pose:
        """Measured tool pose in the world."""
        return self.agent.robot.links_map[f"{side}_tcp"]._objs[0].entity_pose

    # --------------------------------------------------------------------------------------------- ManiSkill's hooks

    @property
    def _default_sim_config(self) -> SimConfig:
        scene = SceneConfig(solver_position_iterations=10, enable_enhanced_determinism=True)
        return SimConfig(sim_freq=SIMULATION_HZ, control_freq=CONTROL_HZ, scene_config=scene)

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        height, width = self.image_size
        links = self.agent.robot.links_map
        look = self.surroundings
        high = pose_of((0.0, 0.0, look.table_drop)) * look_at(look.camera_eye, look.camera_target)
        wrist = look_at((0.01, 0.0, 0.125), (0.165, 0.0, 0.0))
        cameras = {
            "cam_high": (high, 50.0, None),
            "cam_right_wrist": (wrist, 70.0, links["right_gripper_link"]),
            "cam_left_wrist": (wrist, 70.0, links["left_gripper_link"]),
        }
        shader = camera_shader()
        return [
            CameraConfig(name, pose, width, height, np.deg2rad(fov), 0.01, 5.0, mount=mount, shader_config=shader)
            for name, (pose, fov, mount) in ((name, cameras[name]) for name in CAMERAS)
        ]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = look_at((0.0, -0.75, 0.65), (0.0, 0.0, 0.05))
        # picture formats are global in SAPIEN: with other shaders for the sensors, ManiSkill's own sets them again
        shader = None if self._custom_sensor_configs else camera_shader()
        return CameraConfig("render_camera", pose, 512, 384, np.deg2rad(55), 0.01, 5.0, shader_config=shader)

    def reset(self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:  # for users of `np_random`; the scene's random numbers are those of the seed alone
            gymnasium.Env.reset(self, seed=int(np.ravel(seed)[0]))
        return super().reset(seed=seed, options={**(options or {}), "reconfigure": True})

    def _load_agent(self, options: dict[str, Any]) -> None:
        self.surroundings = surroundings_of(self.setting, int(self._episode_seed[0]))
        super()._load_agent(options, pose_of((0.0, 0.0, self.surroundings.table_drop)))

    def _load_scene(self, options: dict[str, Any]) -> None:
        furnish(self.scene, self.surroundings)
        self.build(np.random.default_rng(int(self._episode_seed[0])))

    def _load_lighting(self, options: dict[str, Any]) -> None:
        illuminate(self.scene, self.surroundings)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        self.command, self.succeeded, self._touches = HOME_ACTION.copy(), False, None
        home = torch.from_numpy(self.agent.keyframes["rest"].qpos)[None]
        self.agent.reset(home)
        robot = self.agent.robot
        robot.set_joint_drive_targets(home, robot.active_joints, torch.arange(len(robot.active_joints)))
        for _ in range(round(SETTLE_SECONDS * SIMULATION_HZ)):
            self.scene.step()
        self.agent.reset(home)
        self._clear_sim_state()

    def _step_action(self, action: Any) -> Any:
        if action is not None:
            self.command = np.clip(np.asarray(action, np.float32).reshape(-1), ACTION_LOW, ACTION_HIGH)
        return super()._step_action(action)

    def _after_control_step(self) -> None:
        self._touches = None
        self.succeeded = self.succeeded or bool(self.condition())

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Whether the task's condition has been met at some control step of the episode."""
        return {"success": torch.tensor([self.succeeded])}

    def compute_sparse_reward(self, obs: Any, action: Any, info: dict[str, Any]) -> torch.Tensor:
        """1 from the step on in which the task's condition is met, 0 before; (1,) float32."""
        return info["success"].float()

    def get_info(self) -> dict[str, Any]:
        """Steps so far and success, not to be changed by later steps."""
        return {**super().get_info(), "elapsed_steps": self.elapsed_steps.clone()}

    def get_sensor_params(self) -> dict[str, dict[str, torch.Tensor]]:
        """Parameters of each camera, of this moment."""
        return {
            name: {key: value.clone() for key, value in params.items()}
            for name, params in super().get_sensor_params().items()
        }

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, torch.Tensor]:
        """Poses of the tools and, in observations of the state, what is known of the props; each (1, n)."""
        known = {f"{side}_tcp_pose": self.agent.robot.links_map[f"{side}_tcp"].pose.raw_pose for side in SIDES}
        if "state" in self.obs_mode:
            for name, actor in sorted(self.scene.actors.items()):
                if not is_furniture(name):
                    known[f"{name}_pose"] = actor.pose.raw_pose
            for name, articulation in sorted(self.scene.articulations.items()):
                if articulation is not self.agent.robot:
                    known[f"{name}_pose"], known[f"{name}_qpos"] = articulation.pose.raw_pose, articulation.get_qpos()
        return known

    def _find_touches(self) -> Iterator[Touch]:
        fingers, robot = {}, set()
        for link in self.agent.robot.links:
            robot.add(link._objs[0].entity.per_scene_id)
            if link.name.endswith("finger_link"):
                fingers[link._objs[0].entity.per_scene_id] = link.name.split("_")[0]
        for contact in self.scene.sub_scenes[0].physx_system.get_contacts():
            ids = [body.entity.per_scene_id for body in contact.bodies]
            points = [point.position for point in contact.points if np.linalg.norm(point.impulse) > TOUCH_IMPULSE]
            for finger, other, body in ((ids[0], ids[1], 1), (ids[1], ids[0], 0)):
                if points and finger in fingers and other not in robot:
                    name = contact.bodies[body].entity.name.removeprefix("scene-0_")
                    yield Touch(fingers[finger], name, np.asarray(points, np.float64))


def _check_simulation(num_envs: int, sim_backend: str, robot_uids: str) -> None:
    """Refuse what the scenes are not made for.

    A task reads the contacts of its one scene from the processor's memory, and every reset builds that scene anew: in
    PhysX's GPU simulation neither is possible, because all environments share one scene.
    """
    if robot_uids != UID:
        raise ConfigError("robot_uids", UID, robot_uids, "Leave it out: the tasks are laid out for this robot.")
    if num_envs != 1 or sim_backend not in ("physx_cpu", "cpu", "auto"):
        got = f"num_envs={num_envs}, sim_backend={sim_backend!r}"
        fix = "GPU simulation is not supported; for several environments use `gymnasium.vector.AsyncVectorEnv`."
        raise ConfigError("environment", "one environment per process, on physx_cpu", got, fix)


def side_of(x: float) -> str:
    """The arm on whose side of the table a point lies."""
    return SIDES[0] if x < 0 else SIDES[1]
