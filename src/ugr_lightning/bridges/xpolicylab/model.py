"""XPolicyLab's `Model`: a checkpoint of ours for one or several of its environments."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.bridges.deployment import Sight
from ugr_lightning.bridges.options import deployment_of, number, text
from ugr_lightning.data.storage.jpeg import decode_picture
from ugr_lightning.errors import CheckpointError, ConfigError, ProtocolError

CAMERAS = {"cam_high": "cam_head", "cam_right_wrist": "cam_right_wrist", "cam_left_wrist": "cam_left_wrist"}
"""XPolicyLab's names of our cameras (XPolicyLab/XPolicyLab@7198143)."""
# XPolicyLab's description gives a shape of the second and no direction; its sender in RoboTwin puts SAPIEN's
# `extrinsic_cv` there, (3, 4), world to camera (RoboTwin-Platform/RoboTwin@cf47ab5, scripts/eval_policy_xpolicylab.py).
# RoboDojo's `extrinsic_matrix`, camera to world, has another name (RoboDojo-Benchmark/RoboDojo@36bfcb7).
CALIBRATION = ("intrinsic_matrix", "extrinsics_matrix")
ENVIRONMENTS = 32
FILES = ("policy_best.ckpt", "last.ckpt")
COLOURS = ("color", "colors", "rgb", "image")
"""Where a camera's picture may be in an observation."""
Actions = list[dict[str, np.ndarray]]


@dataclass
class Environment:
    """What is remembered of one environment.

    Args:
        slot: of the deployment.
        joints: names and lengths of the parts of its joint vector.
        waiting: an observation that no actions have been given for.
        answered: the observation that the last actions were given for.
        actions: these actions.
        step: their number in the client's count, where it counts.
        request: name of the request they answered, where it has one.
        client: the connection that it was last heard of on; None where that is closed.
    """

    slot: int
    joints: tuple[tuple[str, int], ...] = ()
    waiting: Sight | None = None
    answered: Sight | None = None
    actions: Actions | None = None
    step: int | None = None
    request: str | None = None
    client: Hashable = None


