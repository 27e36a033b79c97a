"""ACT under other people's parameter names, translated to ours and back; sizes are read off the shapes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.transformer import sine_positions


@dataclass(frozen=True)
class Dialect:
    """How one project names the parameters of ACT.

    Args:
        name: whose names they are, for messages.
        prefix: what every name begins with.
        names: pairs (theirs, ours). One that ends with a dot is a module and stands for all names below it; the others
            are single tensors. An embedding of theirs may have one more leading axis of length 1 than our parameter.
        position_table: name of the table of sinusoids for the CVAE encoder, which we compute.
        first_layer_only: whether the network reads its first decoder layer, whatever there is behind it.
    """

    name: str
    prefix: str
    names: tuple[tuple[str, str], ...]
    position_table: str
    first_layer_only: bool

    def ours(self, name: str) -> str | None:
        """Our name for one of theirs, which is given without the prefix; None where we have none."""
        return _swap(name, self.names)

    def theirs(self, name: str) -> str | None:
        """Their name for one of ours, with the prefix; None where they have none."""
        found = _swap(name, [(ours, theirs) for theirs, ours in self.names])
        return None if found is None else self.prefix + found


def _swap(name: str, pairs: Sequence[tuple[str, str]]) -> str | None:
    for old, new in pairs:
        if name == old or (old.endswith(".") and name.startswith(old)):
            return new + name[len(old) :]
    return None


def checked_tensors(content: Mapping[str, Any], where: object, ignore: tuple[str, ...] = ()) -> dict[str, Tensor]:
    """The tensors of a state dict, once each is known to be what it claims.

    Args:
        content: what a file holds.
        where: the file, for messages.
        ignore: entries that begin with one of these are left out.

    Returns:
        float32 for floating-point entries; other kinds unchanged.

    Raises:
        CheckpointError: an entry that is no tensor, not finite, or claims more numbers than it stores.
    """
    found = {}
    for key, value in content.items():
        if str(key).startswith(ignore):
            continue
        fix = "Save the policy's `state_dict()`, and nothing else."
        if not isinstance(value, Tensor):
            raise CheckpointError(f"{where}: {key}", "a tensor", type(value).__name__, fix)
        if value.layout != torch.strided or value.is_complex() or value.is_quantized:
            raise CheckpointError(f"{where}: {key}", "a dense tensor of real numbers", value.dtype, fix)
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            got = f"shape {tuple(value.shape)} over {value.untyped_storage().nbytes()} bytes"
            raise CheckpointError(f"{where}: {key}", "a tensor that stores all its numbers", got, fix)
        if not value.is_meta and value.is_floating_point() and not value.isfinite().all():
            fix = "The training diverged or the file is damaged: use an earlier checkpoint."
            raise CheckpointError(f"{where}: {key}", "finite numbers", "a NaN or an infinity", fix)
        found[str(key)] = value.float() if value.is_floating_point() else value
    return found


def translate(
    weights: Mapping[str, Tensor], dialect: Dialect, where: object, dead: Sequence[str] = ()
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Give the tensors of a foreign checkpoint our names; every one of them is accounted for.

    Args:
        weights: by their names, with the prefix or without.
        dialect: whose names they are.
        where: the file, for messages.
        dead: beginnings of their names of what no output depends on.

    Returns:
        The tensors under our names, shaped as in `ACT`; and under theirs, without the prefix, those that no output
        depends on.

    Raises:
        CheckpointError: a tensor that is neither known nor dead, or a position table other than the usual one.
    """
    prefix = dialect.prefix if all(key.startswith(dialect.prefix) for key in weights) else ""
    found: dict[str, Tensor] = {}
    unused: dict[str, Tensor] = {}
    strangers = []
    for key, value in weights.items():
        name = key.removeprefix(prefix)
        ours = dialect.ours(name)
        layer = ours.split(".")[1] if ours is not None and ours.startswith("decoder.") else "0"
        if name == dialect.position_table:
            _check_positions(value, f"{where}: {key}")
        elif name.startswith(tuple(dead)) or (dialect.first_layer_only and layer != "0"):
            unused[name] = value
        elif ours is None:
            strangers.append(key)
        else:
            single = ours == "posterior.cls_embed" and value.dim() == 2 and value.shape[0] == 1
            found[ours] = value[0] if single else value
    if strangers:
        got = f"{len(strangers)} others: {', '.join(sorted(strangers)[:6])}"
        fix = "Only ACT with a ResNet-18 can be imported, not other policies and not changed networks."
        raise CheckpointError(where, f"the names of {dialect.name} ACT", got, fix)
    return found, unused


def _check_positions(table: Tensor, where: str) -> None:
    if table.dim() != 3 or table.shape[0] != 1:
        raise CheckpointError(where, "shape (1, 2 + K, D)", tuple(table.shape), "Use a checkpoint of ACT.")
    if not table.is_meta and not torch.allclose(table[0], sine_positions(*table.shape[1:]), atol=1e-4):
        fix = "Only the published network can be imported."
        raise CheckpointError(where, "the usual table of sinusoids", "another one", fix)


