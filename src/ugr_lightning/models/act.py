"""ACT, the Action Chunking Transformer, with the uncertainty-guided sparse refinement of the paper."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from ugr_lightning.contract import (
    ACTION_DIM,
    CAMERAS,
    CHUNK_LENGTH,
    STATE_DIM,
    Batch,
    Chunk,
    Keyframes,
    Observation,
)
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.cvae import Posterior
from ugr_lightning.models.keyframes import KeyframeSettings, Sighting
from ugr_lightning.models.losses import (
    Reconstruction,
    coarse_loss,
    kl_loss,
    refine_loss,
    total_loss,
    uncertainty_loss,
)
from ugr_lightning.models.normalizer import Normalizer
from ugr_lightning.models.precision import Precision, autocast, full_precision
from ugr_lightning.models.refine.branch import ResidualBranch
from ugr_lightning.models.refine.selector import Selector, checked_budget
from ugr_lightning.models.tokens import TokenPolicy
from ugr_lightning.models.transformer import DecoderLayer, EncoderLayer
from ugr_lightning.models.vision import Fold, NormName, ResNet18, StemName


class Plan(NamedTuple):
    """A chunk in normalised units, with what was needed to make it.

    Args:
        actions: (B, K, A) float32, A_1, or A_0 where nothing refines.
        coarse: (B, K, A) float32, A_0.
        log_variance: (B, K) float32, s; None without an uncertainty head.
        refined: (B, K) bool, m; None where nothing refines.
        sighting: the hands' next keyframes; None where the policy does not look for them.
    """

    actions: Tensor
    coarse: Tensor
    log_variance: Tensor | None
    refined: Tensor | None
    sighting: Sighting | None


class ACT(TokenPolicy):
    """Predicts a chunk of actions from images and joints, and refines some of its steps.

    The defaults are the sizes of the paper. `configs/` holds smaller ones.

    Args:
        refine: which steps are refined: Full, Block, Uncertainty, a selector of your own, or null for none (`base`).
        refine_detach_coarse: keep the refinement loss from changing the coarse actions; the paper lets it.
        uncertainty_head: predict a log-variance per step even where `refine` does not ask for it, for analysis.
        causal: let a step attend only to earlier ones in the decoder's self-attention (`cmask`).
        decoder_readout: which decoder layer is read out: `last`, or `first` as the public ACT code does (then the
            other layers are not built).
        reconstruction: `mse`, summed over the action (paper), or `l1`, averaged over it (public ACT code).
        uncertainty_holdout: n, for the uncertainty to be learned on episodes whose actions nothing else is trained on:
            every n-th; 0 trains everything on all episodes, as in the paper.
        coarse_weight: factor on L_coarse, 1 in the paper; controls set it.
        kl_weight: lambda_KL.
        uncertainty_weight: lambda_u.
        cameras: names of the cameras, in the order of the images.
        chunk_length: K, steps predicted at once.
        state_dim: S, numbers in the state.
        action_dim: A, numbers in an action.
        dim: D, width of the transformer.
        feedforward: width of its feed-forward nets.
        heads: attention heads.
        encoder_layers: layers that mix latent, state and image tokens.
        decoder_layers: layers that turn them into a chunk.
        cvae_layers: layers of the CVAE encoder; 0 builds none, and the latent is always zero.
        latent_dim: numbers in the latent.
        dropout: in all transformer layers.
        backbone_width: channels of the first stage of the ResNet-18; 64 is the usual one.
        backbone_stem: `standard`, or `unshuffle`, which is cheaper and has no published weights.
        backbone_norm: `frozen` (needs `backbone_weights`), `batch` (for training from scratch) or `group`.
        backbone_weights: file with ResNet-18 weights to start from: torchvision, original ACT or lerobot key names.
        camera_embedding: give each camera a learned position of its own, so that the policy can tell them apart.
        position_in_values: add positions to the image tokens themselves, not to queries and keys alone.
        keypoints: number of spatial-softmax keypoints a camera, given as one more token each; 0 for none.
        state_dropout: probability, per sample, of hiding the state in training; 1 hides it at run time as well.
        image_shift: largest random displacement of the images in training, in pixels.
        color_jitter: largest random relative change of contrast and brightness in training.
        image_dropout: probability, per sample, of hiding image tokens and keypoints in training, never together with
            the state.
        mirror: probability, per sample, of training on the mirror image; for tasks that are symmetric and
            arms whose joints are signed as ours are (ViperX).
        keyframes: tell the policy where each hand will grip next, and how that is looked for; null for not at all.
        backbone_fold: pixels on a side of the squares that the `unshuffle` stem folds, 4 or 8.
        precision: arithmetic of the trunk: `auto` takes bf16 where the hardware has it, else fp32.

    Source: paper, section III; tonyzhaozh/act@742c753, detr/models; docs/paper.md (what the paper leaves open).
    """

    not_kept: ClassVar[tuple[str, ...]] = ("backbone_weights",)
    retired: ClassVar[Mapping[str, object]] = {"refine_branch": "mlp", "backbone_stride": 32, "state_noise": 0.0}
    exact: ClassVar[tuple[str, ...]] = ("action_head", "uncertainty_head")
    only_trained: ClassVar[tuple[str, ...]] = ("posterior",)

    def __init__(
        self,
        refine: Selector | None = None,
        refine_detach_coarse: bool = False,
        uncertainty_head: bool = False,
        uncertainty_holdout: int = 0,
        causal: bool = False,
        decoder_readout: Literal["last", "first"] = "last",
        reconstruction: Reconstruction = "mse",
        coarse_weight: float = 1.0,
        kl_weight: float = 10.0,
        uncertainty_weight: float = 1.0,
        cameras: Sequence[str] = CAMERAS,
        chunk_length: int = CHUNK_LENGTH,
        state_dim: int = STATE_DIM,
        action_dim: int = ACTION_DIM,
        dim: int = 512,
        feedforward: int = 3200,
        heads: int = 8,
        encoder_layers: int = 4,
        decoder_layers: int = 7,
        cvae_layers: int = 4,
        latent_dim: int = 32,
        dropout: float = 0.1,
        backbone_width: int = 64,
        backbone_stem: StemName = "standard",
        backbone_norm: NormName = "frozen",
        backbone_weights: str | None = None,
        camera_embedding: bool = False,
        position_in_values: bool = False,
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
            Normalizer(state_dim, action_dim),
            state_dropout=state_dropout,
            image_dropout=image_dropout,
            image_shift=image_shift,
            color_jitter=color_jitter,
            mirror=mirror,
            keyframes=keyframes,
            backbone_width=backbone_width,
            precision=precision,
        )
        if dim % heads or dim % 4:
            raise ConfigError("dim", f"a multiple of heads ({heads}) and of 4", dim, "Change `dim` or `heads`.")
        wants_uncertainty = uncertainty_head or (refine is not None and refine.needs_uncertainty)
        if uncertainty_holdout and (uncertainty_holdout < 2 or not wants_uncertainty):
            fix = "Set it to 0, or to 5 for every fifth episode, with `uncertainty_head: true` if `refine` needs none."
            raise ConfigError("uncertainty_holdout", "0, or 2 and more with an uncertainty", uncertainty_holdout, fix)
        self.chunk_length, self.state_dim, self.action_dim = chunk_length, state_dim, action_dim
        self.refine, self.refine_detach_coarse, self.causal = refine, refine_detach_coarse, causal
        self.reconstruction, self.kl_weight, self.uncertainty_weight = reconstruction, kl_weight, uncertainty_weight
        self.coarse_weight, self.uncertainty_holdout = coarse_weight, uncertainty_holdout
        self.latent_dim, self.dropout = latent_dim, dropout
        sizes = (dim, heads, feedforward, dropout)

        self.posterior = Posterior(cvae_layers, latent_dim, state_dim, action_dim, *sizes) if cvae_layers else None

        self.backbone = ResNet18(backbone_width, backbone_stem, backbone_norm, backbone_fold)
        self.make_tokens_of(self.backbone, dim, latent_dim, keypoints, camera_embedding, position_in_values)
        built = 1 if decoder_readout == "first" else decoder_layers  # layers behind the readout would be dead
        self.encoder = nn.ModuleList(EncoderLayer(*sizes) for _ in range(encoder_layers))
        self.decoder = nn.ModuleList(DecoderLayer(*sizes) for _ in range(built))
        self.decoder_norm = nn.LayerNorm(dim)
        self.query_embed = nn.Parameter(torch.randn(chunk_length, dim))
        for parameter in (*self.encoder.parameters(), *self.decoder.parameters()):
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

        self.action_head = nn.Linear(dim, action_dim)
        self.uncertainty_head = nn.Linear(dim, 1) if wants_uncertainty else None
        self.branch = ResidualBranch(dim, action_dim) if refine is not None else None
        self.budget = checked_budget(refine, chunk_length, wants_uncertainty) if refine is not None else None
        if backbone_weights is not None:
            self.backbone.load_weights(backbone_weights)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """The terms of the objective; paper, Eq. (6) to (8).

        The latent is sampled from the posterior in training; in evaluation it is the posterior's mean, so that
        validation has no randomness.

        Args:
            batch: observations and the chunks that followed.

        Returns:
            Scalars `loss`, `coarse`, and where the policy has them `refine`, `uncertainty`, `kl`.

        Raises:
            ConfigError: images of another number of cameras.
            CheckpointError: no normalisation statistics.
        """
        batch = self.varied(batch)
        state, blind = self.disturb(self.normalizer.state(batch.state))  # (B, S), (B,)
        target = self.normalizer.action(batch.actions)  # (B, K, A)
        latent, posterior = state.new_zeros(len(state), self.latent_dim), None  # (B, latent)
        if self.posterior is not None:
            with autocast(self.precision, state.device):
                latent, posterior = self.posterior.draw(state, target, batch.valid)
        plan = self._plan(batch.observation, state, latent, batch.valid, blind, batch.keyframes)
        acting, doubting = self._lessons(batch)  # (B, K) each
        terms = {"coarse": coarse_loss(plan.coarse, target, acting, self.reconstruction)}
        if plan.refined is not None:
            terms["refine"] = refine_loss(plan.actions, target, plan.refined, acting, self.reconstruction)
        if plan.log_variance is not None:
            terms["uncertainty"] = uncertainty_loss(plan.coarse, target, plan.log_variance, doubting)
        if posterior is not None:
            terms["kl"] = kl_loss(*posterior)
        total = total_loss(
            terms,
            coarse_weight=self.coarse_weight,
            uncertainty_weight=self.uncertainty_weight,
            kl_weight=self.kl_weight,
        )
        return self.lesson({"loss": total, **terms}, plan.sighting)

    @torch.no_grad()
    def predict(self, observation: Observation) -> Chunk:
        """The chunk to execute, with a latent of zero, in evaluation mode whatever mode the policy is in.

        Args:
            observation: what the robot sees now.

        Returns:
            The chunk, in robot units.

        Raises:
            NumericsError: a NaN or an infinity in the state or in the prediction.
            ConfigError: images of another number of cameras.
            CheckpointError: no normalisation statistics.
        """
        self.require_finite_state(observation)
        with self.evaluation_mode():
            state, _ = self.disturb(self.normalizer.state(observation.state))  # (B, S)
            latent = state.new_zeros(state.shape[0], self.latent_dim)  # (B, latent)
            whole = torch.ones(state.shape[0], self.chunk_length, dtype=torch.bool, device=state.device)
            plan = self._plan(observation, state, latent, whole)
            actions = self.robot_actions(plan.actions)  # (B, K, A)
            coarse = None if plan.refined is None else self.normalizer.robot_action(plan.coarse)
        seen = plan.sighting
        return Chunk(actions, coarse, plan.log_variance, plan.refined, seen and seen.maps, seen and seen.points)

    def _plan(
        self,
        observation: Observation,
        state: Tensor,
        latent: Tensor,
        valid: Tensor,
        blind: Tensor | None = None,
        labels: Keyframes | None = None,
    ) -> Plan:
        """From inputs in network units to a chunk in network units; the paper's Eq. (2) to (5) in order."""
        with autocast(self.precision, state.device):
            pictures = self.pictures(observation).flatten(0, 1)  # (B, V, 3, H, W)
            looked = self.look(self.backbone, pictures.flatten(0, 1), len(self.cameras))
            sighting = self.find_keyframes(looked, pictures, observation.projection, observation.state, labels)
            token = self.keyframe_token(sighting)  # (B, 1, D)
            memory, position = self.tokens(looked, state, latent, token, blind)  # (B, N, D), (N, D)
            for layer in self.encoder:
                memory = layer(memory, position)
            memory_keys = memory + position  # (B, N, D)
            hidden = self._decode(memory, memory_keys, token)  # (B, K, D), H_0
        log_variance = None
        with full_precision(state.device):
            whole = hidden.float()
            coarse = self.action_head(whole)  # (B, K, A), A_0
            if self.uncertainty_head is not None:
                log_variance = self.uncertainty_head(whole.detach()).squeeze(-1).clamp(-10, 10)  # (B, K), s
        actions, refined = self.refined(hidden, coarse, log_variance, valid)
        return Plan(actions, coarse, log_variance, refined, sighting)

    def refined(
        self, hidden: Tensor, coarse: Tensor, log_variance: Tensor | None, valid: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """A_1 of A_0; paper, Eq. (3) to (5).

        Args:
            hidden: (B, K, D), H_0.
            coarse: (B, K, A) float32, A_0, normalised.
            log_variance: (B, K) float32, s; None without an uncertainty head.
            valid: (B, K) bool, False on padded steps.

        Returns:
            (B, K, A) float32, A_1, and (B, K) bool, m; None where nothing refines.
        """
        if self.refine is None or self.branch is None:
            return coarse, None
        chosen = self.refine.select(None if log_variance is None else log_variance.detach(), valid, self.training)
        start = coarse.detach() if self.refine_detach_coarse else coarse
        with autocast(self.precision, coarse.device):
            if self.budget is not None and not torch.is_grad_enabled():
                residual = self.branch.at(chosen, self.budget, hidden, start)  # (B, K, A), m * dA
            else:
                residual = self.branch(hidden, start)  # (B, K, A), dA
        return start + chosen[..., None] * residual, chosen  # A_1 = A_0 + m * dA

    def _lessons(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Which steps (B, K) teach the actions, and which the uncertainty; the same, unless episodes are held out."""
        if not self.training or not self.uncertainty_holdout:
            return batch.valid, batch.valid
        held_out = (batch.episode % self.uncertainty_holdout == 0)[:, None]  # (B, 1)
        return batch.valid & ~held_out, batch.valid & held_out

    def _decode(self, memory: Tensor, memory_keys: Tensor, token: Tensor | None) -> Tensor:
        """Coarse hidden states (B, K, D), H_0; every query begins with what is told of the keyframes (B, 1, D)."""
        same = 1 if not (self.training and self.dropout) else memory.shape[0]  # samples differ in what was dropped
        x = memory.new_zeros(same, *self.query_embed.shape)  # (1, K, D) until samples look at their memory
        if token is not None and self.keyframe_query is not None:
            x = x + self.keyframe_query(token).to(x.dtype)  # (B, K, D)
        position = self.query_embed.to(x.dtype)  # (K, D)
        steps = self.chunk_length
        allowed = torch.ones(steps, steps, dtype=torch.bool, device=x.device).tril() if self.causal else None  # (K, K)
        for layer in self.decoder:
            x = layer(x, position, memory, memory_keys, allowed)
        normed: Tensor = self.decoder_norm(x)
        return normed
