"""Policies of ours as lerobot's: a folder with `config.json`, `model.safetensors` and the processors' files.

lerobot's own evaluation loop calls it: `lerobot-eval --policy.path=FOLDER`. lerobot and this package pin versions that
exclude each other, so that they live in two environments, and the folder is what they share.
"""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ugr_lightning.bridges.act_layout import check_plain, untranslate
from ugr_lightning.bridges.lerobot_policy import ACTION, EPSILON, IMAGES, LEROBOT, STATE
from ugr_lightning.models.act import ACT
from ugr_lightning.models.policy_folder import CONFIG, WEIGHTS, write_safetensors
from ugr_lightning.models.vision import IMAGENET_MEAN, IMAGENET_STD


def export_lerobot(
    policy: ACT, folder: Path, image_size: tuple[int, int], *, drop_refinement: bool = False
) -> list[str]:
    """Write a policy of ours as lerobot would.

    Args:
        policy: plain ACT at the published structure.
        folder: where to.
        image_size: H and W of its images.
        drop_refinement: leave a refinement branch and an uncertainty head behind.

    Returns:
        Sentences about what was left behind.

    Raises:
        ConfigError: lerobot has no place for something that the policy has.
    """
    check_plain(policy, "lerobot", drop_refinement)
    features: dict[str, Any] = {STATE: {"type": "STATE", "shape": [policy.state_dim]}}
    features |= {f"{IMAGES}{name}": {"type": "VISUAL", "shape": [3, *image_size]} for name in policy.cameras}
    command = {ACTION: {"type": "ACTION", "shape": [policy.action_dim]}}
    modes = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
    given = policy.blueprint()["init_args"]
    config = {
        "type": "act",
        "n_obs_steps": 1,
        "input_features": features,
        "output_features": command,
        "normalization_mapping": modes,
        "device": None,
        "push_to_hub": False,
        "license": "apache-2.0",
        "chunk_size": policy.chunk_length,
        "n_action_steps": policy.chunk_length,
        "vision_backbone": "resnet18",
        "pretrained_backbone_weights": None,
        "replace_final_stride_with_dilation": False,
        "pre_norm": False,
        "dim_model": given["dim"],
        "n_heads": given["heads"],
        "dim_feedforward": given["feedforward"],
        "feedforward_activation": "relu",
        "n_encoder_layers": given["encoder_layers"],
        "n_decoder_layers": len(policy.decoder),
        "use_vae": policy.posterior is not None,
        "latent_dim": policy.latent_dim,
        "n_vae_encoder_layers": given["cvae_layers"],
        "temporal_ensemble_coeff": None,
        "dropout": given["dropout"],
        "kl_weight": given["kl_weight"],
    }
    statistics = _written_statistics(policy)
    settings = {"eps": EPSILON, "features": {**features, **command}, "norm_map": modes}
    before, after = "policy_preprocessor", "policy_postprocessor"
    scale = f"{before}_step_3_normalizer_processor.safetensors"
    unscale = f"{after}_step_0_unnormalizer_processor.safetensors"
    device = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
    steps = [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        device,
        {"registry_name": "normalizer_processor", "config": settings, "state_file": scale},
    ]
    back = {**settings, "features": command}
    last = {"registry_name": "unnormalizer_processor", "config": back, "state_file": unscale}
    objects: dict[str, dict[str, Any]] = {
        CONFIG: config,
        f"{before}.json": {"name": before, "steps": steps},
        f"{after}.json": {"name": after, "steps": [last, device]},
    }
    for name, content in objects.items():
        (folder / name).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    write_safetensors(folder / WEIGHTS, untranslate(policy, LEROBOT))
    for name in (scale, unscale):
        write_safetensors(folder / name, statistics)
    notes = [f"lerobot executes all {policy.chunk_length} steps of a chunk; `--policy.n_action_steps` changes that"]
    if policy.branch is not None or policy.uncertainty_head is not None:
        notes.append("the refinement branch and the uncertainty head were left behind")
    return notes


def _written_statistics(policy: ACT) -> dict[str, Tensor]:
    own = policy.normalizer
    found = {
        f"{STATE}.mean": own.state_shift,
        f"{STATE}.std": own.state_scale - EPSILON,
        f"{ACTION}.mean": own.action_shift,
        f"{ACTION}.std": own.action_scale,
    }
    for name in policy.cameras:
        for part, numbers in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
            found[f"{IMAGES}{name}.{part}"] = torch.tensor(numbers).view(3, 1, 1)
    return found
