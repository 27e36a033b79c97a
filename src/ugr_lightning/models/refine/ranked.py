"""Selectors that refine a fixed share of the chunk: the steps that some score puts highest."""

import math
from abc import abstractmethod

import torch
from torch import Tensor

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.selector import Selector


class Ranked(Selector):
    """Refines the floor(ratio K) steps with the highest score; of equal ones, the earlier.

    Args:
        ratio: share of the chunk that is refined, rho in the paper.

    Source: paper, section III-B. The count is that of its text, 15 of 50; its Eq. (5), an inequality on an order
        statistic, picks 16.
    """

    def __init__(self, ratio: float = 0.3) -> None:
        super().__init__()
        if not 0 < ratio <= 1:
            where = f"{type(self).__name__}.ratio"
            raise ConfigError(where, "a share above 0 and up to 1", ratio, "The paper's is 0.3.")
        self.ratio = ratio

    @abstractmethod
    def scores(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        """The score of each step, (B, K) or, where it does not depend on the sample, (K,); see `select`."""

    def budget(self, chunk_length: int) -> int:
        budget = math.floor(self.ratio * chunk_length + 1e-9)  # 0.3 * 50 must be 15, whatever its rounding
        if budget < 1:
            where = f"{type(self).__name__}.ratio"
            raise ConfigError(where, f"at least one of {chunk_length} steps", self.ratio, "Raise the ratio.")
        return budget

    def select(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        scores = self.scores(log_variance, valid, training).expand(valid.shape)  # (B, K)
        return highest(scores, valid, self.budget(valid.shape[1]))


def highest(scores: Tensor, valid: Tensor, count: int | Tensor) -> Tensor:
    """The steps with the highest score; of equal ones, the earlier.

    Args:
        scores: (B, K).
        valid: (B, K) bool; of a sample with fewer valid steps than are asked for, these are chosen.
        count: how many steps of every sample, or (B, 1) of each.

    Returns:
        (B, K) bool.
    """
    ranking = scores.masked_fill(~valid, -torch.inf).argsort(dim=1, descending=True, stable=True)  # ties: lower k
    return (ranking.argsort(dim=1) < count) & valid
