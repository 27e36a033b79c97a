"""What training says on the console: a bar with the time left on a terminal, and one line per validation anywhere."""

import sys
import time
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar

from ugr_lightning.contract import Batch
from ugr_lightning.system.progress import Progress

_SAID = ("loss", "action_error", "first_frame_error")


class TrainingProgress(ProgressBar):
    """Counts optimiser steps towards the trainer's last one, and logs how many there are per second."""

    def __init__(self) -> None:
        super().__init__()
        self._bar: Progress | None = None
        self._since, self._steps, self._samples = 0.0, 0, 0

    def disable(self) -> None:
        """Called on all processes but the first; the bar and its lines look at the rank themselves."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        total = int(trainer.estimated_stepping_batches)
        shown = trainer.is_global_zero and sys.stderr.isatty()
        self._bar = Progress("training", total, done=trainer.global_step, shown=shown)
        self._bar.__enter__()
        self._start = (time.monotonic(), trainer.global_step)
        self._restart_clock()

    def _restart_clock(self) -> None:
        self._since, self._steps, self._samples = time.monotonic(), 0, 0

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        """Advance, and log the speed; validations and rollouts do not count."""
        if self._bar is not None:
            self._bar.advance()
        self._steps += 1
        self._samples += len(batch.state) * trainer.world_size
        seconds = max(time.monotonic() - self._since, 1e-9)
        speed = {"speed/steps_per_second": self._steps / seconds, "speed/samples_per_second": self._samples / seconds}
        pl_module.log_dict(speed, on_step=True, on_epoch=False)
        if self._steps >= trainer.log_every_n_steps:  # type: ignore[attr-defined]
            self._restart_clock()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Begin the clock of an epoch with its first batch at hand."""
        if batch_idx == 0:
            self._restart_clock()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._bar is None or trainer.sanity_checking or not trainer.is_global_zero:
            return
        values = [f"{name} {trainer.callback_metrics[f'val/{name}']:.4f}" for name in _SAID]
        total, step = int(trainer.estimated_stepping_batches), trainer.global_step
        began, first = self._start
        left = (time.monotonic() - began) / max(1, step - first) * (total - step)
        self._bar.message(f"step {step}/{total}  val {'  '.join(values)}  {left / 60:.1f} min left")

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Close the bar, so that the message stands alone."""
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.__exit__(None, None, None)
            self._bar = None
