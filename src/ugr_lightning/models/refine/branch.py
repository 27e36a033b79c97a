"""The residual branch: what correction a step would receive, dA in A_1 = A_0 + m * dA."""

from typing import Literal

import torch
from torch import Tensor, nn

from ugr_lightning.models.transformer import DecoderLayer

BranchName = Literal["mlp", "decoder"]


class ResidualBranch(nn.Module):
    """Predicts a correction from the coarse hidden states and the coarse actions.

    Its last layer starts at zero, so that training starts at the coarse policy.

    Args:
        kind: `mlp` corrects each step by itself; `decoder` is one more decoder layer with
            cross-attention to the shared memory.
        dim, heads, feedforward, dropout: sizes of the trunk.
        action_dim: A.

    Source: docs/paper.md; the paper does not say what the branch is.
    """

    def __init__(
        self, kind: BranchName, dim: int, heads: int, feedforward: int, dropout: float, action_dim: int
    ) -> None:
        super().__init__()
        self.action_proj = nn.Linear(action_dim, dim)
        self.layer = DecoderLayer(dim, heads, feedforward, dropout) if kind == "decoder" else None
        self.mlp = nn.Sequential(nn.Linear(dim, dim), nn.GELU()) if kind != "decoder" else None
        self.head = nn.Linear(dim, action_dim)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    @property
    def stepwise(self) -> bool:
        """Whether a step's correction depends on that step alone, so that any subset may be computed."""
        return self.mlp is not None

    def forward(
        self, hidden: Tensor, coarse: Tensor, query_position: Tensor, memory: tuple[Tensor, Tensor] | None
    ) -> Tensor:
        """Corrections of all steps.

        Args:
            hidden: (B, K, D) coarse hidden states.
            coarse: (B, K, A) coarse actions, normalised.
            query_position: (K, D).
            memory: (B, N, D) without and with positions added; a stepwise branch needs none.

        Returns:
            (B, K, A) float32.
        """
        x = hidden + self.action_proj(coarse)  # (B, K, D)
        if self.mlp is not None:
            x = self.mlp(x)
        elif self.layer is not None and memory is not None:
            x = self.layer(x, query_position, *memory)
        correction: Tensor = self.head(x).float()
        return correction

    def at(self, chosen: Tensor, budget: int, hidden: Tensor, coarse: Tensor) -> Tensor:
        """Corrections of the chosen steps only, zero elsewhere; for a stepwise branch.

        Args:
            chosen: (B, K) bool, exactly `budget` True in each row.
            budget: M.
            hidden: (B, K, D).
            coarse: (B, K, A).

        Returns:
            (B, K, A) float32.
        """
        assert self.mlp is not None
        index = chosen.int().argsort(dim=1, descending=True, stable=True)[:, :budget, None]  # (B, M, 1)
        hidden = hidden.gather(1, index.expand(-1, -1, hidden.shape[2]))  # (B, M, D)
        picked = coarse.gather(1, index.expand(-1, -1, coarse.shape[2]))  # (B, M, A)
        correction = self.head(self.mlp(hidden + self.action_proj(picked))).float()  # (B, M, A)
        return torch.zeros_like(coarse).scatter(1, index.expand_as(correction), correction)  # (B, K, A)
