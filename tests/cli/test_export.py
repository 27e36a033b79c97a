import importlib.util
import json
import os
from pathlib import Path

import pytest
import torch
from made_up import episode

from ugr_lightning.bridges.graph import in_fp32, load_graph, load_onnx
from ugr_lightning.cli.main import main
from ugr_lightning.contract import CAMERAS, ChunkPolicy, Observation
from ugr_lightning.models.act import ACT
from ugr_lightning.models.checkpoint import load_policy, save_policy
from ugr_lightning.models.diffusion import DiffusionPolicy
from ugr_lightning.models.keyframes import KeyframeSettings
from ugr_lightning.models.refine.full import Full
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.results.results import append_result

needs_onnx = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="the extra `onnx` is not installed",
)
TINY = {"dim": 16, "feedforward": 24, "heads": 2, "encoder_layers": 1, "cvae_layers": 1, "latent_dim": 2}
DATA = {
    "task": "click_alarmclock",
    "setting": "demo_clean",
    "image_size": (32, 64),
    "split": {"split_seed": 3, "train": [0, 2]},
}


def save(policy: ChunkPolicy, name: str = "policy.ckpt") -> ChunkPolicy:
    """A checkpoint in the working folder, with statistics in which no dimension is like another."""
    for key, value in policy.normalizer.named_buffers():
        if value.dim() == 1:
            value.copy_(torch.linspace(0.3, 1.1, len(value)) + 0.1 * len(key) % 1)
    policy.normalizer.fitted.fill_(True)
    save_policy(name, policy, DATA)
    return load_policy(name)[0]


@pytest.fixture
def refined(tmp_path, monkeypatch):
    """A policy with everything that only this package has, in the working folder."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    compact = {"backbone_stem": "unshuffle", "backbone_width": 8, "keypoints": 2, "camera_embedding": True}
    policy = ACT(**TINY, **compact, backbone_norm="batch", chunk_length=10, refine=Uncertainty(), decoder_layers=1)
    torch.nn.init.normal_(policy.branch.head.weight)
    return save(policy)


@pytest.fixture
def plain(tmp_path, monkeypatch):
    """A policy that other projects know as well."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    return save(ACT(**TINY, backbone_norm="batch", chunk_length=10, decoder_readout="first", refine=Uncertainty()))


def look(policy: ChunkPolicy) -> Observation:
    time = (policy.observation_steps,) if policy.observation_steps > 1 else ()
    shape = (2, *time, len(policy.cameras), 3, 32, 64)
    return Observation(torch.randint(256, shape, dtype=torch.uint8), torch.randn(2, *time, 14))


def test_a_folder_of_safetensors_is_the_same_policy(refined, capsys):
    assert main(["export", "policy.ckpt", "--to", "safetensors", "--out", "folder"]) == 0
    assert "differ by at most 0 " in capsys.readouterr().out
    assert sorted(os.listdir("folder")) == ["README.md", "config.json", "model.safetensors"]
    again, info = load_policy("folder")
    seen = look(refined)
    assert torch.equal(again.predict(seen).actions, refined.predict(seen).actions)
    assert info.data["split"] == {"split_seed": 3, "train": [0, 2]}
    assert main(["inspect", "folder"]) == 0
    assert "unshuffle" in capsys.readouterr().out
    assert main(["export", "folder", "--to", "safetensors", "--out", "copy"]) == 0
    same = Path("copy/model.safetensors").read_bytes() == Path("folder/model.safetensors").read_bytes()
    assert same, "a copy of a copy"


@pytest.mark.parametrize("to", ["safetensors", "torch", "onnx"])
def test_keyframes_are_exported_with_the_calibration_as_an_input(tmp_path, monkeypatch, capsys, to):
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    sizes = {"backbone_stem": "unshuffle", "backbone_width": 8, "backbone_norm": "batch", "chunk_length": 10}
    looks = {"keyframes": KeyframeSettings(channels=8, zoom=8, zoom_levels=2), "refine": Full()}
    policy = ACT(**TINY, **sizes, **looks, decoder_layers=1)
    save(policy)
    assert main(["export", "policy.ckpt", "--to", to, "--out", "a folder"]) == 0
    assert "differ by at most" in capsys.readouterr().out
    card = Path("a folder/README.md").read_text()
    if to == "safetensors":
        assert "\nugr test 'a folder'\n" in card
        return
    use = card.split("```\n")[1]
    seen = look(policy)._replace(projection=torch.randn(2, len(policy.cameras), 3, 4))
    given = seen._asdict() if to == "torch" else {name: value.numpy() for name, value in seen._asdict().items()}
    done = {**given, "torch": torch, "onnxruntime": to == "onnx" and importlib.import_module("onnxruntime")}
    exec(use, done)  # as a reader would
    wanted = in_fp32(policy).predict(seen).actions
    torch.testing.assert_close(torch.as_tensor(done["actions"]), wanted, atol=1e-4, rtol=1e-4)


