"""Figures of a validation: a predicted chunk beside the demonstrated one, and error against predicted uncertainty."""

from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from matplotlib.figure import Figure
from torch import Tensor

from ugr_lightning.contract import Batch, Chunk
from ugr_lightning.training.module import PolicyModule
from ugr_lightning.training.tensorboard import log_figure

SMALLEST_SPAN = 0.2  # of an action's axis, rad or gripper opening


class ValidationFigures(Callback):
    """Draws figures of the validation for TensorBoard.

    Args:
        every_n_validations: how often to draw; 0 for never.
    """

    def __init__(self, every_n_validations: int = 1) -> None:
        self.every_n_validations = every_n_validations
        self._validations = 0
        self._example: tuple[Batch, Chunk] | None = None
        self._sums: dict[str, Tensor] = {}

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._example, self._sums = None, {}

    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, *_: Any
    ) -> None:
        """Keep the first chunk, and sums per step of the chunk."""
        assert isinstance(pl_module, PolicyModule)
        chunk = pl_module.last_chunk
        if not self._due(trainer) or chunk is None:
            return
        if self._example is None:
            self._example = (batch, chunk)
        valid = batch.valid.float()  # (B, K)
        error = pl_module.step_error(chunk.actions, batch)  # (B, K)
        self._add("count", valid)
        self._add("error", error * valid)
        if chunk.coarse is not None:
            self._add("coarse", pl_module.step_error(chunk.coarse, batch) * valid)
        if chunk.log_variance is not None:
            self._add("deviation", (chunk.log_variance / 2).exp() * valid)
        if chunk.refined is not None:
            self._add("refined", chunk.refined * valid)

    def _add(self, name: str, values: Tensor) -> None:
        total = values.sum(0)  # (K,)
        self._sums[name] = self._sums[name] + total if name in self._sums else total

    def _due(self, trainer: Trainer) -> bool:
        wanted = self.every_n_validations and self._validations % self.every_n_validations == 0
        return bool(wanted) and trainer.is_global_zero and not trainer.sanity_checking

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._due(trainer) and self._example is not None:
            log_figure(trainer.loggers, "figures/chunk", _chunk_figure(*self._example), trainer.global_step)
            means = {name: (total / self._sums["count"].clamp(min=1)).cpu() for name, total in self._sums.items()}
            log_figure(trainer.loggers, "figures/error_by_step", _step_figure(means), trainer.global_step)
        if not trainer.sanity_checking:
            self._validations += 1


def _chunk_figure(batch: Batch, chunk: Chunk) -> Figure:
    """Demonstrated, coarse and executed actions of the first sample, one panel per dimension."""
    length = int(batch.valid[0].sum())
    action_dim = batch.actions.shape[-1]
    columns = (action_dim + 1) // 2
    figure = Figure(figsize=(2.2 * columns, 5), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False, sharex=True)
    for dim, axis in enumerate(axes.flat[:action_dim]):
        axis.plot(batch.actions[0, :length, dim].cpu(), color="black", label="demonstrated")
        if chunk.coarse is not None:
            axis.plot(chunk.coarse[0, :length, dim].float().cpu(), color="tab:blue", lw=1, label="coarse")
        axis.plot(chunk.actions[0, :length, dim].float().cpu(), color="tab:orange", lw=1, label="executed")
        if chunk.refined is not None:
            for k in torch.nonzero(chunk.refined[0, :length]).flatten().tolist():
                axis.axvspan(k - 0.5, k + 0.5, color="tab:orange", alpha=0.15, lw=0)
        low, high = axis.get_ylim()
        if high - low < SMALLEST_SPAN:  # an arm at rest shall look like one
            axis.set_ylim((low + high - SMALLEST_SPAN) / 2, (low + high + SMALLEST_SPAN) / 2)
        axis.set_title(f"action {dim}", fontsize=8)
        axis.tick_params(labelsize=7)
    axes.flat[0].legend(fontsize=7)
    figure.suptitle(f"episode {int(batch.episode[0])}, step {int(batch.step[0])}; shaded: refined", fontsize=9)
    return figure


def _step_figure(means: dict[str, Tensor]) -> Figure:
    """Error, predicted deviation and frequency of refinement over the K steps, each (K,) a mean of the validation."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot(means["error"], color="tab:orange", label="error, executed")
    if "coarse" in means:
        axis.plot(means["coarse"], color="tab:blue", label="error, coarse")
    axis.set_xlabel("step k of the chunk")
    axis.set_ylabel("error (standard deviations)")
    axis.set_ylim(bottom=0)
    if "deviation" in means or "refined" in means:
        other = axis.twinx()
        if "deviation" in means:
            other.plot(means["deviation"], color="tab:green", ls="--", label="predicted deviation exp(s/2)")
        if "refined" in means:
            other.bar(
                range(len(means["refined"])), means["refined"], color="tab:gray", alpha=0.3, label="refined, share"
            )
        other.set_ylim(bottom=0)
        other.legend(loc="lower right", fontsize=8)
    axis.legend(loc="upper left", fontsize=8)
    return figure