class XPolicyModel:
    """The policy of an XPolicyLab adapter; single and batched calls, environments told apart by `env_idx`.

    Several clients may share it, each under a session of its own, or under one session on connections of their own,
    with other numbers of environments. A call that is made twice for one observation gives the same actions and moves
    nothing on. Actions are given up to the step at which the policy wants to see again, so that it misses no
    observation when only the newest one travels with a request.

    Args:
        model_cfg: of `deploy.yml`: `checkpoint` or `ckpt_name`, what `deployment_of` reads, and optionally
            `environments` (how many are remembered).
        folder: the adapter's folder, which relative checkpoints are in.

    Attributes:
        environments: how many are remembered at most.

    Raises:
        ConfigError: a value that cannot work.
        CheckpointError: no usable checkpoint.
    """

    def __init__(self, model_cfg: Mapping[str, Any], folder: Path | None = None) -> None:
        if text(model_cfg, "action_type", "joint") != "joint":
            fix = "Evaluate with action_type joint: the policy commands joint targets."
            raise ConfigError("action_type", "joint", model_cfg["action_type"], fix)
        self.environments = count = int(number(model_cfg, "environments") or ENVIRONMENTS)
        checkpoint = find_checkpoint(model_cfg, folder or Path())
        self.deployment = deployment_of(model_cfg, checkpoint, cameras=CAMERAS, calibration=CALIBRATION, slots=count)
        self._free = list(reversed(range(count)))
        self._environments: dict[tuple[Hashable, int], Environment] = {}  # least recently used first
        self._latest: dict[tuple[Hashable, Hashable], list[int]] = {}  # by session and connection

    def update_obs(self, obs: Mapping[str, Any], *, session: Hashable = "", client: Hashable = None) -> None:
        """The newest observation of one environment; `session` and `client` as for `infer`."""
        self.update_obs_batch([obs], session=session, client=client)

    def update_obs_batch(
        self, obs_list: Sequence[Mapping[str, Any]], *, session: Hashable = "", client: Hashable = None
    ) -> None:
        """The newest observations of some environments; earlier ones that nobody asked about are dropped."""
        if not isinstance(obs_list, (list, tuple)):
            raise ProtocolError("obs", "a list of observations", type(obs_list).__name__, "Send one per environment.")
        if len(obs_list) > self.environments:
            fix = "Raise `environments` in deploy.yml."
            raise ConfigError("environments", f"at most {self.environments} at once", len(obs_list), fix)
        seen = [(environment_index(obs), self._see(obs)) for obs in obs_list]
        for index, (observation, joints) in seen:
            environment = self._environment((session, index), client)
            environment.waiting, environment.joints = observation, joints
        self._latest[session, client] = [index for index, _ in seen]

    def get_action(self, *, session: Hashable = "", client: Hashable = None) -> Actions:
        """Actions for the environment that was observed last; the same again where nothing new was observed."""
        latest = self._observed_last(session, client)
        return self.get_action_batch(latest[:1], session=session, client=client)[0]

    def get_action_batch(
        self, env_idx_list: Iterable[int] | None = None, *, session: Hashable = "", client: Hashable = None
    ) -> list[Actions]:
        """Actions for some environments, the same number for each.

        Args:
            env_idx_list: which; None means those observed last.
            session, client: as for `infer`.

        Raises:
            ProtocolError: one of them has not been observed.
        """
        if env_idx_list is None:
            indices = self._observed_last(session, client)
        else:
            try:
                indices = [int(index) for index in env_idx_list]
            except (TypeError, ValueError) as error:
                fix = "Send a list of numbers."
                raise ProtocolError("env_idx_list", "numbers of environments", str(env_idx_list)[:40], fix) from error
        known = [self._environments.get((session, index)) for index in indices]
        environments = [one for one in known if one is not None and (one.waiting or one.actions)]
        if not indices or len(environments) < len(indices):
            fix = "Call update_obs or update_obs_batch first."
            raise ProtocolError("get_action", "an observation of each environment", f"none of some of {indices}", fix)
        self._plan([one for one in environments if one.waiting is not None])
        return [one.actions or [] for one in environments]

    def infer(
        self,
        observation: Mapping[str, Any],
        *,
        session: Hashable = "",
        client: Hashable = None,
        step: int | None = None,
        request: str | None = None,
    ) -> Actions:
        """Actions for one observation.

        A request is taken for one that was sent again where it bears the name of the last one of its environment, or
        the same step and the same observation; it gets the same actions.

        Args:
            observation: in XPolicyLab's form.
            session: which client asks.
            client: on which connection; it may be another one after a reconnect.
            step: how many inferences the client has received since its reset; None where it does not count.
            request: name of the request, the same when it is sent again.

        Raises:
            ProtocolError: the observation has another form, or belongs to an episode whose beginning is unknown.
        """
        seen, joints = self._see(observation)
        key = (session, environment_index(observation))
        if key not in self._environments and step:
            fix = "Reset and begin the episode anew; the server was restarted, or has forgotten it for newer ones."
            raise ProtocolError(f"environment {key[1]}", "an episode from its first step on", f"step {step}", fix)
        environment = self._environment(key, client)
        again = request is not None and request == environment.request
        if step is not None and step == environment.step and environment.answered is not None:
            again |= _same(seen, environment.answered)
        if again and environment.actions is not None:
            return environment.actions
        if step is not None and environment.step is not None and step < environment.step:
            fix = "Reset at the beginning of an episode."
            raise ProtocolError(f"environment {key[1]}", f"step {environment.step} or later", f"step {step}", fix)
        environment.waiting, environment.joints = seen, joints
        self._plan([environment])
        environment.step, environment.request = step, request
        assert environment.actions is not None
        return environment.actions

    def reset(self, case: Any = None, *, session: Hashable = "", client: Hashable = None) -> None:
        """Episodes begin: forget a client's environments, but those that another open connection of its session uses.

        RoboTwin's parallel workers share a session, each with a connection and an environment. `case` is what some
        callers pass, and has no effect.
        """
        for key in [key for key, one in self._environments.items() if key[0] == session]:
            if self._environments[key].client in (None, client):
                self._free.append(self._environments.pop(key).slot)
        self._latest.pop((session, client), None)
        self._latest.pop((session, None), None)

    def disconnect(self, client: Hashable) -> None:
        """A connection is closed: its environments stay, for whoever goes on in the same session."""
        for one in self._environments.values():
            if one.client == client:
                one.client = None
        for session, connection in [key for key in self._latest if key[1] == client]:
            self._latest[session, None] = self._latest.pop((session, connection))
        while len(self._latest) > self.environments:
            self._latest.pop(next(iter(self._latest)))

    def _observed_last(self, session: Hashable, client: Hashable) -> list[int]:
        return self._latest.get((session, client), self._latest.get((session, None), []))

    def alarms(self, session: Hashable) -> dict[str, int]:
        """By number of a client's environment the control step of the first alarm of its episode."""
        known = self.deployment.alarms
        of_client = {str(index): one.slot for (whose, index), one in self._environments.items() if whose == session}
        return {index: known[slot] for index, slot in of_client.items() if slot in known}

    def prepare_case(self, case_meta: Any = None) -> None:
        """Nothing to prepare."""

    def on_trial_end(self, result: Any = None) -> None:
        """Nothing to tidy up: the reset of the next trial does."""

    def _see(self, observation: Mapping[str, Any]) -> tuple[Sight, tuple[tuple[str, int], ...]]:
        pictures, state, joints = read_observation(observation)
        return self.deployment.see(pictures, state, observation["vision"]), joints

    def _environment(self, key: tuple[Hashable, int], client: Hashable) -> Environment:
        """The memory of an environment; a new one takes the place of the least recently used where all are taken."""
        environment = self._environments.pop(key, None)
        if environment is None:
            if not self._free:
                self._free.append(self._environments.pop(next(iter(self._environments))).slot)
            environment = Environment(self._free.pop())
            self.deployment.begin(environment.slot)
        environment.client = client
        self._environments[key] = environment  # to the end: most recently used
        return environment

    def _plan(self, environments: Sequence[Environment]) -> None:
        """Give actions to environments with new observations."""
        if not environments:
            return
        seen = {one.slot: one.waiting for one in environments if one.waiting is not None}
        plans = self.deployment.act(seen)
        for one in environments:
            one.actions = [name_joints(action, one.joints) for action in plans[one.slot]]
            one.answered, one.waiting = one.waiting, None