def sizes_of(weights: Mapping[str, Tensor], dialect: Dialect, where: object) -> dict[str, Any]:
    """Arguments of `ACT` that the shapes of its parameters decide.

    Args:
        weights: by our names.
        dialect: in whose names a missing one is reported.
        where: the file, for messages.

    Raises:
        CheckpointError: a tensor that every ACT has is missing, or has another number of axes.
    """

    def shape(name: str, axes: int) -> tuple[int, ...]:
        if name not in weights:
            fix = "Use the complete state dict of an ACT policy."
            raise CheckpointError(where, f"the tensor {dialect.theirs(name)}", "no such tensor", fix)
        if weights[name].dim() != axes:
            got = tuple(weights[name].shape)
            raise CheckpointError(f"{where}: {dialect.theirs(name)}", f"{axes} axes", got, "Use a checkpoint of ACT.")
        return tuple(weights[name].shape)

    chunk_length, dim = shape("query_embed", 2)
    return {
        "dim": dim,
        "chunk_length": chunk_length,
        "feedforward": shape("encoder.0.linear1.weight", 2)[0],
        "encoder_layers": _layers(weights, "encoder."),
        "decoder_layers": max(_layers(weights, "decoder."), 1),
        "cvae_layers": _layers(weights, "posterior.layers."),
        "latent_dim": shape("latent_out_proj.weight", 2)[1],
        "state_dim": shape("state_proj.weight", 2)[1],
        "action_dim": shape("action_head.weight", 2)[0],
        "backbone_width": shape("backbone.conv1.weight", 4)[0],
    }


def _layers(weights: Mapping[str, Tensor], prefix: str) -> int:
    return len({name.removeprefix(prefix).split(".")[0] for name in weights if name.startswith(prefix)})


def build(weights: Mapping[str, Tensor], arguments: Mapping[str, Any], dialect: Dialect, where: object) -> ACT:
    """A policy with translated weights; nothing may be missing, left over or of another shape.

    Args:
        weights: by our names, without the normalisation of states and actions.
        arguments: of `ACT`. Its shapes are compared before anything of that size is made.
        dialect: in whose names a problem is reported.
        where: the file, for messages.

    Raises:
        CheckpointError: a tensor is missing, left over, or of another shape.
        ConfigError: arguments that exclude each other, such as a number of heads.
    """
    with torch.device("meta"):
        wanted = ACT(**arguments).state_dict()
    needed = {name for name in wanted if not name.startswith("normalizer.") and name != "backbone.pretrained"}
    if needed != set(weights):
        missing, extra = (
            ", ".join(str(dialect.theirs(name)) for name in sorted(names)[:6]) or "nothing"
            for names in (needed - set(weights), set(weights) - needed)
        )
        fix = "Use the complete state dict of an ACT with a ResNet-18."
        raise CheckpointError(where, f"the {len(needed)} tensors of ACT", f"{missing} missing, {extra} left over", fix)
    for name in sorted(needed):
        if weights[name].shape != wanted[name].shape:
            got, fix = tuple(weights[name].shape), "Only the published network can be imported, with a ResNet-18."
            raise CheckpointError(f"{where}: {dialect.theirs(name)}", f"{tuple(wanted[name].shape)}", got, fix)
    policy = ACT(**arguments)
    own = policy.state_dict()
    for name in needed:
        own[name].copy_(weights[name])
    policy.backbone.pretrained.fill_(True)
    return policy.eval()


def untranslate(policy: ACT, dialect: Dialect) -> dict[str, Tensor]:
    """The weights of a policy under their names, with the prefix and with the table of positions.

    Args:
        policy: one that `check_plain` accepts.
        dialect: in whose names.
    """
    found = {}
    for name, value in policy.state_dict().items():
        if name.startswith("normalizer.") or name == "backbone.pretrained" or name.endswith("num_batches_tracked"):
            continue
        theirs = dialect.theirs(name)
        if theirs is None:
            continue  # of a refinement that the caller has dropped
        found[theirs] = value[None] if name == "posterior.cls_embed" else value
    if policy.posterior is not None:
        table = sine_positions(2 + policy.chunk_length, policy.query_embed.shape[1])  # (2 + K, D)
        found[dialect.prefix + dialect.position_table] = table[None]
    return {name: value.detach().cpu().contiguous().clone() for name, value in found.items()}


def check_plain(policy: ACT, project: str, drop_refinement: bool) -> None:
    """Make sure that a network is the published one, so that other projects can express it.

    Args:
        policy: what is exported.
        project: where to, for messages.
        drop_refinement: whether a refinement branch and an uncertainty head may be left behind.

    Raises:
        ConfigError: it has something that the published network does not have.
    """
    given = policy.blueprint()["init_args"]
    if not drop_refinement and (policy.branch is not None or policy.uncertainty_head is not None):
        fix = "`--drop_refinement` exports the coarse actions alone."
        raise ConfigError(f"--to {project}", "plain ACT", "a policy with refinement or an uncertainty head", fix)
    published = {
        "backbone_stem": "standard",
        "backbone_width": 64,
        "camera_embedding": False,
        "position_in_values": False,
        "keypoints": 0,
    }
    for name, value in published.items():
        if given[name] != value:
            fix = "Only configs/paper/ has the published network; `--to safetensors`, `onnx` and `torch` take any."
            raise ConfigError(f"--to {project}: {name}", value, given[name], fix)
    if given["backbone_norm"] == "group":
        fix = "Only normalisation with fixed statistics can be exported; `--to safetensors` takes any."
        raise ConfigError(f"--to {project}: backbone_norm", "frozen or batch", "group", fix)
    if policy.causal and len(policy.decoder) > 1:
        fix = "Only a first layer is the same with and without the mask; use `--to safetensors`."
        raise ConfigError(f"--to {project}: causal", False, True, fix)
    if given["state_dropout"] >= 1:
        fix = "The published network always sees the state; use `--to safetensors`."
        raise ConfigError(f"--to {project}: state_dropout", "below 1", given["state_dropout"], fix)