def test_a_policy_that_samples_and_looks_back_is_exported_too(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    policy = save(DiffusionPolicy(CAMERAS, 4, 2, False, unet_widths=(8, 16), backbone_width=16, sampling_steps=2, sampler="ddim"))  # fmt: skip  # noqa: E501
    assert main(["export", "policy.ckpt", "--to", "safetensors", "--out", "folder"]) == 0
    seen = look(policy)
    assert torch.equal(load_policy("folder")[0].predict(seen).actions, policy.predict(seen).actions)
    for target in ("torch", "act", "lerobot"):
        assert main(["export", "policy.ckpt", "--to", target, "--out", target]) == 2
        assert "safetensors" in capsys.readouterr().err
    assert sorted(os.listdir()) == ["folder", "policy.ckpt"], "nothing half-written remains"


def test_the_card_says_what_it_is_and_how_well_it_does(refined):
    sha = load_policy("policy.ckpt")[1].sha256
    for seed in range(4):
        append_result("evaluation.jsonl", episode(seed, seed > 0, checkpoint=sha))
    append_result("evaluation.jsonl", episode(9, task="other", checkpoint="another"))
    assert main(["export", "policy.ckpt", "--to", "safetensors", "--out", "folder", "--licence", "mit"]) == 0
    card = Path("folder/README.md").read_text()
    for part in (
        "license: mit",
        "click_alarmclock",
        "- train episodes: 2: 0, 2",
        "- split seed: 3\n",
        "3/4 = 75.0%",
        "[30.1%",
        sha,
        "torch ",
    ):
        assert part in card, part
    assert "other" not in card.split("## Success")[1].split("## Versions")[0]


@pytest.mark.parametrize("target", ["torch", pytest.param("onnx", marks=needs_onnx)])
def test_the_graph_gives_the_actions_of_the_policy(refined, capsys, target):
    assert main(["export", "policy.ckpt", "--to", target, "--out", "folder"]) == 0
    assert "differ by at most" in capsys.readouterr().out
    graph = load_graph(Path("folder/policy.pt2")) if target == "torch" else load_onnx(Path("folder/policy.onnx"))
    exact, seen = in_fp32(refined), look(refined)
    wanted = exact.predict(seen)
    assert (wanted.actions - wanted.coarse).abs().max() > 1e-3, "the refinement is part of the graph"
    torch.testing.assert_close(graph(seen.images, seen.state), wanted.actions, atol=1e-4, rtol=1e-4)


def test_a_graph_that_answers_differently_is_not_published(refined, monkeypatch, capsys):
    from ugr_lightning.bridges import export

    monkeypatch.setattr(export, "export_graph", lambda policy, observation, path: path.touch())
    monkeypatch.setattr(export, "load_graph", lambda path: lambda images, state: torch.zeros(len(state), 10, 14))
    assert main(["export", "policy.ckpt", "--to", "torch", "--out", "folder"]) == 2
    assert "the same actions" in capsys.readouterr().err
    assert os.listdir() == ["policy.ckpt"]


def test_exported_to_act_and_imported_again_the_coarse_policy_acts(plain, capsys):
    command = ["export", "policy.ckpt", "--to", "act", "--out", "folder"]
    assert main(command) == 2
    assert "--drop_refinement" in capsys.readouterr().err
    assert main([*command, "--drop_refinement"]) == 0
    assert "copies of the first" in capsys.readouterr().out
    imported = ["import-act", "folder/policy_best.ckpt", "folder/dataset_stats.pkl", "--heads", "2"]
    assert main([*imported, "--out", "again.ckpt"]) == 0
    assert main(["export", "again.ckpt", "--to", "act", "--out", "round"]) == 0
    first, second = (torch.load(f"{folder}/policy_best.ckpt", weights_only=True) for folder in ("folder", "round"))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert Path("folder/dataset_stats.pkl").read_bytes() == Path("round/dataset_stats.pkl").read_bytes()


def test_exported_to_lerobot_and_imported_again_the_coarse_policy_acts(plain, capsys):
    assert main(["export", "policy.ckpt", "--to", "lerobot", "--out", "folder", "--drop_refinement"]) == 0
    assert json.loads(Path("folder/config.json").read_text())["n_decoder_layers"] == 1
    assert main(["inspect", "folder"]) == 2
    assert "import-lerobot" in capsys.readouterr().err
    assert main(["import-lerobot", "folder", "--out", "again.ckpt", "--precision", "auto"]) == 0
    again, info = load_policy("again.ckpt")
    assert info.data["image_size"] == [32, 64]
    assert again.cameras == CAMERAS
    seen = look(plain)
    ours, theirs = in_fp32(plain).predict(seen).coarse, in_fp32(again).predict(seen).actions
    torch.testing.assert_close(theirs, ours, atol=1e-5, rtol=1e-5)


def test_an_export_takes_no_folder_that_has_something_in_it(refined, capsys):
    Path("folder").mkdir()
    Path("folder/mine.txt").write_text("mine")
    assert main(["export", "policy.ckpt", "--to", "safetensors", "--out", "folder"]) == 2
    assert "empty" in capsys.readouterr().err
    assert os.listdir("folder") == ["mine.txt"]


def test_damaged_folders_are_refused_by_name(refined, capsys):
    assert main(["export", "policy.ckpt", "--to", "safetensors", "--out", "folder"]) == 0
    weights = Path("folder/model.safetensors").read_bytes()
    for file, content in (
        ("model.safetensors", weights[:-1]),
        ("model.safetensors", b"\xff" * 64),
        ("config.json", b"{"),
        ("config.json", b"[]"),
        ("config.json", b'{"library": "other"}'),
        ("config.json", b"[" * 100_000),
    ):
        before = Path("folder", file).read_bytes()
        Path("folder", file).write_bytes(content)
        assert main(["inspect", "folder"]) == 2
        assert file in capsys.readouterr().err
        Path("folder", file).write_bytes(before)