def environment_index(observation: Mapping[str, Any]) -> int:
    """Which environment an observation is of; 0 where it does not say.

    Raises:
        ProtocolError: not a number from 0.
    """
    index = observation.get("env_idx") if isinstance(observation, Mapping) else None
    if index is None:
        return 0
    if isinstance(index, (int, np.integer)) and not isinstance(index, bool) and index >= 0:
        return int(index)
    raise ProtocolError("observation/env_idx", "a number from 0", str(index)[:40], "Number the environments.")


def read_observation(
    observation: Mapping[str, Any],
) -> tuple[dict[str, Any], np.ndarray, tuple[tuple[str, int], ...]]:
    """Pictures by camera, joints, and what the parts of the joint vector are called.

    Args:
        observation: `vision/<camera>/color` and `state/[left_|right_]{arm,ee}_joint_state`. A picture may be encoded,
            and may be what stands for the camera itself.

    Returns:
        Pictures, (S,) joints in the order [left arm, left gripper, right arm, right gripper], (name, length) of parts.

    Raises:
        ProtocolError: it has another form.
    """
    fix = "Send XPolicyLab's observation v1.0 with action_type joint."
    try:
        pictures = {name: _colour(view) for name, view in observation["vision"].items()}
        state = observation["state"]
        sides = ("left_", "right_") if "left_arm_joint_state" in state else ("",)
        arm = "joint_state" if sides == ("",) and "arm_joint_state" not in state else "arm_joint_state"
        names = [f"{side}{part}" for side in sides for part in (arm, "ee_joint_state")]
        parts = [np.asarray(state[name], np.float64) for name in names]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        expected = "vision/<camera>/color and state/..._joint_state"
        raise ProtocolError("observation", expected, f"{type(error).__name__} {error}"[:80], fix) from error
    if any(part.ndim != 1 for part in parts):
        raise ProtocolError("observation/state", "vectors", [part.shape for part in parts], fix)
    pictures = {name: picture for name, picture in pictures.items() if picture is not None}
    return pictures, np.concatenate(parts), tuple((name, len(part)) for name, part in zip(names, parts, strict=True))


def _colour(view: Any) -> Any:
    """A camera's picture, decoded where it travels encoded; None where it has none."""
    found = view
    if isinstance(view, Mapping):
        found = next((view[key] for key in COLOURS if view.get(key) is not None), None)
    if isinstance(found, np.ndarray) and found.ndim == 1 and found.dtype == np.uint8:
        found = found.tobytes()
    return decode_picture(bytes(found)) if isinstance(found, (bytes, bytearray, memoryview)) else found


def name_joints(action: np.ndarray, joints: Sequence[tuple[str, int]]) -> dict[str, np.ndarray]:
    """An action (A,) as the named parts of the robot."""
    ends = np.cumsum([length for _, length in joints])
    if ends[-1] != len(action):
        fix = "Evaluate on the robot of the training."
        raise ProtocolError("robot", f"{len(action)} joints, as the policy commands", f"{ends[-1]}", fix)
    parts = np.split(action, ends[:-1])
    return {name: part.copy() for (name, _), part in zip(joints, parts, strict=True)}


def find_checkpoint(config: Mapping[str, Any], folder: Path) -> Path:
    """The checkpoint that a `deploy.yml` means.

    Args:
        config: `checkpoint`, a file; or `ckpt_name`: a file, or a folder with one, by itself or under `checkpoints/`,
            also in XPolicyLab's spelling `<bench>-<ckpt>-<env_cfg>-<action_type>-<seed>`.
        folder: the adapter's folder.

    Raises:
        CheckpointError: nothing there.
    """
    if config.get("checkpoint"):
        return folder / text(config, "checkpoint")
    name = text(config, "ckpt_name")
    setting = [config.get(key) for key in ("bench_name", "ckpt_name", "env_cfg_type", "action_type", "seed")]
    runs = folder / "checkpoints"
    places = [folder / name, runs / "-".join(map(str, setting)), runs / name]
    files = [file for place in places for file in (place, *(place / file for file in FILES))]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        fix = "Set `checkpoint` in deploy.yml to a file from `ugr fit`."
        raise CheckpointError("ckpt_name", f"{' or '.join(FILES)} in one of {', '.join(map(str, places))}", "none", fix)
    return found


def _same(one: Sight, other: Sight) -> bool:
    return np.array_equal(one.commanded, other.commanded) and np.array_equal(one.images, other.images)
