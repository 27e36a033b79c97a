"""A training that is asked to end finishes its step and leaves a checkpoint to go on from."""

import os
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from ugr_lightning.system.signals import Stopped, handled
from ugr_lightning.training.callbacks.checkpoints import LAST

WAITS = b"Stops when this validation is written; once more stops at once.\n"


class OrderlyStop(Callback):
    """Writes `last.ckpt` when SIGINT, SIGTERM or SIGHUP ends the training, also before the first validation.

    A signal waits for the end of the step, because half a step cannot be gone on from, and for that of an epoch's last
    validation, which would not be made again: what it found and the best checkpoint are written first. A second one
    does not wait. It has to come after `WeightAverage` and before callbacks that take long at a step's end. Of a
    training in several processes the checkpoint of the last validated epoch stays.

    Attributes:
        asked: the signal that has come, if one has.
    """

    def __init__(self) -> None:
        self.asked: int | None = None
        self._handlers = ExitStack()
        self._in_step = self._in_validation = False
        self._first_step = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take over the signals; Lightning's own handler would end the process with 0."""
        self._first_step = trainer.global_step
        if trainer.world_size == 1:
            self._handlers.enter_context(handled(self._ask))

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if not (self._in_step or self._in_validation) or self.asked is not None:
            raise Stopped(number)
        self.asked = number
        if self._in_validation:
            os.write(2, WAITS)  # `print` may be at work already

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """From here on a signal waits until the checkpoints of the epoch are written, if this is its end."""
        self._in_validation = trainer.fit_loop.epoch_loop.batch_progress.is_last_batch and not trainer.sanity_checking

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The epoch before has left its checkpoints."""
        if self._in_validation and self.asked is not None:
            self._first_step = trainer.global_step  # `last.ckpt` is of this step already
            raise Stopped(self.asked, _note(trainer))
        self._in_validation = False

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """From here on a signal waits."""
        self._in_step = True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """The step is complete, unless gradients are still being gathered for it."""
        if trainer.fit_loop.epoch_loop._should_accumulate():
            return
        self._in_step = False
        if self.asked is not None:
            raise Stopped(self.asked)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Leave a checkpoint where the state is that between two steps."""
        self._handlers.close()
        if not isinstance(exception, Stopped):
            return
        self.asked = int(exception.signal)
        between = not self._in_step and trainer.world_size == 1 and not trainer.fast_dev_run  # type: ignore[attr-defined]
        if between and trainer.global_step > self._first_step:
            trainer.save_checkpoint(Path(trainer.log_dir or trainer.default_root_dir) / LAST, weights_only=False)
            exception.note = _note(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._handlers.close()


def _note(trainer: Trainer) -> str:
    return f"after step {trainer.global_step}; `--checkpoint last` goes on from there"
