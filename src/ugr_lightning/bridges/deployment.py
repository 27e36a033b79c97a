"""A trained policy that acts in environments of other projects: named pictures and joints in, commands out."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.embodiment import image_projection
from ugr_lightning.errors import CheckpointError, ConfigError, NumericsError, ProtocolError
from ugr_lightning.models.checkpoint import load_policy
from ugr_lightning.models.device import chosen_device
from ugr_lightning.models.normalizer import Normalizer
from ugr_lightning.models.refine.budget import with_refine_ratio
from ugr_lightning.rollout.actors import PolicyActor
from ugr_lightning.rollout.alarm import read_alarms

logger = logging.getLogger(__name__)
WHOLE_CHUNKS = "chunk"
"""The execution that plays every chunk to its end."""
INTRINSIC, EXTRINSIC = ((3, 3),), ((3, 4), (4, 4))
"""Shapes that the matrices of a camera may have."""


class Sight(NamedTuple):
    """An observation as a `PolicyActor` reads it.

    Args:
        images: (V, H, W, 3) uint8 RGB, in the order of the policy's cameras; (0, H, W, 3) where nobody looks.
        commanded: (S,) float32, robot units.
        measured: (S,) float32; the outside says only one of the two.
        projection: (V, 3, 4) float32, see `embodiment.image_projection`; None for a policy that does not need it.
    """

    images: np.ndarray
    commanded: np.ndarray
    measured: np.ndarray
    projection: np.ndarray | None = None


class Deployment:
    """A checkpoint with its execution, for several environments (slots) that run independently of each other.

    Acts through the same `PolicyActor` as `ugr rollout`, so that the same pictures and joints give the same commands
    bit for bit, whatever the other slots do.

    Args:
        checkpoint: file from `ugr fit`.
        cameras: the policy's name of a camera: the environment's.
        calibration: what the environment calls a camera's intrinsic and its extrinsic matrix.
        execution: `aggregate`, `aggregate-variance`, the number of steps executed of each chunk, or `chunk`
            for all.
        slots: how many environments at most.
        image_size: (height, width) that pictures are scaled to; None takes the size of the training.
        device: where the policy computes; `auto` takes a GPU where there is one.
        refine_ratio: share of each chunk that is refined, in place of the one in training.

    Attributes:
        alarms: by slot the control step of the first alarm of its episode; also in the log. See `ugr alarm`.

    Raises:
        CheckpointError: not a usable checkpoint; one without normalisation statistics or size of the pictures; or the
            alarm beside it is another's.
        ConfigError: an execution or a device that does not exist, or a camera without a name in the environment.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/ACT/act_policy.py (aggregation).
    """

    def __init__(
        self,
        checkpoint: Path | str,
        *,
        cameras: Mapping[str, str],
        calibration: tuple[str, str] = ("intrinsic_cv", "extrinsic_cv"),
        execution: str | int = "aggregate",
        slots: int = 1,
        image_size: tuple[int, int] | None = None,
        device: str = "auto",
        refine_ratio: float | None = None,
    ) -> None:
        policy, self.info = load_policy(checkpoint)
        if not all(module.fitted for module in policy.modules() if isinstance(module, Normalizer)):
            fix = "Use a checkpoint that was written after training began; `ugr inspect` shows its statistics."
            raise CheckpointError(checkpoint, "normalisation statistics", "none", fix)
        self.cameras, self.calibration = _named(policy, cameras), calibration
        self.image_size = _size(image_size or self.info.data.get("image_size"), checkpoint)
        self.state_dim, self.action_dim, self.chunk_length = policy.state_dim, policy.action_dim, policy.chunk_length
        self._calibrated = policy.needs_projection
        if refine_ratio is not None:
            policy = with_refine_ratio(policy, refine_ratio)
        policy = policy.to(chosen_device(device)).for_inference()
        alarms = read_alarms(self.info.path, self.info.sha256)
        self._actor = PolicyActor(policy, cameras=policy.cameras, refine_ratio=refine_ratio, alarms=alarms)
        self._actor.begin(slots, policy.chunk_length if execution == WHOLE_CHUNKS else execution)
        self._begins = set(range(slots))
        self.alarms: dict[int, int] = {}
        self._planned: dict[int, np.ndarray] = {}  # by slot the actions (n, A) that need no other frame

    def __str__(self) -> str:
        height, width = self.image_size
        trained = self.info.data.get("task", "an unknown task")
        return (
            f"{self._actor.name} of {self.info.path} (sha256 {self.info.sha256[:12]}), trained on {trained}, "
            f"execution {self._actor.execution}, pictures {height}x{width}, alarm {self._actor.alarm or 'none'}"
        )

    def begin(self, slot: int) -> None:
        """An episode begins in a slot: forget its chunks and observations."""
        self._begins.add(slot)

    def see(self, pictures: Mapping[str, Any], state: Any, views: Mapping[str, Any] | None = None) -> Sight:
        """Check an observation and bring it into the policy's form.

        Args:
            pictures: by the environment's names of the cameras, (H, W, 3) uint8 RGB of any size.
            state: (S,) joints in robot units.
            views: by the same names what else the environment says of each camera. A policy that needs the calibration
                reads it there: the intrinsic matrix (3, 3), OpenCV's, in pixels of the picture as it is given here, and
                the extrinsic matrix (3, 4) or (4, 4), world to camera, OpenCV's axes.

        Raises:
            ProtocolError: a camera or a matrix is missing, or it, a picture or the joints have another form.
        """
        joints = np.asarray(state)
        if joints.shape != (self.state_dim,) or joints.dtype.kind not in "fiu":
            got = f"{joints.shape} {joints.dtype}"
            raise ProtocolError("joints", f"{self.state_dim} numbers", got, "Evaluate on the robot of the training.")
        if not np.isfinite(joints).all():
            raise ProtocolError("joints", "finite numbers", "a NaN or an infinity", "Look at the environment.")
        joints = joints.astype(np.float32)
        images = np.empty((len(self.cameras), *self.image_size, 3), np.uint8)  # (V, H, W, 3)
        for image, (camera, name) in zip(images, self.cameras.items(), strict=True):
            if name not in pictures:
                fix = "Say with `cameras` what the environment calls it."
                raise ProtocolError(f"camera {camera}", f"a picture `{name}`", sorted(map(str, pictures)), fix)
            image[:] = scaled(pictures[name], self.image_size, name)
        if not self._calibrated:
            return Sight(images, joints, joints)
        names, views = self.cameras.values(), views or {}
        seen = [self._projection(name, views.get(name), np.shape(pictures[name])[:2]) for name in names]
        return Sight(images, joints, joints, np.stack(seen))

    def _projection(self, camera: str, view: Any, size: tuple[int, int]) -> np.ndarray:
        """Where a camera sees a point of the world, (3, 4) float32, from what the environment says of it."""
        intrinsic, extrinsic = (
            _matrix(f"{camera}/{field}", view.get(field) if isinstance(view, Mapping) else None, shapes)
            for field, shapes in zip(self.calibration, (INTRINSIC, EXTRINSIC), strict=True)
        )
        return image_projection(intrinsic, extrinsic[:3], size)

    def act(self, seen: Mapping[int, Sight]) -> dict[int, np.ndarray]:
        """Commands of some slots until the policy wants to see one of them again; moves each on by as many steps.

        Args:
            seen: the newest observation of each slot.

        Returns:
            by slot (n, A) float32, absolute joint targets in robot units; the same n for all.

        Raises:
            NumericsError: a command is not finite.
        """
        for slot in self._begins & set(seen):
            self._actor.start(slot, 0, seen[slot])
            self._planned.pop(slot, None)
            self.alarms.pop(slot, None)
        self._begins -= set(seen)
        asking = {slot: sight for slot, sight in seen.items() if not len(self._planned.get(slot, ()))}
        for slot, decision in self._actor.act(asking).items():
            self._planned[slot] = _finite(decision.actions, slot)
            if decision.alarm is not None and slot not in self.alarms:
                self.alarms[slot] = decision.alarm
                logger.warning("alarm in environment %d at step %d of its episode", slot, decision.alarm)
        steps = min(len(self._planned[slot]) for slot in seen)
        commands = {slot: self._planned[slot][:steps] for slot in seen}  # (n, A)
        self._planned |= {slot: self._planned[slot][steps:] for slot in seen}
        return commands


def scaled(picture: Any, size: tuple[int, int], name: str = "picture") -> np.ndarray:
    """A picture in another size: smaller ones average areas, as training does; larger ones interpolate.

    Args:
        picture: (H, W, 3) uint8.
        size: (height, width).
        name: for the error.

    Raises:
        ProtocolError: it is no such picture.
    """
    array = np.asarray(picture)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape:
        raise ProtocolError(name, "(H, W, 3) uint8 RGB", f"{array.shape} {array.dtype}", "Send the decoded picture.")
    if array.shape[:2] == tuple(size):
        return array
    shrinks = size[0] <= array.shape[0] and size[1] <= array.shape[1]
    how = Image.Resampling.BOX if shrinks else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(array).resize(size[::-1], how))


def _matrix(where: str, found: Any, shapes: Sequence[tuple[int, int]]) -> np.ndarray:
    """A matrix of a camera, of one of the shapes, float64."""

    def refuse(got: str) -> ProtocolError:
        fix = "Policies with keyframes need it: intrinsic in pixels of the picture, extrinsic from world to camera."
        return ProtocolError(where, f"finite numbers {' or '.join(map(str, shapes))}", got[:120], fix)

    if found is None:
        raise refuse("nothing")
    try:
        matrix = np.asarray(found, np.float64)
    except (TypeError, ValueError) as error:
        raise refuse(f"{type(found).__name__} {found!r}") from error
    if matrix.shape not in shapes:
        raise refuse(f"shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise refuse("a NaN or an infinity")
    if np.linalg.matrix_rank(matrix[:, :3]) < 3:  # as of a place that was never filled
        raise refuse(f"no axes that differ, {matrix[:, :3].tolist()}")
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise refuse(f"{matrix[3].tolist()} as the last row, which is 0 0 0 1")
    return matrix


def _named(policy: ChunkPolicy, cameras: Mapping[str, str]) -> dict[str, str]:
    missing = sorted(set(policy.cameras) - set(cameras))
    if missing:
        fix = "Name them with `cameras`, e.g. {cam_high: head_camera}."
        raise ConfigError("cameras", f"the environment's names of {', '.join(policy.cameras)}", f"no {missing}", fix)
    return {camera: cameras[camera] for camera in policy.cameras}


def _size(size: Any, checkpoint: Path | str) -> tuple[int, int]:
    if size is None:
        fix = "Say with `image_size` how large the pictures of its training were."
        raise CheckpointError(checkpoint, "the size of the pictures", "none", fix)
    height, width = size
    return int(height), int(width)


def _finite(actions: np.ndarray | None, slot: int) -> np.ndarray:
    assert actions is not None, "a policy decides for itself"
    for action in actions:
        if not np.isfinite(action).all():
            bad = np.flatnonzero(~np.isfinite(action))[:5].tolist()
            fix = "Check the checkpoint; the robot has not seen it."
            raise NumericsError(f"action of environment {slot}", "finite numbers", f"NaN or infinity at {bad}", fix)
    return actions
