"""Which checkpoint files a run keeps: the latest state, and the best by two measures."""

import difflib
import math
import os
import shutil
from functools import partial
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

from ugr_lightning.errors import ConfigError
from ugr_lightning.system.files import publish, remove_unfinished
from ugr_lightning.training.runs import FILES

LAST, BEST, BEST_LOSS = FILES["last"], FILES["best"], FILES["best_loss"]
_LARGER_IS_BETTER = ("success", "recall", "spearman")


class PolicyCheckpoints(Checkpoint):
    """Writes `last.ckpt` after each validated epoch, and `policy_best*.ckpt` when that epoch was the best so far.

    Files are written at epoch boundaries only, where resuming is exact; the state is serialised once and linked.

    Args:
        monitor: logged value that `policy_best.ckpt` follows.
        mode: whether the smaller (`min`) or the larger (`max`) value of `monitor` is better; null knows: the larger of
            a success, a recall or a correlation, the smaller of everything else.
    """

    def __init__(self, monitor: str = "val/action_error", mode: Literal["min", "max"] | None = None) -> None:
        larger = any(word in monitor for word in _LARGER_IS_BETTER)
        self.monitor, self.mode = monitor, mode or ("max" if larger else "min")
        self.best: dict[str, float] = {}
        self._validated = self._epoch_ends = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Forget best values whose files are not here: a run that goes on from another run's begins its own."""
        folder = Path(trainer.log_dir or trainer.default_root_dir)
        self.best = {name: value for name, value in self.best.items() if (folder / name).is_file()}
        if trainer.is_global_zero:
            for name in (*FILES.values(), "config.yaml", "metrics.csv"):
                remove_unfinished(folder, name)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._validated = not trainer.sanity_checking

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save at the epoch's boundary.

        Raises:
            ConfigError: `monitor` is not among what the validation has logged.
        """
        done = trainer.global_step == trainer.max_steps or trainer.current_epoch + 1 == trainer.max_epochs
        if trainer.fast_dev_run or not (self._validated or done):  # type: ignore[attr-defined]
            return
        better = [name for name, key, sign in self._rules() if self._improves(trainer, name, key, sign)]
        folder = Path(trainer.log_dir or trainer.default_root_dir)
        self._epoch_ends = True
        trainer.save_checkpoint(folder / LAST, weights_only=False)  # with the optimiser's state
        self._epoch_ends = False
        if trainer.is_global_zero:
            for name in better:
                publish(folder / name, partial(_link, folder / LAST))
        if self._validated:
            self._check_monitor(trainer)
        self._validated = False

    def _check_monitor(self, trainer: Trainer) -> None:
        known = sorted(trainer.callback_metrics)
        if self.monitor in known or self.monitor.startswith("rollout/"):  # rollouts may be rarer than validations
            return
        near = difflib.get_close_matches(self.monitor, known, n=3)
        fix = f"Did you mean {' or '.join(near)}?" if near else f"Logged are {', '.join(known)}."
        fix += " `--checkpoint last` goes on from here."
        raise ConfigError("checkpoints.monitor", "a value that is logged", self.monitor, fix)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Store the loops as they stand between two epochs, or between two steps.

        Lightning counts an epoch as complete only after its callbacks have saved. With `max_steps` it would go through
        the end of this epoch once more when it resumes, and all that depends on the epoch's number would be one ahead.
        In the middle of an epoch, a batch that was fetched and not trained on does not count.
        """
        loop = checkpoint["loops"]["fit_loop"]
        batches = loop["epoch_loop.batch_progress"]
        trained = batches["current"]["processed"] == batches["current"]["ready"]
        for count in (batches["current"], batches["total"]):
            count.update(dict.fromkeys(count, count["processed"]))
        if self._epoch_ends or (batches["is_last_batch"] and trained):
            for count in loop["epoch_progress"].values():
                count.update(dict.fromkeys(count, count["started"]))
            batches["current"] = dict.fromkeys(batches["current"], 0)
        batches["is_last_batch"] = False

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
        return {"best": dict(self.best), "monitor": [self.mode, self.monitor]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best values, except of a value that is followed no longer."""
        self.best = dict(state_dict["best"])
        if state_dict.get("monitor", [self.mode, self.monitor]) != [self.mode, self.monitor]:
            self.best.pop(BEST, None)


def _link(source: Path, target: Path) -> None:
    """Let `target` be the same file."""
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)  # `last.ckpt` is always replaced, never rewritten, so a link to it is a copy
    except OSError:  # a file system without links
        shutil.copyfile(source, target)
