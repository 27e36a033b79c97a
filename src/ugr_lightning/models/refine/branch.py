"""The residual branch: what correction a step would receive, dA in A_1 = A_0 + m * dA."""

import torch
from torch import Tensor, nn


class ResidualBranch(nn.Module):
    """Predicts a correction from the coarse hidden states and the coarse actions, of each step by itself.

    Its last layer starts at zero, so that training starts at the coarse policy.

    Args:
        dim: D.
        action_dim: A.

    Source: docs/paper.md; the paper does not say what the branch is.
    """

    def __init__(self, dim: int, action_dim: int) -> None:
        super().__init__()
        self.action_proj = nn.Linear(action_dim, dim)
        self.mlp = nn.Sequential(nn.Linear(dim, dim), nn.GELU())
        self.head = nn.Linear(dim, action_dim)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, hidden: Tensor, coarse: Tensor) -> Tensor:
        """Corrections of all steps.

        Args:
            hidden: (B, K, D) coarse hidden states.
            coarse: (B, K, A) coarse actions, normalised.

        Returns:
            (B, K, A) float32.
        """
        correction: Tensor = self.head(self.mlp(hidden + self.action_proj(coarse))).float()
        return correction

    def at(self, chosen: Tensor, budget: int, hidden: Tensor, coarse: Tensor) -> Tensor:
        """Corrections of the chosen steps only, zero elsewhere.

        Args:
            chosen: (B, K) bool, exactly `budget` True in each row.
            budget: M.
            hidden: (B, K, D).
            coarse: (B, K, A).

        Returns:
            (B, K, A) float32.
        """
        index = chosen.int().argsort(dim=1, descending=True, stable=True)[:, :budget, None]  # (B, M, 1)
        hidden = hidden.gather(1, index.expand(-1, -1, hidden.shape[2]))  # (B, M, D)
        picked = coarse.gather(1, index.expand(-1, -1, coarse.shape[2]))  # (B, M, A)
        correction = self(hidden, picked)  # (B, M, A)
        return torch.zeros_like(coarse).scatter(1, index.expand_as(correction), correction)  # (B, K, A)
