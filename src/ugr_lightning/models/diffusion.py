"""Diffusion Policy: chunks made from noise by a U-Net that is conditioned on the observations."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from ugr_lightning.contract import ACTION_DIM, STATE_DIM, Batch, Chunk, Keyframes, Observation
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.keyframes import ARMS, FEATURES, KeyframeSettings, Sighting
from ugr_lightning.models.noise_process import NoiseProcess, PredictionName, SamplerName
from ugr_lightning.models.normalizer import Normalizer
from ugr_lightning.models.perception import Looked, PicturePolicy
from ugr_lightning.models.precision import Precision, autocast
from ugr_lightning.models.unet import ConditionalUNet
from ugr_lightning.models.vision import Fold, NormName, ResNet18, StemName, spatial_softmax


class DiffusionPolicy(PicturePolicy):
    """Predicts a chunk of actions by removing noise step by step.

    The defaults are RoboTwin's: 3 observations of the head camera, 8 predicted steps of which the first two lie in the
    past and the other six are the chunk. `configs/` holds a smaller one that sees all cameras.

    Args:
        cameras: names of the cameras, in the order of the images.
        chunk_length: K, steps predicted from now on.
        observation_steps: T, observations that the policy sees, the newest and those just before it.
        predict_past: predict also the T - 1 commands that led here, as RoboTwin does; they are not executed. Their
            targets are the states of the history, a state being the command of the step before.
        state_dim: S, numbers in the state.
        action_dim: A, numbers in an action.
        diffusion_steps: steps from a clean chunk to noise in training.
        sampler: `ddpm` or `ddim`; the latter needs few steps.
        sampling_steps: steps from noise to a chunk at run time.
        prediction: what the U-Net predicts: the noise (`epsilon`) or the clean `sample`.
        noise_draws: noisy versions of each chunk in a batch; more cost little, as the images are looked at once.
        noise_seed: seed of the noise that every prediction starts from.
        unet_widths: channels of each level of the U-Net; every level but the last halves the number of steps.
        share_backbone: one ResNet-18 for all cameras; otherwise one for each.
        backbone_width: channels of the first stage of the ResNet-18; 64 is the usual one.
        backbone_stem: `standard`, or `unshuffle`, which is cheaper and has no published weights.
        backbone_norm: `group`, `batch`, or `frozen` (needs `backbone_weights`).
        backbone_weights: file with ResNet-18 weights to start from: torchvision, original ACT or lerobot key names.
        keypoints: number of spatial-softmax keypoints a camera, beside the mean of its features; 0 for none.
        state_dropout: probability, per sample, of hiding the state in training; 1 hides it at run time as well.
        image_shift: largest random displacement of the images in training, in pixels.
        color_jitter: largest random relative change of contrast and brightness in training.
        image_dropout: probability, per sample, of hiding the image features in training, never together with the state.
        mirror: probability, per sample, of training on the mirror image; for tasks that are symmetric and
            arms whose joints are signed as ours are (ViperX).
        keyframes: tell the policy where each hand will grip next, and how that is looked for; null for not at all.
        backbone_fold: pixels on a side of the squares that the `unshuffle` stem folds, 4 or 8.
        precision: arithmetic of the networks: `auto` takes bf16 where the hardware has it, else fp32.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/DP/diffusion_policy.
    """

    not_kept: ClassVar[tuple[str, ...]] = ("backbone_weights",)
    retired: ClassVar[Mapping[str, object]] = {
        "unet_kernel": 5,
        "unet_groups": 8,
        "step_dim": 128,
        "backbone_stride": 32,
    }
    exact: ClassVar[tuple[str, ...]] = ("unet.head",)

    def __init__(
        self,
        cameras: Sequence[str] = ("cam_high",),
        chunk_length: int = 6,
        observation_steps: int = 3,
        predict_past: bool = True,
        state_dim: int = STATE_DIM,
        action_dim: int = ACTION_DIM,
        diffusion_steps: int = 100,
        sampler: SamplerName = "ddpm",
        sampling_steps: int = 100,
        prediction: PredictionName = "epsilon",
        noise_draws: int = 1,
        noise_seed: int = 0,
        unet_widths: Sequence[int] = (256, 512, 1024),
        share_backbone: bool = False,
        backbone_width: int = 64,
        backbone_stem: StemName = "standard",
        backbone_norm: NormName = "group",
        backbone_weights: str | None = None,
        keypoints: int = 0,
        state_dropout: float = 0.0,
        image_shift: int = 0,
        color_jitter: float = 0.0,
        image_dropout: float = 0.0,
        mirror: float = 0.0,
        keyframes: KeyframeSettings | None = None,
        backbone_fold: Fold = 4,
        precision: Precision = "auto",
    ) -> None:
        super().__init__(
            cameras,
            Normalizer(state_dim, action_dim, "min_max"),
            state_dropout=state_dropout,
            image_dropout=image_dropout,
            image_shift=image_shift,
            color_jitter=color_jitter,
            mirror=mirror,
            keyframes=keyframes,
            backbone_width=backbone_width,
            precision=precision,
        )
        for name, value in (("observation_steps", observation_steps), ("noise_draws", noise_draws)):
            if value < 1:
                raise ConfigError(name, "at least 1", value, "Correct the number.")
        if predict_past and observation_steps > 1 and state_dim != action_dim:
            fix = "Set `predict_past: false`."
            raise ConfigError("predict_past", "states that are commands", f"{state_dim} against {action_dim}", fix)
        self.chunk_length, self.observation_steps = chunk_length, observation_steps
        self.state_dim, self.action_dim = state_dim, action_dim
        self.past = observation_steps - 1 if predict_past else 0
        self.noise_draws, self.noise_seed = noise_draws, noise_seed

        count = 1 if share_backbone else len(self.cameras)
        self.backbones = nn.ModuleList(
            ResNet18(backbone_width, backbone_stem, backbone_norm, backbone_fold) for _ in range(count)
        )
        channels, middle = 8 * backbone_width, 4 * backbone_width
        self.keypoint_maps = nn.ModuleList(nn.Conv2d(middle, keypoints, 1) for _ in range(count if keypoints else 0))
        told = ARMS * FEATURES if keyframes is not None else 0
        seen = len(self.cameras) * (channels + 2 * keypoints) + told + state_dim
        self.unet = ConditionalUNet(action_dim, observation_steps * seen, unet_widths)
        self.process = NoiseProcess(diffusion_steps, sampler, sampling_steps, prediction)
        if backbone_weights is not None:
            for backbone in self._backbones():
                backbone.load_weights(backbone_weights)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The squared error of the U-Net's prediction at random diffusion steps.

        In evaluation noise and diffusion step are a function of episode and time step, so that validation has no
        randomness and does not depend on the size of the batches.

        Args:
            batch: observations and the chunks that followed.

        Returns:
            The scalar `loss`, a mean over valid steps and dimensions.

        Raises:
            ConfigError: images of another number of cameras or observations.
            CheckpointError: no normalisation statistics.
        """
        batch = self.varied(batch)
        target = self.normalizer.action(batch.actions)  # (B, K, A)
        valid = batch.valid.float()  # (B, K)
        if self.past:
            target = torch.cat([self.normalizer.action(batch.state[:, 1:]), target], dim=1)  # (B, L, A)
            valid = torch.cat([valid.new_ones(valid.shape[0], self.past), valid], dim=1)  # (B, L)
        noise, step = self._draw(batch, target.shape[1])  # (B n, L, A), (B n,), n noise draws
        condition, sighting = self._condition(batch.observation, batch.keyframes)
        clean, valid, condition = (x.repeat_interleave(self.noise_draws, dim=0) for x in (target, valid, condition))
        noisy, wanted = self.process.corrupt(clean, noise, step)  # (B n, L, A) each
        error = (self._denoise(noisy, step, condition) - wanted).square().mean(-1)  # (B n, L)
        return self.lesson({"loss": (error * valid).sum() / valid.sum()}, sighting)

    def predict(self, observation: Observation) -> Chunk:
        """The chunk to execute, in evaluation mode whatever mode the policy is in.

        All queries start from the same noise, that of `noise_seed`. A chunk therefore is a function of its observation
        alone, whatever was asked before or beside it; and where several ways are open, successive chunks of an episode
        tend to choose the same one, which is what averages of overlapping chunks need.

        Args:
            observation: what the robot sees now, and saw before.

        Returns:
            The chunk, in robot units.

        Raises:
            NumericsError: a NaN or an infinity in the state or in the prediction.
            ConfigError: images of another number of cameras or observations.
            CheckpointError: no normalisation statistics.
        """
        return self.sample(observation, self.noise_seed)

    @torch.no_grad()
    def sample(self, observation: Observation, seed: int) -> Chunk:
        """One of the chunks that the policy holds possible; see `predict`.

        Args:
            observation: what the robot sees now, and saw before.
            seed: which one; the same for all rows.
        """
        self.require_finite_state(observation)
        with self.evaluation_mode():
            condition, seen = self._condition(observation)  # (B, C)
            shape = (condition.shape[0], self.past + self.chunk_length, self.action_dim)
            plan = self.process.sample(
                lambda noisy, step: self._denoise(noisy, step, condition), shape, seed, condition.device
            )  # (B, L, A)
        actions = self.robot_actions(plan[:, self.past :])  # (B, K, A)
        newest = slice(self.observation_steps - 1, None, self.observation_steps)  # of the B T that were looked at
        return Chunk(actions, maps=seen and seen.maps[newest], points=seen and seen.points[newest])

    def _denoise(self, noisy: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        with autocast(self.precision, noisy.device):
            predicted: Tensor = self.unet(noisy, step, condition)  # (B, L, A)
        return predicted

    def _draw(self, batch: Batch, length: int) -> tuple[Tensor, Tensor]:
        """Noise (B n, L, A) and diffusion steps (B n,) for the n noisy versions of each chunk."""
        shape = (self.noise_draws, length, self.action_dim)
        size, device = batch.state.shape[0], batch.state.device
        if self.training:
            noise = torch.randn(size * shape[0], *shape[1:], device=device)
            return noise, torch.randint(self.process.steps, (size * shape[0],), device=device)
        generators = [
            torch.Generator().manual_seed(1_000_003 * episode + step)
            for episode, step in zip(batch.episode.tolist(), batch.step.tolist(), strict=True)
        ]
        noise = torch.cat([torch.randn(shape, generator=generator) for generator in generators])
        steps = [torch.randint(self.process.steps, shape[:1], generator=generator) for generator in generators]
        return noise.to(device), torch.cat(steps).to(device)

    def _condition(self, observation: Observation, labels: Keyframes | None = None) -> tuple[Tensor, Sighting | None]:
        """What the U-Net is told of the observations, (B, C) float32, and where keyframes were seen."""
        images, (_, state, projection) = self.pictures(observation), observation
        if self.observation_steps == 1:
            state, projection = state[:, None], None if projection is None else projection[:, None]
        size, steps = images.shape[:2]
        with autocast(self.precision, images.device):
            frames = images.flatten(0, 1)  # (B T, V, 3, H, W)
            looked, features = self._see(frames)  # (B T, V F)
            if projection is not None:
                projection = projection.flatten(0, 1)  # (B T, V, 3, 4)
            if labels is not None:
                labels = Keyframes(*(part.repeat_interleave(steps, dim=0) for part in labels))
            sighting = self.find_keyframes(looked, frames, projection, state.flatten(0, 1), labels)
        state, blind = self.disturb(self.normalizer.state(state))  # (B, T, S), (B,)
        parts = [features.float().reshape(size, -1), state.flatten(1)]  # (B, ...) each
        if blind is not None:
            parts[0] = parts[0] * (~blind)[:, None]
        if sighting is not None:
            parts.append(sighting.features.reshape(size, -1))
        return torch.cat(parts, dim=1), sighting

    def _see(self, frames: Tensor) -> tuple[Looked, Tensor]:
        """What the backbones make of (n, V, 3, H, W) uint8 pictures, and its means and keypoints, (n, F)."""
        cameras = len(self.cameras)
        if len(self.backbones) == 1:
            looked = self.look(self._backbones()[0], frames.flatten(0, 1), cameras)
            features = self._features(0, looked).unflatten(0, (-1, cameras))  # (n, V, F)
            return looked, features.flatten(1)
        each = [self.look(backbone, frames[:, at], 1) for at, backbone in enumerate(self._backbones())]
        features = torch.stack([self._features(at, one) for at, one in enumerate(each)], dim=1)  # (n, V, F)
        stages = [torch.stack(same, 1).flatten(0, 1) for same in zip(*(one.stages for one in each), strict=True)]
        first, second, third, last = stages  # (n V, C, h, w) each
        shift = torch.stack([one.shift for one in each], 1).flatten(0, 1)  # (n V, 2)
        return Looked((first, second, third, last), shift), features.flatten(1)

    def _features(self, which: int, looked: Looked) -> Tensor:
        """Mean features and keypoints of what one backbone saw, (n, F)."""
        mean = looked.stages[3].float().mean((2, 3))  # (n, C)
        if not self.keypoint_maps:
            return mean
        return torch.cat([mean, spatial_softmax(self.keypoint_maps[which](looked.stages[2]))], dim=1)

    def _backbones(self) -> list[ResNet18]:
        return [backbone for backbone in self.backbones if isinstance(backbone, ResNet18)]
