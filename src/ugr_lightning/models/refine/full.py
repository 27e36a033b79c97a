"""Full refinement: every step."""

from torch import Tensor

from ugr_lightning.models.refine.selector import Selector


class Full(Selector):
    """Refines every step, m = 1."""

    def budget(self, chunk_length: int) -> int:
        return chunk_length

    def select(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        return valid.clone()  # (B, K)
