"""RoboTwin 2.0's policy interface: what the folder written by `ugr bridge robotwin` calls."""

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.bridges.adapter_files import write_adapter_folder
from ugr_lightning.bridges.deployment import Deployment
from ugr_lightning.bridges.options import deployment_of, text
from ugr_lightning.errors import CheckpointError, ProtocolError

CAMERAS = {"cam_high": "head_camera", "cam_right_wrist": "right_camera", "cam_left_wrist": "left_camera"}
"""RoboTwin's names of our cameras (RoboTwin-Platform/RoboTwin@13c3c47, envs/camera/camera.py)."""
CALIBRATION = ("intrinsic_cv", "extrinsic_cv")
"""Its names of a camera's matrices (the same file): the second is (3, 4), world to camera."""


class RobotwinModel:
    """What `get_model` returns: a policy for one environment.

    In RoboTwin's two-environment mode its server calls these methods by name.

    Args:
        deployment: the policy, with one slot.
    """

    def __init__(self, deployment: Deployment) -> None:
        self.deployment = deployment

    def reset_model(self) -> None:
        """An episode begins: forget chunks, running averages and earlier observations."""
        self.deployment.begin(0)

    def get_action(self, obs: Mapping[str, Any]) -> np.ndarray:
        """Commands until the policy wants to see again.

        Args:
            obs: what `encode_obs` returned.

        Returns:
            (n, A) float32, absolute joint targets.
        """
        return self.deployment.act({0: self.deployment.see(obs["images"], obs["state"], obs.get("calibration"))})[0]


def get_model(usr_args: Mapping[str, Any], folder: Path | None = None) -> RobotwinModel:
    """Load the policy that `deploy_policy.yml` and RoboTwin's `--overrides` ask for.

    Args:
        usr_args: `checkpoint`, and what `deployment_of` reads; RoboTwin adds `left_arm_dim` and `right_arm_dim`.
        folder: policy folder, which a relative `checkpoint` is in.

    Raises:
        ConfigError: a value that cannot work.
        CheckpointError: not a usable checkpoint, one without statistics, or one for another robot.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/Your_Policy and script/eval_policy.py.
    """
    checkpoint = Path(folder or ".") / text(usr_args, "checkpoint")
    deployment = deployment_of(usr_args, checkpoint, cameras=CAMERAS, calibration=CALIBRATION)
    if deployment.info.data.get("state") == "measured":
        fix = "Train with `--data.state commanded`: RoboTwin reports the drive targets, not the measured joints."
        raise CheckpointError(checkpoint, "a policy that sees commanded joints", "one that sees measured ones", fix)
    arms = [usr_args.get(f"{side}_arm_dim") for side in ("left", "right")]
    if None not in arms and sum(map(int, arms)) + 2 != deployment.action_dim:  # type: ignore[arg-type]
        fix = "Evaluate with the embodiment of the training."
        got = f"arms with {arms[0]} and {arms[1]} joints and a gripper each"
        raise CheckpointError(checkpoint, f"a robot with {deployment.action_dim} joints", got, fix)
    print(f"policy: {deployment}", flush=True)
    return RobotwinModel(deployment)


def encode_obs(observation: Mapping[str, Any]) -> dict[str, Any]:
    """The pictures and the calibration by camera, and the joints, of one of RoboTwin's observations.

    Raises:
        ProtocolError: it has no pictures or no joints.
    """
    fix = "Set `rgb` and `qpos` to true under `data_type` of the task's config."
    try:
        seen = {name: view for name, view in observation["observation"].items() if "rgb" in view}
        pictures = {name: view["rgb"] for name, view in seen.items()}
        state = np.asarray(observation["joint_action"]["vector"])
        known = {name: {key: view[key] for key in CALIBRATION if key in view} for name, view in seen.items()}
        return {"images": pictures, "state": state, "calibration": known}
    except (KeyError, TypeError) as error:
        expected = "`observation/<camera>/rgb` and `joint_action/vector`"
        raise ProtocolError("observation", expected, f"no {error}", fix) from error


def eval(TASK_ENV: Any, model: Any, observation: Mapping[str, Any]) -> None:
    """Act until the policy wants to see again; RoboTwin calls it until success or the step limit.

    Success and the limit are RoboTwin's: `take_action` ignores what comes after.

    Args:
        TASK_ENV: RoboTwin's task.
        model: from `get_model`, or RoboTwin's client for one in another process.
        observation: what `TASK_ENV.get_obs()` returned.
    """
    encoded = encode_obs(observation)
    actions: Iterable[np.ndarray]
    if isinstance(model, RobotwinModel):
        actions = model.get_action(encoded)
    else:
        actions = np.asarray(model.call(func_name="get_action", obs=encoded), np.float32)  # (n, A)
    for action in actions:
        TASK_ENV.take_action(action, action_type="qpos")


def reset_model(model: RobotwinModel) -> None:
    """An episode begins."""
    model.reset_model()


write_policy = partial(write_adapter_folder, "robotwin", get_model)
