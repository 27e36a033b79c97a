"""A training that is asked to end finishes its step and leaves a checkpoint to go on from."""

from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from ugr_lightning.system.signals import Stopped, handled
from ugr_lightning.training.callbacks.checkpoints import LAST


class OrderlyStop(Callback):
    """Writes `last.ckpt` when SIGINT, SIGTERM or SIGHUP ends the training, also before the first validation.

    A signal waits for the end of the step, because half a step cannot be gone on from; a second one does not wait. It
    has to come after `WeightAverage` and before callbacks that take long at a step's end. Of a training in several
    processes the checkpoint of the last validated epoch stays.
    """

    def __init__(self) -> None:
        self._handlers = ExitStack()
        self._asked: int | None = None
        self._in_step = False
        self._first_step = 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take over the signals; Lightning's own handler would end the process with 0."""
        self._first_step = trainer.global_step
        if trainer.world_size == 1:
            self._handlers.enter_context(handled(self._ask))

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if not self._in_step or self._asked is not None:
            raise Stopped(number)
        self._asked = number

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """From here on a signal waits."""
        self._in_step = True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """The step is complete, unless gradients are still being gathered for it."""
        if trainer.fit_loop.epoch_loop._should_accumulate():
            return
        self._in_step = False
        if self._asked is not None:
            raise Stopped(self._asked)

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Leave a checkpoint where the state is that between two steps."""
        self._handlers.close()
        if not isinstance(exception, Stopped):
            return
        self._asked = int(exception.signal)
        between = not self._in_step and trainer.world_size == 1 and not trainer.fast_dev_run  # type: ignore[attr-defined]
        if between and trainer.global_step > self._first_step:
            trainer.save_checkpoint(Path(trainer.log_dir or trainer.default_root_dir) / LAST, weights_only=False)
            exception.note = f"after step {trainer.global_step}; `--checkpoint last` goes on from there"

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._handlers.close()
