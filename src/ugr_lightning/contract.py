"""The few shapes and promises that every room of the package shares.

Letters: B batch · K chunk length (50) · A action dim (14) · S state dim (14) · V cameras (3) · H, W image ·
D hidden · N memory tokens · M refinement budget. Both vectors are ordered
[left arm 6 (rad), left gripper (0 closed .. 1 open), right arm 6 (rad), right gripper].
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

from ugr_lightning.blueprint import Blueprinted
from ugr_lightning.embodiment import ACTION_DIM as ACTION_DIM  # who writes a policy finds all it needs in one place
from ugr_lightning.embodiment import CAMERAS as CAMERAS
from ugr_lightning.embodiment import CHUNK_LENGTH as CHUNK_LENGTH
from ugr_lightning.embodiment import GRIPPERS as GRIPPERS
from ugr_lightning.embodiment import STATE_DIM as STATE_DIM


class Observation(NamedTuple):
    """What a policy sees at one control step.

    A policy of several `observation_steps` T also sees the steps just before, oldest first: both tensors then have an
    axis T after B. Before the first step of an episode the first observation is repeated.

    Args:
        images: (B, V, 3, H, W) uint8 RGB, cameras in the order of the policy's `cameras`; (B, T, V, 3, H, W).
        state: (B, S) float32, commanded joints in robot units; (B, T, S).
        projection: (B, V, 3, 4) float32, where each camera sees a point of the world at this moment, see
            `image_projection`; (B, T, V, 3, 4). None where nobody knows; policies without keyframes do not ask.
    """

    images: Tensor
    state: Tensor
    projection: Tensor | None = None


class Keyframes(NamedTuple):
    """Where the tools of both arms, left then right, are at their next keyframes.

    At a keyframe a gripper opens or closes while the hand rests, or the demonstration ends.

    Args:
        position: (B, 2, 3) float32, the tool point in the world, m.
        axes: (B, 2, 6) float32, the first and the second axis of the tool in the world.
        delay: (B, 2) int64, control steps from now to the keyframe.
    """

    position: Tensor
    axes: Tensor
    delay: Tensor


class Batch(NamedTuple):
    """Observations with the action chunks that followed them in a demonstration.

    Args:
        images: (B, V, 3, H, W) uint8 RGB; (B, T, V, 3, H, W) for several observation steps, see `Observation`.
        state: (B, S) float32, robot units; (B, T, S).
        actions: (B, K, A) float32, robot units; steps past the end repeat the last action.
        valid: (B, K) bool, False on steps past the end of the episode.
        episode: (B,) int64, index of the episode in the data set.
        step: (B,) int64, time step of the observation in its episode.
        projection: as in `Observation`; None where the data have no calibration.
        keyframes: None where the data have no tool poses.
    """

    images: Tensor
    state: Tensor
    actions: Tensor
    valid: Tensor
    episode: Tensor
    step: Tensor
    projection: Tensor | None = None
    keyframes: Keyframes | None = None

    @property
    def observation(self) -> Observation:
        """The part of the batch that a policy also has at run time."""
        return Observation(self.images, self.state, self.projection)


class Chunk(NamedTuple):
    """A policy's plan for the next K control steps.

    Args:
        actions: (B, K, A) float32, robot units; what the robot executes.
        coarse: (B, K, A) float32, robot units, before refinement; None where a policy does not refine.
        log_variance: (B, K) float32, predicted uncertainty s_k; None where a policy has none.
        refined: (B, K) bool, steps that received a correction; None where a policy does not refine.
        maps: (B, V, 2, 2, h, w) float32, per camera, arm and point (the tool, its foot on the table) how likely each
            cell of the picture is where that will be at the arm's next keyframe; what is missing from 1 says that it
            is not in the picture. None where a policy does not look for keyframes.
        points: (B, 2, 2, 3) float32, these points in the world, m, as all cameras together see them.
    """

    actions: Tensor
    coarse: Tensor | None = None
    log_variance: Tensor | None = None
    refined: Tensor | None = None
    maps: Tensor | None = None
    points: Tensor | None = None


class Statistics(NamedTuple):
    """Per-dimension statistics of the training episodes, in robot units.

    Args:
        state_mean, state_std, state_min, state_max: (S,) float32.
        action_mean, action_std, action_min, action_max: (A,) float32.
        keyframe_mean, keyframe_std: (2, 3) float32, of the tools' positions at keyframes, m; None where the data have
            none.
    """

    state_mean: Tensor
    state_std: Tensor
    state_min: Tensor
    state_max: Tensor
    action_mean: Tensor
    action_std: Tensor
    action_min: Tensor
    action_max: Tensor
    keyframe_mean: Tensor | None = None
    keyframe_std: Tensor | None = None


class ChunkPolicy(Blueprinted, nn.Module, ABC):
    """A policy that predicts action chunks; robot units in, robot units out.

    Normalisation lives inside the policy as buffers, so that a checkpoint is complete by itself. A base class and not
    a `typing.Protocol`, because Lightning needs a module and jsonargparse resolves `class_path` by subclass.
    """

    cameras: tuple[str, ...]
    chunk_length: int
    state_dim: int
    action_dim: int
    observation_steps: int = 1
    needs_projection: bool = False
    """Whether it predicts nothing without the observation's `projection`."""

    @abstractmethod
    def set_statistics(self, statistics: Statistics) -> None:
        """Store the normalisation statistics in the policy's buffers."""

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Named scalar loss terms of a batch; `loss` is the one to minimise, all others are for the log."""

    @abstractmethod
    def predict(self, observation: Observation) -> Chunk:
        """The chunk to execute, without gradients and without randomness."""

    def for_inference(self) -> "ChunkPolicy":
        """A policy that predicts the same, only faster, and is not trained any more; by default the policy itself."""
        return self
