"""Checkpoints of the original ACT code, and of RoboTwin's and XPolicyLab's copies of it, to ours and back."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ugr_lightning.bridges.act_layout import (
    Dialect,
    build,
    check_plain,
    checked_tensors,
    sizes_of,
    translate,
    untranslate,
)
from ugr_lightning.bridges.act_statistics import ActStatistics
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.precision import Precision

ORIGINAL = Dialect(
    name="the original",
    prefix="model.",
    names=(
        ("backbones.0.0.body.", "backbone."),
        ("input_proj.", "input_proj."),
        ("transformer.encoder.layers.", "encoder."),
        ("transformer.decoder.layers.", "decoder."),
        ("transformer.decoder.norm.", "decoder_norm."),
        ("encoder.layers.", "posterior.layers."),
        ("encoder_action_proj.", "posterior.action_proj."),
        ("encoder_joint_proj.", "posterior.joint_proj."),
        ("cls_embed.weight", "posterior.cls_embed"),
        ("latent_proj.", "posterior.latent_proj."),
        ("latent_out_proj.", "latent_out_proj."),
        ("input_proj_robot_state.", "state_proj."),
        ("query_embed.weight", "query_embed"),
        ("additional_pos_embed.weight", "additional_pos_embed"),
        ("action_head.", "action_head."),
    ),
    position_table="pos_table",
    first_layer_only=True,
)
DEAD = ("is_pad_head.",)
LAYERS = 7  # of its decoder
EXTRA = "original_act"
"""Entry of a checkpoint that keeps what our policy has no place for, so that it can go back."""


class OriginalCheckpoint(NamedTuple):
    """A checkpoint as the original code writes it.

    Args:
        weights: its state dict, with the prefix `model.`.
        statistics: content of `dataset_stats.pkl`.
        notes: sentences about what was made up or left behind.
    """

    weights: dict[str, Tensor]
    statistics: ActStatistics
    notes: list[str]


def import_act(
    content: Mapping[str, Any],
    statistics: ActStatistics,
    *,
    cameras: Sequence[str] = CAMERAS,
    heads: int = 8,
    precision: Precision = "fp32",
    where: object = "checkpoint",
) -> tuple[ACT, dict[str, Any]]:
    """Make a policy of ours from a state dict of the original code.

    All sizes come from the shapes. The original reads its first decoder layer and has no place to say how many heads
    it has or which cameras it saw, and in which order does not matter to it.

    Args:
        content: what the file holds: a bare state dict, with the prefix `model.` or without.
        statistics: from `dataset_stats.pkl`.
        cameras: names of the cameras.
        heads: attention heads.
        precision: arithmetic of the trunk; `fp32` is the original's.
        where: the file, for messages.

    Returns:
        The policy, and what it has no place for, to be kept in the checkpoint under `EXTRA`.

    Raises:
        CheckpointError: not an ACT checkpoint, or statistics of other dimensions.
        ConfigError: a number of heads that does not divide the width.

    Source: tonyzhaozh/act@742c753, detr/models/detr_vae.py (names).
    """
    found, unused = translate(checked_tensors(content, where), ORIGINAL, where, DEAD)
    sizes = sizes_of(found, ORIGINAL, where)
    dead_layers = {name.split(".")[3] for name in unused if name.startswith("transformer.decoder.layers.")}
    sizes["decoder_layers"] += len(dead_layers)
    arguments = {
        **sizes,
        "heads": heads,
        "cameras": tuple(cameras),
        "decoder_readout": "first",
        "reconstruction": "l1",
        "precision": precision,
    }
    for part, dim in (("qpos", sizes["state_dim"]), ("action", sizes["action_dim"])):
        given = getattr(statistics, f"{part}_mean").numel()
        if given != dim:
            fix = "Give the `dataset_stats.pkl` that lies beside this checkpoint."
            raise CheckpointError(f"statistics of {where}: {part}_mean", f"{dim} numbers", given, fix)
    policy = build(found, arguments, ORIGINAL, where)
    set_normalisation(policy, *statistics[:4])
    return policy, {"unused": unused, "example_qpos": statistics.example_qpos}


def set_normalisation(
    policy: ACT, state_shift: Tensor, state_scale: Tensor, action_shift: Tensor, action_scale: Tensor
) -> None:
    """Store somebody else's normalisation as it is; ours would floor the standard deviations anew."""
    own = policy.normalizer
    own.state_shift.copy_(state_shift)
    own.state_scale.copy_(state_scale)
    own.action_shift.copy_(action_shift)
    own.action_scale.copy_(action_scale)
    own.fitted.fill_(True)


def export_act(
    policy: ACT, extra: Mapping[str, Any] | None = None, *, drop_refinement: bool = False
) -> OriginalCheckpoint:
    """Write a policy of ours as the original code would; decoder layers it never reads are copies of the first.

    Args:
        policy: plain ACT at the published structure.
        extra: what an import has kept under `EXTRA`; it returns unchanged, in place of copies.
        drop_refinement: leave a refinement branch and an uncertainty head behind.

    Raises:
        ConfigError: the original code has no place for something that the policy has.
    """
    check_plain(policy, "act", drop_refinement)
    given = policy.blueprint()["init_args"]
    if len(policy.decoder) > 1:
        got = f"a policy that reads layer {len(policy.decoder)}"
        fix = "The original code reads its first decoder layer: train with `decoder_readout: first`."
        raise ConfigError("--to act: decoder_readout", "first", got, fix)
    if given["cvae_layers"] != given["encoder_layers"]:
        got = f"{given['cvae_layers']} and {given['encoder_layers']}"
        fix = "The original code has one setting for both."
        raise ConfigError("--to act", "as many layers in the CVAE encoder as in the encoder", got, fix)
    weights, notes = untranslate(policy, ORIGINAL), []
    if policy.branch is not None or policy.uncertainty_head is not None:
        notes.append("the refinement branch and the uncertainty head were left behind")
    if extra is not None:
        weights |= {ORIGINAL.prefix + name: value for name, value in extra["unused"].items()}
    else:
        weights |= _unread(weights, policy)
        notes.append(f"decoder layers 2 to {LAYERS}, which it never reads, are copies of the first")
        notes.append("is_pad_head, which it never reads, is zero")
    own = policy.normalizer
    example = None if extra is None else extra["example_qpos"]
    if example is None:
        example = own.state_shift[None]
        notes.append("example_qpos, which nothing depends on, is the mean state")
    numbers = own.state_shift, own.state_scale, own.action_shift, own.action_scale, example
    return OriginalCheckpoint(weights, ActStatistics(*(value.detach().cpu().clone() for value in numbers)), notes)


def _unread(weights: Mapping[str, Tensor], policy: ACT) -> dict[str, Tensor]:
    """Tensors that the original code builds and never reads."""
    first = f"{ORIGINAL.prefix}transformer.decoder.layers.0."
    layer = {name.removeprefix(first): value for name, value in weights.items() if name.startswith(first)}
    copies = {
        f"{ORIGINAL.prefix}transformer.decoder.layers.{index}.{name}": value.clone()
        for index in range(1, LAYERS)
        for name, value in layer.items()
    }
    dim = policy.query_embed.shape[1]
    head = {"is_pad_head.weight": torch.zeros(1, dim), "is_pad_head.bias": torch.zeros(1)}
    return copies | {ORIGINAL.prefix + name: value for name, value in head.items()}
