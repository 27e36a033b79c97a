"""Uncertainty-guided refinement: the steps the policy is least sure of. The method of the paper."""

from torch import Tensor

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.ranked import Ranked


class Uncertainty(Ranked):
    """Refines the floor(ratio K) steps with the highest predicted log-variance; of equal ones, the earlier.

    Args:
        ratio: share of the chunk that is refined, rho in the paper.

    Source: paper, Eq. (4) and (5).
    """

    needs_uncertainty = True

    def scores(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        if log_variance is None:
            raise ConfigError("Uncertainty", "a log-variance per step", "none", "Build the uncertainty head.")
        return log_variance
