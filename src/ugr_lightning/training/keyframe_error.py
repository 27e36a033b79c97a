"""How far a predicted chunk misses, with each tool, the demonstrated place of its next keyframe."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchmetrics.aggregation import CatMetric

from ugr_lightning.contract import GRIPPERS, Batch
from ugr_lightning.sim.kinematics import Array, TcpPose
from ugr_lightning.sim.registry import robot_of

TRAVELS = 0.02
"""A tool that the demonstration brings to its keyframe from nearer than this, m, says nothing: it is there already."""

Forward = Callable[[Array], TcpPose]


class MedianMetric(CatMetric):
    """The median of everything it was given; NaN of nothing."""

    def compute(self) -> Tensor:
        values = super().compute()
        return values.median() if isinstance(values, Tensor) and values.numel() else torch.tensor(torch.nan)


def known_kinematics(data: Any) -> Forward | None:
    """How joints become tools, where data are recordings of a robot that we know; None elsewhere.

    Args:
        data: the data module.
    """
    return None if getattr(data, "elsewhere", True) else robot_of(data.task).forward


def event_errors(forward: Forward, actions: Tensor, batch: Batch) -> Tensor:
    """Distances between the tools of predicted and of demonstrated commands, at the step of each arm's next keyframe.

    Of keyframes that lie within the chunk, and whose tool travels at least `TRAVELS` to them in it.

    Args:
        forward: from the six joints of an arm to its tool.
        actions: (B, K, A) predicted, robot units.
        batch: the demonstrated chunks, with keyframes.

    Returns:
        (n,) float32, mm.
    """
    assert batch.keyframes is not None
    predicted, shown = actions.float().cpu().numpy(), batch.actions.float().cpu().numpy()  # (B, K, A) each
    within = (batch.keyframes.delay <= batch.valid.sum(1, keepdim=True)).cpu().numpy()  # (B, 2)
    last = batch.keyframes.delay.cpu().numpy() - 1  # (B, 2), the command that brings the tool there
    found = []
    for sample, arm in np.argwhere(within):
        joints, step = slice(GRIPPERS[arm] - 6, GRIPPERS[arm]), last[sample, arm]
        there = forward(shown[sample, step, joints]).position
        if np.linalg.norm(there - forward(shown[sample, 0, joints]).position) >= TRAVELS:
            found.append(np.linalg.norm(forward(predicted[sample, step, joints]).position - there))
    return 1000 * torch.tensor(np.array(found), dtype=torch.float32, device=actions.device)
