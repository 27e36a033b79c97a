"""Refinement towards what is seen: how far each tool of a coarse chunk is beside the place where it will grip next."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from ugr_lightning.contract import Batch
from ugr_lightning.embodiment import BASE_X, FOREARM, SHOULDER_HEIGHT, TOOL_LENGTH, UPPER_ARM
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.keyframes import inverse_matrix
from ugr_lightning.models.losses import mean_over

TURNS_ABOUT = (2, 1, 1, 0, 1, 0)
"""The axis that each joint turns about, of the frame that it stands in."""
ARMS, JOINTS = 2, len(TURNS_ABOUT)
DAMPING = 0.02
"""What a tool is away, m, where moving the joints costs as much as staying: near singular postures little is asked."""
NEARNESS = (0.02, 0.1)
"""Scales on which a step is told how near its tool is to the place, m."""
SOON = 10.0
"""Scale on which a step is told when its tool is nearest, control steps."""
FARTHEST = 0.3
"""Most that a joint is asked to move, rad."""
OTHER_ARMS = 0.1
"""Tools so far, m, beside those of a demonstration are of other arms; a press into a clock commands 0.018 m more than
is reached."""


class Reach(nn.Module):
    """Moves the joints of coarse actions so that the tools come to where their next keyframes are seen.

    The motion is geometry: the least one of the joints that moves the tool there. Which share of it a step wants, all
    at the keyframe and nothing far from it, is learned, by how far the tools then are from the demonstrated ones; it
    starts at none. An error of joints would not do: other joints than those that were wrong can mend a tool's place.

    Args:
        dim: D, width of a hidden state.

    Source: docs/recipe.md (refined towards what is seen).
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        told = ARMS * (len(NEARNESS) + 1)
        self.share = nn.Sequential(nn.Linear(dim + told, 64), nn.GELU(), nn.Linear(64, ARMS))
        last = self.share[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, hidden: Tensor, coarse: Tensor, points: Tensor) -> Tensor:
        """How the joints move.

        Args:
            hidden: (B, K, D) float32 coarse hidden states.
            coarse: (B, K, A) coarse actions, robot units.
            points: (B, 2, 3) where the tools' next keyframes are seen, m.

        Returns:
            (B, K, A) robot units, zero for the grippers.
        """
        tool, moves = tools_of(_joints(coarse))  # (B, K, 2, 3), (B, K, 2, 3, 6)
        share, beside = self._shares(hidden, tool, points)
        damped = moves @ moves.mT + DAMPING**2 * torch.eye(3, device=moves.device)
        motion = moves.mT @ inverse_matrix(damped) @ (share[..., None] * beside)[..., None]  # (B, K, 2, 6, 1)
        return functional.pad(motion.squeeze(-1).clamp(-FARTHEST, FARTHEST), (0, 1)).flatten(2)

    def lesson(self, hidden: Tensor, coarse: Tensor, points: Tensor, shown: Tensor, valid: Tensor) -> Tensor:
        """How far the moved tools are from the demonstrated ones, in units of 2 cm, to first order.

        Args:
            hidden, coarse, points: as in `forward`.
            shown: (B, K, A) demonstrated actions, robot units.
            valid: (B, K) bool, the steps that count.
        """
        tool, _ = tools_of(_joints(coarse))
        share, beside = self._shares(hidden.detach(), tool, points)
        missed = tools_of(_joints(shown))[0] - tool  # (B, K, 2, 3)
        left = (missed - share[..., None] * beside).norm(dim=-1).mean(-1)  # (B, K)
        return mean_over(left, valid) / NEARNESS[0]

    def _shares(self, hidden: Tensor, tool: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Which share of its way each tool goes, (B, K, 2), and that way, (B, K, 2, 3) m."""
        beside = _in_base(points)[:, None] - tool
        distance = beside.norm(dim=-1)  # (B, K, 2)
        step = torch.arange(tool.shape[1], device=tool.device)[:, None]  # (K, 1)
        until = (distance.argmin(1, keepdim=True) - step) / SOON  # (B, K, 2)
        told = torch.cat([*((-distance / near).exp() for near in NEARNESS), until.tanh()], -1)  # (B, K, 6)
        share: Tensor = self.share(torch.cat([hidden, told], -1))
        return share, beside


def tools_of(joints: Tensor) -> tuple[Tensor, Tensor]:
    """Where ViperX 300s arms have their tools, and how these move with the joints.

    Args:
        joints: (..., 6) rad.

    Returns:
        (..., 3) m in the frame of the arm's base, and (..., 3, 6) m per rad.

    Source: docs/recipe.md (refined towards what is seen).
    """
    cos, sin = joints.cos(), joints.sin()
    frame = list(torch.eye(3, device=joints.device, dtype=joints.dtype).expand(*joints.shape[:-1], 3, 3).unbind(-2))
    place = joints.new_tensor([0, 0, SHOULDER_HEIGHT]).expand_as(frame[0])  # (..., 3)
    axes, places = [], []
    for joint, about in enumerate(TURNS_ABOUT):
        axes.append(frame[about])
        places.append(place)
        one, other = (about + 1) % 3, (about + 2) % 3  # the two axes of the frame that the joint turns
        c, s = cos[..., joint, None], sin[..., joint, None]
        frame[one], frame[other] = c * frame[one] + s * frame[other], c * frame[other] - s * frame[one]
        if joint == 1:
            place = place + UPPER_ARM[0] * frame[0] + UPPER_ARM[1] * frame[2]
        elif joint == 2:
            place = place + FOREARM * frame[0]
    tool = place + TOOL_LENGTH * frame[0]
    moves = [torch.linalg.cross(axis, tool - at) for axis, at in zip(axes, places, strict=True)]
    return tool, torch.stack(moves, -1)


def require_arms(batch: Batch) -> None:
    """Refuse demonstrations of other arms: their joints do not take the tools to where they say that the tools were.

    Args:
        batch: any demonstrated chunks, with keyframes; those that lie within their chunk are asked.

    Raises:
        ConfigError: they are of another robot.
    """
    assert batch.keyframes is not None
    position, _, delay = batch.keyframes
    commands = _joints(batch.actions)  # (B, K, 2, 6)
    last = (delay - 1).clamp(max=commands.shape[1] - 1)  # (B, 2), the command that brings the tool there
    shown, _ = tools_of(commands.gather(1, last[:, None, :, None].expand(-1, -1, -1, JOINTS))[:, 0])  # (B, 2, 3)
    beside = (_in_base(position) - shown).norm(dim=-1)[delay <= batch.valid.sum(1)[:, None]]  # (n,)
    if len(beside) and beside.median() > OTHER_ARMS:
        expected = f"tools where the joints of ViperX arms have them, within {OTHER_ARMS} m"
        fix = "Use `refine_branch: mlp`: the demonstrations are of another robot."
        raise ConfigError("refine_branch: reach", expected, f"{beside.median():.2f} m beside (median)", fix)


def _joints(actions: Tensor) -> Tensor:
    """(B, K, A) to the joints of both arms, (B, K, 2, 6)."""
    return actions.unflatten(-1, (ARMS, -1))[..., :JOINTS]


def _in_base(points: Tensor) -> Tensor:
    """Points of the world (B, 2, 3) in the frames of the bases of both arms, which face each other on the table."""
    base = points.new_tensor([[-BASE_X, 0, 0], [BASE_X, 0, 0]])
    return (points - base) * points.new_tensor([[1, 1, 1], [-1, -1, 1]])
