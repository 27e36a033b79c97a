"""Block refinement: a contiguous run of steps whose place does not depend on the input."""

import torch
from torch import Tensor

from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.selector import Selector


class Block(Selector):
    """Refines one block of steps: at a random place per sample in training, in the middle at run time.

    Args:
        length: steps in the block, B in the paper.

    Source: paper, section III-B; docs/paper.md for the place at test time, which the paper leaves open.
    """

    def __init__(self, length: int = 12) -> None:
        super().__init__()
        if length < 1:
            raise ConfigError("Block.length", "at least 1 step", length, "Give a positive number.")
        self.length = length

    def budget(self, chunk_length: int) -> int:
        if self.length > chunk_length:
            fix = "Shorten the block or lengthen the chunk."
            raise ConfigError("Block.length", f"at most the chunk length {chunk_length}", self.length, fix)
        return self.length

    def select(self, log_variance: Tensor | None, valid: Tensor, training: bool) -> Tensor:
        batch, steps = valid.shape
        places = steps - self.budget(steps) + 1
        if training:
            start = torch.randint(places, (batch, 1), device=valid.device)  # (B, 1), uniform over 0 .. K - length
        else:
            start = torch.full((batch, 1), (places - 1) // 2, device=valid.device)
        step = torch.arange(steps, device=valid.device)  # (K,)
        return (step >= start) & (step < start + self.length) & valid  # (B, K)
