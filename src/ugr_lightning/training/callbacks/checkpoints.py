"""Which checkpoint files a run keeps: the latest state, and the best by two measures."""

import math
import os
import shutil
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

LAST, BEST, BEST_LOSS = "last.ckpt", "policy_best.ckpt", "policy_best_loss.ckpt"


class PolicyCheckpoints(Checkpoint):
    """Writes `last.ckpt` after each validated epoch, and `policy_best*.ckpt` when that epoch was the best so far.

    Files are written at epoch boundaries only, where resuming is exact; the state is serialised once and linked.

    Args:
        monitor: logged value that `policy_best.ckpt` follows.
        mode: whether the smaller (`min`) or the larger (`max`) value of `monitor` is better.
    """

    def __init__(self, monitor: str = "val/action_error", mode: str = "min") -> None:
        self.monitor, self.mode = monitor, mode
        self.best: dict[str, float] = {}
        self._validated = False

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember that fresh values are there."""
        self._validated = not trainer.sanity_checking

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save at the epoch's boundary."""
        done = trainer.global_step == trainer.max_steps or trainer.current_epoch + 1 == trainer.max_epochs
        if trainer.fast_dev_run or not (self._validated or done):  # type: ignore[attr-defined]
            return
        better = [name for name, key, sign in self._rules() if self._improves(trainer, name, key, sign)]
        folder = Path(trainer.log_dir or trainer.default_root_dir)
        trainer.save_checkpoint(folder / LAST, weights_only=False)  # with the optimiser's state
        self._validated = False
        if trainer.is_global_zero:
            for name in better:
                _link(folder / LAST, folder / name)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Store the loops as they stand at the beginning of the next epoch.

        Lightning counts an epoch as complete only after its callbacks have saved. With `max_steps` it would go through
        the end of this epoch once more when it resumes, and all that depends on the epoch's number would be one ahead.
        """
        loop = checkpoint["loops"]["fit_loop"]
        for count in loop["epoch_progress"].values():
            count["completed"] = count["processed"]
        batches = loop["epoch_loop.batch_progress"]
        batches["is_last_batch"] = False
        batches["current"] = dict.fromkeys(batches["current"], 0)

    def _rules(self) -> tuple[tuple[str, str, int], ...]:
        return (BEST, self.monitor, 1 if self.mode == "min" else -1), (BEST_LOSS, "val/loss", 1)

    def _improves(self, trainer: Trainer, name: str, key: str, sign: int) -> bool:
        if not self._validated or key not in trainer.callback_metrics:
            return False
        value = float(trainer.callback_metrics[key])
        if math.isnan(value) or (name in self.best and sign * value >= sign * self.best[name]):
            return False
        self.best[name] = value
        return True

    def state_dict(self) -> dict[str, Any]:
        """The best values so far."""
        return {"best": dict(self.best)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best values."""
        self.best = dict(state_dict["best"])


def _link(source: Path, target: Path) -> None:
    """Let `target` be the same file, replacing what was there in one step."""
    aside = target.with_name(target.name + ".partial")
    aside.unlink(missing_ok=True)
    try:
        os.link(source, aside)  # `last.ckpt` is always replaced, never rewritten, so a link to it is a copy
    except OSError:  # a file system without links
        shutil.copyfile(source, aside)
    os.replace(aside, target)
