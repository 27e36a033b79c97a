"""From pictures to features, and what is hidden or moved on the way in training, for all policies that look."""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from ugr_lightning.contract import Batch, ChunkPolicy, Keyframes, Observation, Statistics
from ugr_lightning.embodiment import last_of_each_arm
from ugr_lightning.errors import ConfigError, NumericsError
from ugr_lightning.models.augmentation import jitter_colour, shift_images
from ugr_lightning.models.inference import fold_normalisation, store_weights_as
from ugr_lightning.models.keyframes import KeyframeFinder, KeyframeSettings, Sighting, missing_keyframes
from ugr_lightning.models.mirror import check_mirror, mirror_batch, mirrored_statistics
from ugr_lightning.models.normalizer import Normalizer
from ugr_lightning.models.precision import Precision, autocast
from ugr_lightning.models.vision import ResNet18


class Looked(NamedTuple):
    """What a backbone made of n pictures.

    Args:
        stages: (n, C, h, w) features of each of its four stages.
        shift: (n, 2) how far each picture was moved, in image units.
    """

    stages: tuple[Tensor, Tensor, Tensor, Tensor]
    shift: Tensor


class PicturePolicy(ChunkPolicy):
    """A policy that looks at pictures through a ResNet-18; its subclasses say what becomes of the features.

    Args:
        cameras: names of the cameras, in the order of the images.
        normalizer: of states and actions.
        state_dropout: probability, per sample, of hiding the state in training; 1 hides it at run time as well.
        image_dropout: probability, per sample, of hiding the image features in training, never together with the state.
        image_shift: largest random displacement of the images in training, in pixels.
        color_jitter: largest random relative change of contrast and brightness in training.
        mirror: probability, per sample, of training on the mirror image.
        keyframes: how the hands' next keyframes are looked for; null for not at all.
        backbone_width: channels of the first stage of the backbone.
        precision: arithmetic of the networks.

    Attributes:
        exact: names of the layers that stay in float32 whatever the arithmetic.
        only_trained: names of the parts that no prediction needs.
    """

    exact: ClassVar[tuple[str, ...]] = ()
    only_trained: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        cameras: Sequence[str],
        normalizer: Normalizer,
        *,
        state_dropout: float,
        image_dropout: float,
        image_shift: int,
        color_jitter: float,
        mirror: float,
        keyframes: KeyframeSettings | None,
        backbone_width: int,
        precision: Precision,
    ) -> None:
        super().__init__()
        if image_dropout and state_dropout + image_dropout > 1:
            got = f"{state_dropout} and {image_dropout}"
            fix = "Lower one of them: a sample without both has no answer."
            raise ConfigError("state_dropout, image_dropout", "at most 1 together", got, fix)
        if mirror:
            check_mirror(cameras, len(normalizer.state_shift), len(normalizer.action_shift))
        self.cameras, self.normalizer = tuple(cameras), normalizer
        self.state_dropout, self.image_dropout = state_dropout, image_dropout
        self.image_shift, self.color_jitter, self.mirror = image_shift, color_jitter, mirror
        self.precision = precision
        widths = (backbone_width, 2 * backbone_width, 4 * backbone_width)
        self.finder = KeyframeFinder(keyframes, widths, len(self.cameras)) if keyframes is not None else None
        self.needs_projection = keyframes is not None

    def set_statistics(self, statistics: Statistics) -> None:
        statistics = mirrored_statistics(statistics) if self.mirror else statistics
        self.normalizer.fit(statistics)
        if self.finder is not None:
            self.finder.fit(statistics)

    def require_finite_state(self, observation: Observation) -> None:
        """Refuse joint readings that no answer could follow from.

        Raises:
            NumericsError: a NaN or an infinity in the state.
        """
        if not torch.compiler.is_exporting() and not observation.state.isfinite().all():  # a graph raises nothing
            fix = "Look at the robot's or the simulator's joint readings."
            raise NumericsError("observation.state", "finite numbers", "a NaN or an infinity", fix)

    def robot_actions(self, actions: Tensor) -> Tensor:
        """Predicted actions (B, K, A) in robot units.

        Raises:
            NumericsError: a NaN or an infinity among them.
        """
        actions = self.normalizer.robot_action(actions)  # (B, K, A)
        if not torch.compiler.is_exporting() and not actions.isfinite().all():
            fix = "Training diverged or the file is damaged: use an earlier checkpoint, a lower learning rate."
            raise NumericsError("predicted actions", "finite numbers", "a NaN or an infinity", fix)
        return actions

    def pictures(self, observation: Observation) -> Tensor:
        """The pictures of all observation steps, (B, T, V, 3, H, W).

        Raises:
            ConfigError: of another number of cameras or steps.
        """
        images, steps = observation.images, self.observation_steps
        several = steps > 1
        expected = (*[steps] * several, len(self.cameras), 3)  # ([T,] V, 3)
        if images.dim() != 5 + several or images.shape[1 : 3 + several] != expected or images.dtype != torch.uint8:
            time = f"{steps}, " if several else ""
            wanted = f"(B, {time}{len(self.cameras)}, 3, H, W) uint8 for cameras {', '.join(self.cameras)}"
            fix = "Give the policy the cameras and the number of observations it was built for, in that order."
            raise ConfigError("observation.images", wanted, f"{tuple(images.shape)} {images.dtype}", fix)
        return images if several else images[:, None]

    def varied(self, batch: Batch) -> Batch:
        """In training, some samples in mirror image."""
        if not (self.training and self.mirror):
            return batch
        chosen = torch.rand(len(batch.valid), device=batch.valid.device) < self.mirror  # (B,)
        return mirror_batch(batch, chosen, self.cameras)

    def disturb(self, state: Tensor) -> tuple[Tensor, Tensor | None]:
        """In training, states hidden, and which samples may not see; a hidden state is the mean state.

        Args:
            state: (B, S) normalised, or (B, T, S).

        Returns:
            The state, and (B,) True where the image features are hidden; None where no sample's are.
        """
        if self.state_dropout >= 1:
            return torch.zeros_like(state), None
        if not self.training or not (self.state_dropout or self.image_dropout):
            return state, None
        draw = torch.rand(state.shape[0], *[1] * (state.dim() - 1), device=state.device)  # (B, 1) or (B, 1, 1)
        if self.state_dropout:
            state = state * (draw >= self.state_dropout)
        return state, draw.flatten() >= 1 - self.image_dropout if self.image_dropout else None

    def look(self, backbone: ResNet18, images: Tensor, cameras: int) -> Looked:
        """Features of pictures, which are moved and recoloured in training.

        Args:
            backbone: sees them.
            images: (n, 3, H, W) uint8.
            cameras: of how many cameras, which follow each other.
        """
        pixels = images.contiguous(memory_format=torch.channels_last)
        shift = torch.zeros(images.shape[0], 2, device=images.device)
        if self.training and self.image_shift:
            pixels, shift = shift_images(pixels, self.image_shift)
        x = backbone.prepare(pixels)
        if self.training and self.color_jitter:
            x = jitter_colour(x, self.color_jitter, cameras)
        return Looked(backbone(x), shift)

    def find_keyframes(
        self, looked: Looked, pictures: Tensor, projection: Tensor | None, state: Tensor, labels: Keyframes | None
    ) -> Sighting | None:
        """The hands' next keyframes, where the policy looks for them.

        Args:
            looked: what the backbone makes of the pictures.
            pictures: (B, V, 3, H, W) uint8, as they were before they were moved.
            projection: (B, V, 3, 4); None without calibration.
            state: (B, S) robot units, of which the grippers are told; never hidden.
            labels: what is to be found, in training and validation.

        Raises:
            ConfigError: there is no calibration.
        """
        if self.finder is None:
            return None
        if projection is None:
            raise missing_keyframes("observations without calibrated cameras")
        first, second, third, _ = looked.stages
        joints = self.normalizer.state(state)  # (B, S)
        grips = torch.stack([joints[:, place] for place in last_of_each_arm(state.shape[1])], 1)  # (B, 2)
        jitter = self.color_jitter if self.training else 0.0
        stages = (first, second, third)
        sighting: Sighting = self.finder(stages, projection, looked.shift, grips, pictures, labels, jitter)
        return sighting

    def lesson(self, terms: dict[str, Tensor], sighting: Sighting | None) -> dict[str, Tensor]:
        """Loss terms with those of the keyframes."""
        if self.finder is None or sighting is None or not sighting.terms:
            return terms
        weighted = self.finder.settings.weight * sighting.terms["keyframe"]
        return {**terms, **sighting.terms, "loss": terms["loss"] + weighted}

    @torch.no_grad()
    def for_inference(self) -> Self:
        """A copy that answers the same queries faster and cannot learn.

        Normalisation layers with fixed statistics are folded into their convolutions, weights are stored in the
        arithmetic of the networks, and what only training needs is left out. Later changes to this policy do not reach
        the copy.

        Returns:
            A policy in evaluation mode; its state dict is not that of a checkpoint.
        """
        fast = copy.deepcopy(self).eval().requires_grad_(False)
        for name in self.only_trained:
            setattr(fast, name, None)
        for part in fast.modules():
            if isinstance(part, ResNet18):
                fold_normalisation(part)
        device = self.normalizer.state_shift.device
        with autocast(self.precision, device):
            if torch.is_autocast_enabled(device.type):
                store_weights_as(fast, torch.bfloat16, keep=(*self.exact, "finder.axes", "finder.zoom"))
        return fast

    @contextmanager
    def evaluation_mode(self) -> Iterator[None]:
        """Evaluation mode for a while, whatever mode the policy is in."""
        was_training = self.training
        self.eval()
        try:
            yield
        finally:
            self.train(was_training)
