import json
from pathlib import Path

import pytest
import torch
from published_act import MEAN, STD, LeRobotACT, seen, small
from safetensors.torch import load_file, save_file

from ugr_lightning.bridges.lerobot_folder import export_lerobot
from ugr_lightning.bridges.lerobot_policy import import_lerobot
from ugr_lightning.contract import Observation
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.act import ACT

IMAGES = ("observation.images.top", "observation.images.wrist")
MODES = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}


def config(**changed):
    features = {
        IMAGES[0]: {"type": "VISUAL", "shape": [3, 64, 96]},
        "observation.state": {"type": "STATE", "shape": [5]},
    }
    features[IMAGES[1]] = {"type": "VISUAL", "shape": [3, 64, 96]}
    basic = {"type": "act", "n_heads": 4, "input_features": features, "normalization_mapping": MODES}
    return {**basic, "output_features": {"action": {"type": "ACTION", "shape": [4]}}, "n_action_steps": 6, **changed}


@pytest.fixture
def network():
    """Two decoder layers, of which the last is read."""
    return small(LeRobotACT, decoder_layers=2)


@pytest.fixture
def statistics():
    draw = torch.Generator().manual_seed(3)
    found = {}
    for feature, dim in (("observation.state", 5), ("action", 4)):
        low, span = torch.randn(dim, generator=draw), torch.rand(dim, generator=draw) + 0.1
        names = {"mean": low + span / 3, "std": span / 4, "min": low, "max": low + span}
        names |= {"q01": low + 0.1 * span, "q99": low + 0.8 * span}
        found |= {f"{feature}.{name}": value for name, value in names.items()}
    for image in IMAGES:
        found |= {f"{image}.mean": torch.tensor(MEAN).view(3, 1, 1), f"{image}.std": torch.tensor(STD).view(3, 1, 1)}
    return found


def write_processors(folder: Path, statistics) -> None:
    """As newer versions save them; other steps stand around the one that matters."""
    for name, step in (
        ("policy_preprocessor", "normalizer_processor"),
        ("policy_postprocessor", "unnormalizer_processor"),
    ):
        file = f"{name}_step_1_{step}.safetensors"
        steps = [{"registry_name": "to_batch_processor"}, {"registry_name": step, "config": {}, "state_file": file}]
        (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": steps}))
        save_file(statistics, folder / file)


def executed(network, statistics, images, state, mode="MEAN_STD"):
    """What lerobot sends to the robot, by the formulas of its normalisation."""

    def value(feature, name):
        return statistics[f"{feature}.{name}"]

    if mode == "MEAN_STD":
        state = (state - value("observation.state", "mean")) / (value("observation.state", "std") + 1e-8)
    else:
        names = {"MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99")}[mode]
        low, high = (value("observation.state", name) for name in names)
        state = 2 * (state - low) / (high - low) - 1
    pixels = [
        (images[:, v] / 255 - value(image, "mean")) / (value(image, "std") + 1e-8) for v, image in enumerate(IMAGES)
    ]
    with torch.no_grad():
        actions = network(pixels, state)
    if mode == "MEAN_STD":
        return actions * value("action", "std") + value("action", "mean")
    low, high = (value("action", name) for name in names)
    return (actions + 1) / 2 * (high - low) + low


def named(network):
    return {f"model.{name}": value for name, value in network.state_dict().items()}


def imported(folder, weights, about=None, **options):
    """What comes of a folder with these weights and this `config.json`."""
    (folder / "config.json").write_text(json.dumps(about or config()))
    save_file(weights, folder / "model.safetensors")
    return import_lerobot(folder, **options)


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES"])
def test_an_imported_policy_commands_what_lerobot_commands(tmp_path, network, statistics, mode):
    write_processors(tmp_path, statistics)
    about = config(normalization_mapping={"VISUAL": "MEAN_STD", "STATE": mode, "ACTION": mode})
    policy, image_size, _ = imported(tmp_path, named(network), about)
    assert policy.cameras == ("top", "wrist")
    assert image_size == (64, 96)
    images, state = seen()
    theirs = executed(network, statistics, images, state, mode)
    assert theirs.std(dim=(0, 1)).min() > 1e-3, "the comparison is of numbers that differ"
    torch.testing.assert_close(policy.predict(Observation(images, state)).actions, theirs, atol=1e-5, rtol=0)


