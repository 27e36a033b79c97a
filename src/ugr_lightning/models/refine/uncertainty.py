"""Uncertainty-guided refinement: the steps the policy is least sure of. The method of the paper."""

import math

import torch
from torch import Tensor

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.selector import Selector


class Uncertainty(Selector):
    """Refines the floor(ratio K) steps with the highest predicted log-variance; of equal ones, the earlier.

    Args:
        ratio: share of the chunk that is refined, rho in the paper.

    Source: PAPER, uncertainty-guided sparse refinement. The count is that of its text, 15 of 50; its formula, an
        inequality on an order statistic, picks 16 (FACTS 4.6).
    """

    needs_uncertainty = True

    def __init__(self, ratio: float = 0.3) -> None:
        super().__init__()
        if not 0 < ratio <= 1:
            raise ConfigError("Uncertainty.ratio", "a share above 0 and up to 1", ratio, "The paper's is 0.3.")
        self.ratio = ratio

    def budget(self, chunk_length: int) -> int:
        """floor(rho K)."""
        budget = math.floor(self.ratio * chunk_length + 1e-9)  # 0.3 * 50 must be 15, whatever its rounding
        if budget < 1:
            fix = "Raise the ratio."
            raise ConfigError("Uncertainty.ratio", f"at least one of {chunk_length} steps", self.ratio, fix)
        return budget

    def select(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        """See `Selector.select`."""
        if log_variance is None:
            raise ConfigError("Uncertainty", "a log-variance per step", "none", "Build the uncertainty head.")
        scores = log_variance.masked_fill(~valid, -torch.inf)  # (B, K)
        ranking = scores.argsort(dim=1, descending=True, stable=True)  # stable, so that ties go to the lower k
        chosen = ranking[:, : self.budget(valid.shape[1])]  # (B, M)
        mask = torch.zeros_like(valid).scatter(1, chosen, True)  # (B, K)
        return mask & valid  # a chunk with fewer valid steps than M refines those it has
