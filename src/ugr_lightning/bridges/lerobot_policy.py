"""ACT policies of lerobot's as ours: its parameter names, its normalisation, its `config.json`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ugr_lightning.bridges.act_checkpoint import set_normalisation
from ugr_lightning.bridges.act_layout import (
    Dialect,
    build,
    checked_tensors,
    sizes_of,
    translate,
)
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.policy_folder import CONFIG, WEIGHTS, read_json, read_safetensors
from ugr_lightning.models.precision import Precision
from ugr_lightning.models.vision import IMAGENET_MEAN, IMAGENET_STD

LEROBOT = Dialect(
    name="lerobot's",
    prefix="model.",
    names=(
        ("backbone.", "backbone."),
        ("encoder_img_feat_input_proj.", "input_proj."),
        ("encoder.layers.", "encoder."),
        ("decoder.layers.", "decoder."),
        ("decoder.norm.", "decoder_norm."),
        ("vae_encoder.layers.", "posterior.layers."),
        ("vae_encoder_action_input_proj.", "posterior.action_proj."),
        ("vae_encoder_robot_state_input_proj.", "posterior.joint_proj."),
        ("vae_encoder_cls_embed.weight", "posterior.cls_embed"),
        ("vae_encoder_latent_output_proj.", "posterior.latent_proj."),
        ("encoder_latent_input_proj.", "latent_out_proj."),
        ("encoder_robot_state_input_proj.", "state_proj."),
        ("decoder_pos_embed.weight", "query_embed"),
        ("encoder_1d_feature_pos_embed.weight", "additional_pos_embed"),
        ("action_head.", "action_head."),
    ),
    position_table="vae_encoder_pos_enc",
    first_layer_only=False,
)
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images."
EPSILON = 1e-8
"""What lerobot adds to a standard deviation, or takes for a range, before it divides."""
_OLD = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
_FIX = "Only ACT with a ResNet-18, images and joint states can be imported."
_RANGES = {"MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"), "QUANTILE10": ("q10", "q90")}


def import_lerobot(
    folder: Path, *, cameras: Sequence[str] | None = None, precision: Precision = "fp32"
) -> tuple[ACT, tuple[int, int], list[str]]:
    """Make a policy of ours from an ACT policy of lerobot's.

    Args:
        folder: `pretrained_model`, with `config.json`, `model.safetensors` and newer versions' processors.
        cameras: new names for the cameras, in the order of `input_features`; None takes lerobot's.
        precision: arithmetic of the trunk; `fp32` is lerobot's.

    Returns:
        The policy, height and width of its images, and sentences for the user.

    Raises:
        CheckpointError: another kind of policy, a network that ours cannot express, missing or unusable statistics.

    Source: huggingface/lerobot@7427f31, src/lerobot/policies/act and src/lerobot/processor.
    """
    where, place = folder / CONFIG, folder / WEIGHTS
    config, weights = read_json(where), read_safetensors(place)
    _check_network(config, where)
    names, image_size = _cameras(config, where)
    if cameras is not None and len(cameras) != len(names):
        got = f"{len(cameras)}: {', '.join(cameras)}"
        raise ConfigError("--cameras", f"{len(names)} names, for {', '.join(names)}", got, "Name every camera once.")
    found, _ = translate(checked_tensors(weights, place, ignore=_OLD), LEROBOT, place)
    sizes = sizes_of(found, LEROBOT, place)
    arguments = {
        **sizes,
        "heads": _number(config, "n_heads", where),
        "cameras": tuple(cameras or names),
        "reconstruction": "l1",
        "precision": precision,
    }
    policy = build(found, arguments, LEROBOT, place)
    statistics = _statistics(weights, folder)
    modes = config.get("normalization_mapping") or {}
    for name in names:
        _check_imagenet(statistics, f"{IMAGES}{name}", modes.get("VISUAL"), folder)
    state = _affine(statistics, STATE, modes.get("STATE"), sizes["state_dim"], folder)
    action = _affine(statistics, ACTION, modes.get("ACTION"), sizes["action_dim"], folder)
    if modes.get("STATE") == "MEAN_STD":
        state = (state[0], state[1] + EPSILON)
    set_normalisation(policy, *state, *action)
    return policy, image_size, [f"{len(weights)} tensors, none left over", _execution(config)]


def _check_network(config: Mapping[str, Any], where: Path) -> None:
    wanted = {
        "type": "act",
        "n_obs_steps": 1,
        "vision_backbone": "resnet18",
        "replace_final_stride_with_dilation": False,
        "pre_norm": False,
        "feedforward_activation": "relu",
    }
    for name, value in wanted.items():
        if config.get(name, value) != value or (name == "type" and name not in config):
            raise CheckpointError(f"{where}: {name}", value, config.get(name), _FIX)


def _number(config: Mapping[str, Any], name: str, where: Path) -> int:
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise CheckpointError(f"{where}: {name}", "a positive number", value, "Copy the whole folder.")
    return value


def _cameras(config: Mapping[str, Any], where: Path) -> tuple[list[str], tuple[int, int]]:
    features = config.get("input_features")
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        raise CheckpointError(f"{where}: input_features", "an object of features", features, "Copy the whole folder.")
    seen = {key: feature.get("shape") for key, feature in features.items() if feature.get("type") == "VISUAL"}
    others = {key for key in features if key not in seen}
    if others != {STATE} or not seen or not all(key.startswith(IMAGES) for key in seen):
        raise CheckpointError(f"{where}: input_features", f"{STATE} and {IMAGES}*", ", ".join(features), _FIX)
    shape = next(iter(seen.values()))
    if not isinstance(shape, list) or len(shape) != 3 or shape[0] != 3:
        raise CheckpointError(f"{where}: input_features", "images of shape [3, H, W]", shape, _FIX)
    return [key.removeprefix(IMAGES) for key in seen], (int(shape[1]), int(shape[2]))


def _statistics(weights: Mapping[str, Tensor], folder: Path) -> dict[str, dict[str, Tensor]]:
    """Statistics by feature: from the weights, where older versions keep them, or from the processors' files."""
    found: dict[str, dict[str, Tensor]] = {}
    old = {key: value for key, value in weights.items() if key.startswith(_OLD)}
    for key, value in old.items():
        feature, _, name = key.split(".", 1)[1].removeprefix("buffer_").rpartition(".")
        found.setdefault(_with_dots(feature), {})[name] = value
    if old:
        return found
    for processor in ("policy_preprocessor", "policy_postprocessor"):
        path = folder / f"{processor}.json"
        steps = read_json(path).get("steps")
        for step in steps if isinstance(steps, list) else []:
            file = step.get("state_file") if isinstance(step, dict) else None
            if file is None or "normalizer" not in str(step.get("registry_name")):
                continue
            if Path(str(file)).name != file:
                raise CheckpointError(f"{path}: state_file", "the name of a file", file, "Copy the whole folder.")
            for key, value in read_safetensors(folder / file).items():
                feature, _, name = key.rpartition(".")
                found.setdefault(feature, {})[name] = value
    if not found:
        fix = "Copy the whole `pretrained_model` folder, processors included."
        raise CheckpointError(folder, "normalisation statistics", "none in weights or processors", fix)
    return found


