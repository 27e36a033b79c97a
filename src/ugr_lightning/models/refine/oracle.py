"""Ceiling: the steps whose true error is largest. Nothing that acts can know it."""

from torch import Tensor

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.ranked import Ranked


class Oracle(Ranked):
    """Chooses the floor(ratio K) steps with the highest true error, given in the place of the log-variance.

    For analysis of recorded episodes only; a policy built with it is refused.

    Args:
        ratio: share of the chunk that is chosen.
    """

    offline = True

    def scores(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        if log_variance is None:
            fix = "Use it as `ugr analyze --budgets` does, on recorded episodes."
            raise ConfigError("Oracle", "the true error of each step", "none: at run time nobody knows it", fix)
        return log_variance
