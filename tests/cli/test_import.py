import pickle
from pathlib import Path

import pytest
import torch
from published_act import seen, small

from ugr_lightning.cli.main import main
from ugr_lightning.contract import Observation
from ugr_lightning.models.checkpoint import load_policy
from ugr_lightning.speed.reference_act import ReferenceACT


@pytest.fixture
def original(tmp_path, monkeypatch):
    """A folder as the original training leaves it."""
    monkeypatch.chdir(tmp_path)
    network = small(ReferenceACT, decoder_layers=7)
    torch.save({f"model.{name}": value for name, value in network.state_dict().items()}, "policy_best.ckpt")
    numbers = {"qpos_mean": torch.ones(5).numpy(), "qpos_std": torch.full((5,), 0.5).numpy()}
    numbers |= {"action_mean": torch.arange(4.0).numpy(), "action_std": torch.full((4,), 2.0).numpy()}
    Path("dataset_stats.pkl").write_bytes(pickle.dumps({**numbers, "example_qpos": torch.zeros(3, 5)}))
    return network


COMMAND = ["import-act", "policy_best.ckpt", "dataset_stats.pkl", "--cameras", "[top,wrist]", "--heads", "4"]


def test_import_act_writes_a_checkpoint_like_any_other(original, capsys):
    assert main([*COMMAND, "--out", "ours.ckpt", "--task", "click_alarmclock"]) == 0
    out = capsys.readouterr().out
    assert "is_pad_head.weight" in out
    assert "transformer.decoder.layers.6.* (18 tensors)" in out
    policy, info = load_policy("ours.ckpt")
    assert policy.cameras == ("top", "wrist")
    assert info.data == {"task": "click_alarmclock", "image_size": [480, 640], "state": "commanded"}
    images, state = seen()
    with torch.no_grad():
        theirs = original(images / 255, (state - 1) / 0.5) * 2 + torch.arange(4.0)
    torch.testing.assert_close(policy.predict(Observation(images, state)).actions, theirs, atol=1e-5, rtol=0)
    assert main(["inspect", "ours.ckpt"]) == 0
    assert "wrist" in capsys.readouterr().out


def test_import_act_takes_the_statistics_beside_the_checkpoint_and_overwrites_nothing(original, capsys):
    short = [part for part in COMMAND if part != "dataset_stats.pkl"]
    assert main([*short, "--out", "ours.ckpt"]) == 0
    before = Path("ours.ckpt").read_bytes()
    assert main([*short, "--out", "ours.ckpt"]) == 2
    assert "does not exist yet" in capsys.readouterr().err
    assert Path("ours.ckpt").read_bytes() == before


def test_import_act_refuses_code_and_other_policies(original, capsys):
    class Runs:
        def __reduce__(self):
            return (Path.touch, (Path("was_run"),))

    torch.save({"model.action_head.weight": Runs()}, "evil.ckpt")
    torch.save({"model.lstm.weight": torch.zeros(1)}, "other.ckpt")
    for name in ("evil.ckpt", "other.ckpt", "none.ckpt"):
        assert main(["import-act", name, "dataset_stats.pkl", "--out", "ours.ckpt"]) == 2
        assert name in capsys.readouterr().err
    Path("evil.pkl").write_bytes(pickle.dumps(Runs()))
    assert main(["import-act", "policy_best.ckpt", "evil.pkl", "--out", "ours.ckpt"]) == 2
    assert "evil.pkl" in capsys.readouterr().err
    assert not Path("was_run").exists()
    assert not Path("ours.ckpt").exists()
