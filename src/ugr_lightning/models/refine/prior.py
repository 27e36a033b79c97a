"""Control: refine the positions that are worst on average, whatever the input."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.ranked import Ranked
from ugr_lightning.system.records import parse_json

FIX = "`ugr analyze` on a trained policy writes `prior.json`: its mean error by position on the training episodes."


class Prior(Ranked):
    """Refines the floor(ratio K) positions with the highest static error: what s_k has to know more than.

    Args:
        ratio: share of the chunk that is refined.
        file: JSON list of K errors, such as the `prior.json` that `ugr analyze` writes.
        errors: the same list itself, in place of a file.
    """

    def __init__(self, ratio: float = 0.3, file: str | None = None, errors: Sequence[float] | None = None) -> None:
        super().__init__(ratio)
        if (file is None) == (errors is None):
            raise ConfigError("Prior", "either `file` or `errors`", "both" if file else "neither", FIX)
        self.errors = list(errors) if file is None and errors is not None else _read(Path(str(file)))

    def blueprint(self) -> dict[str, Any]:
        """The class and its arguments with the numbers in place of their file: a checkpoint is complete in itself."""
        recorded = super().blueprint()
        return {**recorded, "init_args": {**recorded["init_args"], "file": None, "errors": list(self.errors)}}

    def budget(self, chunk_length: int) -> int:
        if len(self.errors) != chunk_length:
            raise ConfigError("Prior", f"one error for each of {chunk_length} positions", len(self.errors), FIX)
        return super().budget(chunk_length)

    def scores(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        """The static errors, (K,)."""
        return torch.tensor(self.errors).to(valid.device)


def _read(path: Path) -> list[float]:
    try:
        found = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ConfigError(f"Prior.file {path}", "a JSON list of numbers", error, FIX) from error
    if not isinstance(found, list) or not all(type(item) in (int, float) for item in found):
        raise ConfigError(f"Prior.file {path}", "a JSON list of numbers", str(found)[:80], FIX)
    return [float(item) for item in found]
