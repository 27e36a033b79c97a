"""Exponential moving average of weights and buffers: what is validated, rolled out and saved."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

_TRAINING_WEIGHTS = "training_state_dict"


class WeightAverage(Callback):
    """Keeps a moving average of the policy, BatchNorm's running statistics included.

    Lightning's own callback averages with one Python call per tensor, drifts on constant buffers by rounding and
    knows no warm-up; this one is exact where the weights do not move, so that normalisation statistics stay bit-equal.
    In a checkpoint `state_dict` holds the average, `training_state_dict` the weights the optimiser goes on from.

    Args:
        decay: largest weight of the past per step; 0 turns averaging off (the paper's setting).
        power: step n uses 1 - (1 + n)^-power where that is smaller (Diffusion Policy: 0.75), so that the average
            spans more steps the longer training lasts; null uses (1 + n) / (10 + n), which soon reaches `decay`.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, policy/DP/diffusion_policy/model/diffusion/ema_model.py (power).
    """

    def __init__(self, decay: float = 0.0, power: float | None = None) -> None:
        self.decay = decay
        self.power = power
        self._average: dict[str, Tensor] = {}
        self._current: dict[str, Tensor] = {}  # the module's own tensors, of the same names
        self._step = 0
        self._validating = False

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Begin with the weights as they are, unless a checkpoint brought an average."""
        if self.decay and not self._average:
            self._average = _snapshot(pl_module)
        self._average = {name: value.to(pl_module.device) for name, value in self._average.items()}
        self._current = pl_module.state_dict()

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Move the average after each optimiser step."""
        if not self.decay or trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        weight = 1 - self.decay_at(self._step)
        moving = [name for name, value in self._average.items() if value.is_floating_point()]
        with torch.no_grad():
            torch._foreach_lerp_([self._average[n] for n in moving], [self._current[n] for n in moving], weight)
            for name in self._average.keys() - set(moving):  # counters and flags
                self._average[name].copy_(self._current[name])

    def decay_at(self, step: int) -> float:
        """The weight of the past in the update after optimiser step `step`, counted from 1."""
        if self.power is None:
            return min(self.decay, (1 + step) / (10 + step))
        return min(self.decay, 1 - (1 + step) ** -self.power)

    @contextmanager
    def averaged(self, pl_module: LightningModule) -> Iterator[None]:
        """Within this context the module holds the averaged weights."""
        self._swap(pl_module)
        try:
            yield
        finally:
            self._swap(pl_module)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._swap(pl_module)
        self._validating = True

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._swap(pl_module)
        self._validating = False

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Back to the training weights where a validation was cut short: a checkpoint may still be written."""
        if self._validating:
            self.on_validation_end(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the average in the module: it is the result."""
        self._swap(pl_module)
        self._average = self._current = {}

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Save the average as the weights, and the training weights beside it."""
        if self._average:
            checkpoint[_TRAINING_WEIGHTS] = checkpoint["state_dict"]
            checkpoint["state_dict"] = dict(self._average)

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Take up both again when training goes on; other stages keep the average."""
        if not trainer.training:
            return
        if self.decay:
            self._average = _snapshot(pl_module)
        if _TRAINING_WEIGHTS in checkpoint:
            pl_module.load_state_dict(checkpoint[_TRAINING_WEIGHTS])

    def state_dict(self) -> dict[str, Any]:
        return {"step": self._step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._step = state_dict["step"]

    def _swap(self, pl_module: LightningModule) -> None:
        if not self._average:
            return
        with torch.no_grad():
            for name, tensor in pl_module.state_dict().items():
                kept = tensor.clone()
                tensor.copy_(self._average[name])
                self._average[name].copy_(kept)


def _snapshot(pl_module: LightningModule) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in pl_module.state_dict().items()}


@contextmanager
def averaged_weights(trainer: Trainer, pl_module: LightningModule) -> Iterator[None]:
    """Within this context the module holds averaged weights, where the trainer averages them.

    Args:
        trainer: the trainer whose callbacks may hold a `WeightAverage`.
        pl_module: the module in training.
    """
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, WeightAverage):
            with callback.averaged(pl_module):
                yield
            return
    yield
