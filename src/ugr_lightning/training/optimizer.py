"""What is trained of a policy, by which optimiser."""

from typing import Any, NamedTuple

import torch
from torch import nn
from torch.optim import AdamW, Optimizer

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.models.transformer import DecoderLayer, EncoderLayer

LAYERS = (EncoderLayer, DecoderLayer, nn.TransformerEncoderLayer, nn.TransformerDecoderLayer)
"""Ours, and torch's in a policy of a user's own."""
SEEING = ("backbone", "finder")
"""Words in the names of the parameters that see: the backbone and the keyframes' maps."""


class Parts(NamedTuple):
    """What is trained of a policy, each part at a rate of its own.

    Args:
        acting: all that is in no other part.
        seeing: the backbone and the keyframes' maps.
        mixing: the matrices of transformer layers that do not see, if they are Muon's.
    """

    acting: list[nn.Parameter]
    seeing: list[nn.Parameter]
    mixing: list[nn.Parameter]


def parts_of(policy: ChunkPolicy, *, muon: bool) -> Parts:
    """Divide what is trained of a policy.

    Args:
        policy: whose frozen parameters are left out.
        muon: whether the matrices of transformer layers are a part of their own.
    """
    layers = [module for module in policy.modules() if isinstance(module, LAYERS)] if muon else []
    matrices = {id(parameter) for layer in layers for parameter in layer.parameters() if parameter.dim() == 2}
    parts = Parts([], [], [])
    for name, parameter in policy.named_parameters():
        if parameter.requires_grad:
            acts = parts.mixing if id(parameter) in matrices else parts.acting
            (parts.seeing if any(word in name for word in SEEING) else acts).append(parameter)
    return parts


class MuonAndAdamW(Optimizer):
    """Muon and AdamW as one optimiser, which is what Lightning's own loop, its clipping and its checkpoints take.

    Muon's steps are scaled to be as large as AdamW's are, and it has no schedule or weight decay of its own.

    Args:
        matrices: 2-d parameters for Muon.
        rate: its step size.
        others: groups of parameters for AdamW, with their rates; they come first in `param_groups`.
        weight_decay: of all groups.
        settings: AdamW's.
    """

    def __init__(
        self,
        matrices: list[nn.Parameter],
        rate: float,
        others: list[dict[str, Any]],
        *,
        weight_decay: float,
        **settings: Any,
    ) -> None:
        self.parts: tuple[Optimizer, ...] = (
            AdamW(others, weight_decay=weight_decay, **settings),
            torch.optim.Muon(matrices, rate, weight_decay, adjust_lr_fn="match_rms_adamw"),
        )
        super().__init__([group for part in self.parts for group in part.param_groups], {})
        self._share()

    def _share(self) -> None:
        """Let both work on the groups and the state that are read, changed and saved here."""
        groups = iter(self.param_groups)
        for part in self.parts:
            part.param_groups = [next(groups) for _ in part.param_groups]
            part.state = self.state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._share()

    def step(self, closure: Any = None) -> Any:
        """Take one step with each."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self.parts:
            part.step()
        return loss
