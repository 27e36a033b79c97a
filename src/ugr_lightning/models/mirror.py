"""The left-right mirror image of demonstrations of two equal arms that face each other across the plane x = 0."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ugr_lightning.contract import Batch, Keyframes, Statistics
from ugr_lightning.errors import ConfigError

ARM = 7
SIGNS = (-1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0)
"""What mirroring does to the joints of an arm: waist, forearm roll and wrist rotation turn the other way round."""


def check_mirror(cameras: Sequence[str], state_dim: int, action_dim: int) -> None:
    """Refuse a robot of which no mirror image is known.

    Args:
        cameras: names of the cameras.
        state_dim, action_dim: numbers in the state and in an action.

    Raises:
        ConfigError: other joints than those of two arms of seven, or one camera of a left and a right one.
    """
    fix = "Set the policy's `mirror` to 0."
    if (state_dim, action_dim) != (2 * ARM, 2 * ARM):
        got = f"{state_dim} and {action_dim} numbers"
        raise ConfigError("mirror", f"states and actions of two arms, {2 * ARM} numbers", got, fix)
    alone = [name for name in cameras if _other_side(name) not in cameras]
    if alone:
        raise ConfigError("mirror", f"{_other_side(alone[0])} beside {alone[0]}", "no such camera", fix)


def mirror_batch(batch: Batch, chosen: Tensor, cameras: Sequence[str]) -> Batch:
    """Replace some samples by their mirror images.

    Args:
        batch: samples of one observation step or of several.
        chosen: (B,) bool.
        cameras: names of the cameras; `left` and `right` change places.
    """
    partner = _partners(cameras).to(chosen.device)
    pixels = batch.images.movedim(-3, -1)  # (B, ..., V, H, W, 3), as they lie in memory
    images = _where(chosen, pixels.index_select(-4, partner).flip(-2), pixels).movedim(-1, -3)
    changed = {name: _where(chosen, mirror_joints(value), value) for name, value in
               (("state", batch.state), ("actions", batch.actions))}  # fmt: skip
    projection, keyframes = batch.projection, batch.keyframes
    if projection is not None:
        flip = projection.new_tensor([-1, 1, 1])  # u changes its sign, and so does x of the world
        turned = flip[:, None] * projection.index_select(-3, partner) * projection.new_tensor([-1, 1, 1, 1])
        projection = _where(chosen, turned, projection)
    if keyframes is not None:
        position = keyframes.position.flip(1) * keyframes.position.new_tensor([-1, 1, 1])
        axes = keyframes.axes.flip(1) * keyframes.axes.new_tensor([-1, 1, 1, 1, -1, -1])  # the tool stays right-handed
        mirrored = (position, axes, keyframes.delay.flip(1))
        keyframes = Keyframes(*(_where(chosen, new, old) for new, old in zip(mirrored, keyframes, strict=True)))
    return batch._replace(images=images, projection=projection, keyframes=keyframes, **changed)


def mirror_joints(vector: Tensor) -> Tensor:
    """Joints (..., 14) of the mirrored robot."""
    signs = vector.new_tensor(SIGNS)
    return torch.cat([vector[..., ARM:] * signs, vector[..., :ARM] * signs], dim=-1)


def mirrored_statistics(statistics: Statistics) -> Statistics:
    """Statistics of demonstrations together with their mirror images."""
    parts: dict[str, Tensor] = {}
    for name in ("state", "action"):
        mean, std, low, high = (getattr(statistics, f"{name}_{part}") for part in ("mean", "std", "min", "max"))
        ends = torch.stack([low, high, mirror_joints(low), mirror_joints(high)])  # (4, S)
        other = mirror_joints(mean)
        parts[f"{name}_mean"] = (mean + other) / 2
        parts[f"{name}_std"] = _pooled(std, mirror_joints(std), mean - other)
        parts[f"{name}_min"], parts[f"{name}_max"] = ends.amin(0), ends.amax(0)
    mean, std = statistics.keyframe_mean, statistics.keyframe_std
    if mean is not None and std is not None:
        other = mean.flip(0) * mean.new_tensor([-1, 1, 1])
        parts |= {"keyframe_mean": (mean + other) / 2, "keyframe_std": _pooled(std, std.flip(0), mean - other)}
    return Statistics(**{**statistics._asdict(), **parts})


def _pooled(std: Tensor, other: Tensor, apart: Tensor) -> Tensor:
    return ((std.square() + other.square()) / 2 + (apart / 2).square()).sqrt()


def _where(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(chosen.view(-1, *[1] * (old.dim() - 1)), new, old)


def _partners(cameras: Sequence[str]) -> Tensor:
    return torch.tensor([cameras.index(_other_side(name)) for name in cameras])


def _other_side(camera: str) -> str:
    swap = {"left": "right", "right": "left"}
    return "_".join(swap.get(word, word) for word in camera.split("_"))
