"""TensorBoard and CSV logs in the folder of one run, which a resumed run continues."""

import csv
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.loggers.logger import rank_zero_experiment


def run_loggers(folder: Path, resumed_at: int | None = None) -> list[Logger]:
    """Both loggers of a run.

    Args:
        folder: `<root>/<name>/version_N`.
        resumed_at: optimiser step of the checkpoint that the run goes on from; later entries are superseded.
    """
    where: dict[str, Any] = {"save_dir": str(folder.parents[1]), "name": folder.parent.name, "version": folder.name}
    return [
        TensorBoardLogger(default_hp_metric=False, purge_step=resumed_at, **where),
        ContinuedCSVLogger(keep_steps=resumed_at or 0, **where),
    ]


class ContinuedCSVLogger(CSVLogger):
    """A CSV log that keeps the rows before the checkpoint; Lightning's own deletes the file of a run it finds.

    Args:
        keep_steps: rows of earlier steps than this stay.
        arguments: those of CSVLogger.
    """

    def __init__(self, keep_steps: int, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._keep_steps = keep_steps

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """The writer; when it is made, rows of before are written back."""
        if self._experiment is None:
            path = Path(self.log_dir) / "metrics.csv"
            kept = _rows(path, self._keep_steps)
            path.unlink(missing_ok=True)
            writer = super().experiment
            writer.metrics.extend(kept)
            writer.save()
        return self._experiment


def _rows(path: Path, before_step: int) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if int(row["step"]) < before_step]
    return [{key: value for key, value in row.items() if value != ""} for row in rows]
