"""Control: refine steps scattered over the chunk at random, as many as uncertainty would."""

import torch
from torch import Tensor

from ugr_lightning.models.refine.ranked import Ranked


class Scattered(Ranked):
    """Refines floor(ratio K) steps drawn anew for each sample in training, and one fixed draw of them at run time.

    Args:
        ratio: share of the chunk that is refined.
        seed: of the draw that is used at run time, where a policy has no randomness.
    """

    def __init__(self, ratio: float = 0.3, seed: int = 0) -> None:
        super().__init__(ratio)
        self.seed = seed

    def scores(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        """Random numbers, (B, K) in training and (K,) at run time."""
        if training:
            return torch.rand(valid.shape, device=valid.device)
        return torch.rand(valid.shape[1], generator=torch.Generator().manual_seed(self.seed)).to(valid.device)
