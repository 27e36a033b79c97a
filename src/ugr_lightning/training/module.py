"""Trains anything that speaks ChunkPolicy: steps, optimiser, logging. The mathematics is the policy's own."""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torchmetrics import Metric
from torchmetrics.aggregation import MeanMetric
from torchmetrics.regression import SpearmanCorrCoef

from ugr_lightning.contract import Batch, Chunk, ChunkPolicy, Statistics
from ugr_lightning.errors import ConfigError, NumericsError
from ugr_lightning.models.checkpoint import describe
from ugr_lightning.models.refine.ranked import highest
from ugr_lightning.training.keyframe_error import MedianMetric, event_errors, known_kinematics
from ugr_lightning.training.optimizer import MuonAndAdamW, Parts, parts_of


class PolicyModule(LightningModule):
    """A policy in training: AdamW, a learning-rate schedule and the log.

    Args:
        policy: the policy to train.
        learning_rate: peak step size of AdamW (paper, section IV-A: 1e-5).
        backbone_learning_rate: step size of what sees (backbone, keyframes' maps); null means `learning_rate`.
        muon_learning_rate: step size of Muon, which trains the matrices of transformer layers then (`learning_rate`
            times three is a good start); null means AdamW trains them as the rest.
        weight_decay: AdamW's decoupled weight decay.
        warmup_steps: optimiser steps over which the learning rate rises linearly.
        schedule: what follows the warm-up: `constant`; `cosine` down to a hundredth at the trainer's last step; or
            `cosine_to_zero`, whose warm-up also begins at zero, as Diffusion Policy's does.
        betas: decay rates of AdamW's two averages.

    Raises:
        ConfigError: a number that no training can have.
    """

    def __init__(
        self,
        policy: ChunkPolicy,
        learning_rate: float = 1e-5,
        backbone_learning_rate: float | None = None,
        muon_learning_rate: float | None = None,
        weight_decay: float = 1e-4,
        warmup_steps: int = 0,
        schedule: Literal["constant", "cosine", "cosine_to_zero"] = "constant",
        betas: tuple[float, float] = (0.9, 0.999),
    ) -> None:
        super().__init__()
        rates = {"learning_rate": learning_rate, "weight_decay": weight_decay, "warmup_steps": warmup_steps}
        own = {"backbone_learning_rate": backbone_learning_rate, "muon_learning_rate": muon_learning_rate}
        rates |= {name: value for name, value in own.items() if value is not None}
        for name, value in rates.items():  # AdamW looks at the rate of its first group only
            if not 0 <= value < math.inf:
                raise ConfigError(f"model.{name}", "a number, 0 or more", value, "Correct the number.")
        if not all(0 <= beta < 1 for beta in betas):
            raise ConfigError("model.betas", "two numbers from 0 to below 1", betas, "Correct the numbers.")
        self.policy = policy
        self.learning_rate = learning_rate
        self.backbone_learning_rate = learning_rate if backbone_learning_rate is None else backbone_learning_rate
        self.muon_learning_rate = muon_learning_rate
        self.weight_decay = weight_decay
        self.warmup_steps = warmup_steps
        self.schedule = schedule
        self.betas = betas
        self.scores = nn.ModuleDict(_scores())
        self.last_chunk: Chunk | None = None  # of the validation batch at hand; the figures read it

    def setup(self, stage: str) -> None:
        """Hand the training episodes' statistics to the policy; a checkpoint restored later overwrites them.

        Raises:
            ConfigError: the policy is made for other joints or cameras than the demonstrations have, or the trainer
                would change the type of the weights.
        """
        if not str(self.trainer.precision).endswith(("32-true", "-mixed")):
            fix = "Set `model.policy.init_args.precision: bf16` for a trunk in bf16; weights stay float32."
            raise ConfigError("trainer.precision", "32-true, bf16-mixed or 16-mixed", self.trainer.precision, fix)
        data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
        statistics = data.statistics
        check_fit(self.policy, statistics, getattr(data, "cameras", self.policy.cameras))
        self._action_std, self._forward = statistics.action_std, known_kinematics(data)
        if stage == "fit":
            self.policy.set_statistics(statistics)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Count logged steps right: Lightning adds one too many when it resumes at an epoch's boundary."""
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self.trainer.global_step

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The objective of one batch; every named term goes to the log, on the steps that are logged."""
        terms = self.policy.losses(batch)
        if not torch.stack(list(terms.values())).isfinite().all():
            raise self._not_finite(batch, terms)
        if _logs_now(self.trainer):
            rate = self.trainer.optimizers[0].param_groups[0]["lr"]
            shown = {**terms, "learning_rate": rate}
            self.log_dict({f"train/{name}": value for name, value in shown.items()}, batch_size=len(batch.state))
        return terms["loss"]

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """The objective, and the errors of what the robot would execute (latent z = 0)."""
        terms = self.policy.losses(batch)
        self.log_dict(
            {f"val/{name}": term for name, term in terms.items()}, batch_size=len(batch.state), sync_dist=True
        )
        chunk = self.last_chunk = self.policy.predict(batch.observation)
        self._score(batch, chunk)

    def step_error(self, actions: Tensor, batch: Batch) -> Tensor:
        """Mean absolute error of each step over its dimensions, in standard deviations of the training actions.

        Args:
            actions: (B, K, A), robot units.
            batch: the demonstrated chunks.

        Returns:
            (B, K) float32.
        """
        std = self._action_std.to(batch.actions)  # (A,)
        return ((actions.float() - batch.actions).abs() / std).mean(-1)  # (B, K)

    def _score(self, batch: Batch, chunk: Chunk) -> None:
        error, valid = self.step_error(chunk.actions, batch), batch.valid  # (B, K), (B, K)
        coarse = error if chunk.coarse is None else self.step_error(chunk.coarse, batch)  # (B, K)
        self._mean("action_error", error, valid)
        self._mean("first_frame_error", error, valid & (batch.step == 0)[:, None])
        if self._forward is not None and batch.keyframes is not None:
            self._metric("event_mm").update(event_errors(self._forward, chunk.actions, batch))
            self.log("val/event_mm", self._metric("event_mm"), on_step=False, on_epoch=True)
        if chunk.refined is not None:
            self._mean("coarse_error", coarse, valid)
            self._mean("refined_error", error, valid)
            self._mean("coarse_error_inside_mask", coarse, valid & chunk.refined)
            self._mean("error_inside_mask", error, valid & chunk.refined)
            self._mean("error_outside_mask", error, valid & ~chunk.refined)
            found, chosen = found_by(chunk.refined, coarse, valid)
            self._mean("selector_recall", found, chosen > 0)
        if chunk.log_variance is not None:
            # the head is trained on the error of the coarse actions: paper, Eq. (8)
            self._metric("spearman").update(chunk.log_variance[valid].float(), coarse[valid])
            self.log("val/spearman", self._metric("spearman"), on_step=False, on_epoch=True)

    def _mean(self, name: str, error: Tensor, where: Tensor) -> None:
        self._metric(name).update(error[where])
        self.log(f"val/{name}", self._metric(name), on_step=False, on_epoch=True, prog_bar=name == "action_error")

    def _metric(self, name: str) -> Metric:
        metric = self.scores[name]
        assert isinstance(metric, Metric)
        return metric

    def parts(self) -> Parts:
        """What is trained of the policy.

        Raises:
            ConfigError: nothing is, nothing of it is for Muon, or this torch has no Muon.
        """
        parts = parts_of(self.policy, muon=self.muon_learning_rate is not None)
        if not any(parts):
            fix = "Let `requires_grad` of some of them be true."
            raise ConfigError("model.policy", "parameters that are trained", "none that are not frozen", fix)
        if self.muon_learning_rate is not None and not parts.mixing:
            fix = "Set it to null: AdamW trains all of this policy."
            expected = "a policy with transformer layers that are trained"
            raise ConfigError("model.muon_learning_rate", expected, type(self.policy).__name__, fix)
        if parts.mixing and not hasattr(torch.optim, "Muon"):
            fix = "Set it to null, or update torch."
            raise ConfigError("model.muon_learning_rate", "torch 2.9 or later", torch.__version__, fix)
        return parts

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW with what sees as a group of its own, Muon for matrices if wanted, and a schedule that counts steps.

        Raises:
            ConfigError: as `parts`.
        """
        acting, seeing, mixing = self.parts()
        pairs = ((acting, self.learning_rate), (seeing, self.backbone_learning_rate))
        groups = [{"params": part, "lr": rate} for part, rate in pairs if part]
        fused = not str(self.trainer.precision).endswith("-mixed")  # Lightning clips no gradients of a fused one then
        settings: Any = {"betas": self.betas, "weight_decay": self.weight_decay, "fused": fused}
        optimizer: torch.optim.Optimizer
        if mixing and self.muon_learning_rate is not None:
            optimizer = MuonAndAdamW(mixing, self.muon_learning_rate, groups, **settings)
        else:
            optimizer = torch.optim.AdamW(groups, lr=self.learning_rate, **settings)
        total = int(self.trainer.estimated_stepping_batches) if self.schedule != "constant" else 0
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: self.learning_rate_factor(step, total))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def learning_rate_factor(self, step: int, total_steps: int) -> float:
        """The factor on the peak learning rate at one optimiser step.

        Args:
            step: optimiser steps done.
            total_steps: optimiser steps of the whole training (cosine only).
        """
        to_zero = self.schedule == "cosine_to_zero"
        if step < self.warmup_steps:
            return (step if to_zero else step + 1) / self.warmup_steps
        if self.schedule == "constant":
            return 1.0
        done = min(1.0, (step - self.warmup_steps) / max(1, total_steps - self.warmup_steps))
        last = 0.0 if to_zero else 0.01
        return last + (1 - last) * 0.5 * (1 + math.cos(math.pi * done))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Make the checkpoint complete in itself."""
        checkpoint["policy"] = describe(self.policy, self.trainer.datamodule)  # type: ignore[attr-defined]

    def _not_finite(self, batch: Batch, terms: dict[str, Tensor]) -> NumericsError:
        """Write what is needed to replay the step, and name it."""
        step = self.trainer.global_step
        logs = (logger.log_dir for logger in self.trainer.loggers)  # the trainer's log_dir would wait for all processes
        dump = Path(next(filter(None, logs), self.trainer.default_root_dir)) / f"not_finite_step{step}.pt"
        dump.parent.mkdir(parents=True, exist_ok=True)
        content = {"batch": batch._asdict(), "state_dict": self.state_dict(), "policy": self.policy.blueprint()}
        torch.save(content, dump)
        bad = ", ".join(
            f"{name} = {float(term.detach()):g}" for name, term in terms.items() if not torch.isfinite(term)
        )
        samples = ", ".join(f"{e}:{t}" for e, t in zip(batch.episode.tolist(), batch.step.tolist(), strict=True))
        return NumericsError(
            f"training step {step}",
            "finite losses",
            f"{bad} on episode:step {samples}",
            f"The batch and the weights are in {dump}; look at those episodes, or lower the learning rate. "
            "`ugr fit --checkpoint last` goes on from the last checkpoint.",
        )


def _logs_now(trainer: Trainer) -> bool:
    """Whether anybody reads what this training step logs: the loggers, or what follows the last batch of an epoch."""
    every = trainer.log_every_n_steps  # type: ignore[attr-defined]
    return trainer.is_last_batch or bool(every and (trainer.global_step + 1) % every == 0)


def check_fit(policy: ChunkPolicy, statistics: Statistics, cameras: Sequence[str]) -> None:
    """Make sure that a policy sees and commands what the demonstrations hold.

    Args:
        policy: what is trained.
        statistics: of the demonstrations; their lengths are S and A.
        cameras: the demonstrations' cameras, in order.

    Raises:
        ConfigError: another number of joints, or other cameras; shows both sides.
    """
    wanted = (policy.state_dim, policy.action_dim, tuple(policy.cameras))
    found = (len(statistics.state_mean), len(statistics.action_mean), tuple(cameras))
    if wanted != found:
        expected, got = (f"state {s}, action {a}, cameras {', '.join(c)}" for s, a, c in (wanted, found))
        fix = "Set the policy's `state_dim`, `action_dim` and `cameras`, or choose joints with `data.layout`."
        raise ConfigError("demonstrations", f"what the policy is made for ({expected})", got, fix)


def found_by(refined: Tensor, error: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Share of each chunk's worst steps that were chosen for refinement, against an oracle with the same budget.

    Args:
        refined: (B, K) bool.
        error: (B, K) of the coarse actions.
        valid: (B, K) bool, False on padded steps.

    Returns:
        (B,) shares, 0 where nothing was chosen, and (B,) how many steps were.
    """
    chosen = (refined & valid).sum(1)  # (B,)
    return (highest(error, valid, chosen[:, None]) & refined).sum(1) / chosen.clamp(min=1), chosen


def _scores() -> dict[str, Metric]:
    means = ["action_error", "first_frame_error", "coarse_error", "refined_error"]
    means += ["coarse_error_inside_mask", "error_inside_mask", "error_outside_mask", "selector_recall"]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*will save all targets")  # one validation is small
        spearman = SpearmanCorrCoef()
    medians = {"event_mm": MedianMetric(nan_strategy="disable"), "spearman": spearman}
    return {name: MeanMetric(nan_strategy="disable") for name in means} | medians