def test_statistics_are_found_in_the_weights_of_older_versions(tmp_path, network, statistics):
    old = {}
    for key, value in statistics.items():
        feature, _, name = key.rpartition(".")
        group = "unnormalize_outputs" if feature == "action" else "normalize_inputs"
        old[f"{group}.buffer_{feature.replace('.', '_')}.{name}"] = value
    old["normalize_targets.buffer_action.mean"] = statistics["action.mean"].clone()
    old["normalize_targets.buffer_action.max"] = torch.tensor(torch.inf)  # never fitted, never read
    policy, *_ = imported(tmp_path, {**named(network), **old}, cameras=("cam_high", "cam_wrist"))
    assert policy.cameras == ("cam_high", "cam_wrist")
    images, state = seen()
    theirs = executed(network, statistics, images, state)
    torch.testing.assert_close(policy.predict(Observation(images, state)).actions, theirs, atol=1e-5, rtol=0)


def test_an_exported_policy_is_written_as_lerobot_would_and_comes_back(tmp_path, network, statistics):
    write_processors(tmp_path, statistics)
    policy, *_ = imported(tmp_path, named(network))
    folder = tmp_path / "exported"
    folder.mkdir()
    export_lerobot(policy, folder, (64, 96))
    weights = load_file(folder / "model.safetensors")
    assert set(weights) == set(named(network))
    for name, value in named(network).items():
        torch.testing.assert_close(weights[name], value, atol=1e-6 if "pos_enc" in name else 0, rtol=0)
    for key, value in load_file(folder / "policy_preprocessor_step_3_normalizer_processor.safetensors").items():
        torch.testing.assert_close(value, statistics[key], atol=1e-7, rtol=0)
    again, *_ = import_lerobot(folder)
    images, state = seen()
    first, second = (one.predict(Observation(images, state)).actions for one in (policy, again))
    torch.testing.assert_close(first, second, atol=1e-6, rtol=0)


def test_what_lerobot_has_no_place_for_is_refused():
    sizes = {"dim": 16, "heads": 2, "feedforward": 8, "encoder_layers": 1, "decoder_layers": 2, "cvae_layers": 0}
    for options, complaint in (({"keypoints": 2}, "keypoints"), ({"causal": True}, "causal")):
        with pytest.raises(ConfigError, match=complaint):
            export_lerobot(ACT(**sizes, **options), Path(), (64, 96))


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"type": "diffusion"}, "type"),
        ({"vision_backbone": "resnet34"}, "resnet34"),
        ({"pre_norm": True}, "pre_norm"),
        ({"replace_final_stride_with_dilation": True}, "dilation"),
        ({"n_heads": "four"}, "n_heads"),
        ({"input_features": {"observation.environment_state": {"type": "ENV", "shape": [5]}}}, "environment_state"),
        ({"input_features": None}, "input_features"),
        ({"normalization_mapping": {**MODES, "VISUAL": "IDENTITY"}}, "use_imagenet_stats"),
        ({"normalization_mapping": {**MODES, "ACTION": "LOGARITHM"}}, "LOGARITHM"),
    ],
)
def test_other_networks_are_refused_by_what_differs(tmp_path, network, statistics, changed, complaint):
    write_processors(tmp_path, statistics)
    with pytest.raises(CheckpointError, match=complaint):
        imported(tmp_path, named(network), config(**changed))


def test_unusable_statistics_are_refused_by_name(tmp_path, network, statistics):
    bad = [
        ({"action.std": torch.full((4,), torch.inf)}, "action.std"),
        ({"action.std": torch.ones(3)}, "action"),
        ({f"{IMAGES[1]}.mean": torch.zeros(3, 1, 1)}, "ImageNet"),
    ]
    for changed, complaint in bad:
        write_processors(tmp_path, {**statistics, **changed})
        with pytest.raises(CheckpointError, match=complaint):
            imported(tmp_path, named(network))
    (tmp_path / "policy_preprocessor.json").unlink()
    with pytest.raises(CheckpointError, match="policy_preprocessor"):
        imported(tmp_path, named(network))


def test_a_processor_cannot_point_outside_its_folder(tmp_path, network):
    steps = [{"registry_name": "normalizer_processor", "state_file": "../../secret.safetensors"}]
    (tmp_path / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    with pytest.raises(CheckpointError, match="secret"):
        imported(tmp_path, named(network))