def _with_dots(feature: str) -> str:
    """`observation_images_top` of an old buffer as the feature `observation.images.top`."""
    for name in (IMAGES, STATE, ACTION):
        if feature.startswith(name.replace(".", "_")):
            return name + feature[len(name) :]
    return feature


def _vector(statistics: Mapping[str, Mapping[str, Tensor]], feature: str, name: str, folder: Path) -> Tensor:
    value = statistics.get(feature, {}).get(name)
    if value is None or not value.is_floating_point() or not value.isfinite().all():
        got = "none" if value is None else "numbers that are not finite"
        fix = "Copy the whole folder; lerobot writes the statistics where the policy is saved."
        raise CheckpointError(f"{folder}: {feature}.{name}", "finite statistics", got, fix)
    return value.float()


def _affine(
    statistics: Mapping[str, Mapping[str, Tensor]], feature: str, mode: object, dim: int, folder: Path
) -> tuple[Tensor, Tensor]:
    """Shift and scale, (dim,) each, of a vector's normalisation."""
    if mode == "IDENTITY":
        return torch.zeros(dim), torch.ones(dim)
    if mode == "MEAN_STD":
        shift, scale = (_vector(statistics, feature, name, folder) for name in ("mean", "std"))
    elif mode in _RANGES:
        low, high = (_vector(statistics, feature, name, folder) for name in _RANGES[str(mode)])
        if (low == high).any():
            got = f"dimension {int((low == high).nonzero()[0])} without a range"
            fix = "Such a dimension has no finite normalisation; train with MEAN_STD."
            raise CheckpointError(f"{folder}: {feature}", "values that vary", got, fix)
        shift, scale = (high + low) / 2, (high - low) / 2
    else:
        known = ", ".join(["MEAN_STD", "IDENTITY", *_RANGES])
        raise CheckpointError(f"{folder}: normalization_mapping of {feature}", f"one of {known}", mode, _FIX)
    if shift.shape != (dim,) or scale.shape != (dim,):
        got = f"shapes {tuple(shift.shape)} and {tuple(scale.shape)}"
        raise CheckpointError(f"{folder}: {feature}", f"{dim} numbers", got, "Copy the whole folder.")
    return shift, scale


def _check_imagenet(statistics: Mapping[str, Mapping[str, Tensor]], feature: str, mode: object, folder: Path) -> None:
    """Our backbone normalises pixels by ImageNet's statistics, as lerobot does unless told otherwise."""
    fix = "Train with `--dataset.use_imagenet_stats=true`, lerobot's default."
    if mode != "MEAN_STD":
        raise CheckpointError(f"{folder}: normalization_mapping of {feature}", "MEAN_STD", mode, fix)
    for name, numbers in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
        value = _vector(statistics, feature, name, folder).flatten()
        if value.shape != (3,) or not torch.allclose(value, torch.tensor(numbers), atol=1e-6):
            raise CheckpointError(f"{folder}: {feature}.{name}", f"ImageNet's {numbers}", value.tolist()[:3], fix)


def _execution(config: Mapping[str, Any]) -> str:
    """How lerobot executes the chunks."""
    coefficient, steps = config.get("temporal_ensemble_coeff"), config.get("n_action_steps")
    if coefficient is not None:
        return f"lerobot aggregates chunks with the coefficient {coefficient}: `--execution aggregate` uses 0.01"
    return f"lerobot executes {steps} steps of each chunk: `--execution {steps}` does the same"
