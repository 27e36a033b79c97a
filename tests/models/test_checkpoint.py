import random
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from deployed import looking_act, save
from tiny import TinyPolicy, train

from ugr_lightning.contract import Observation
from ugr_lightning.errors import CheckpointError
from ugr_lightning.models.checkpoint import load_policy, read_checkpoint, sha256
from ugr_lightning.training.checkpoint_io import AtomicCheckpointIO


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tiny" / "version_0"
    train(folder, max_epochs=1)
    return folder / "last.ckpt"


def test_a_checkpoint_is_complete_in_itself(checkpoint):
    policy, info = load_policy(checkpoint)
    assert isinstance(policy, TinyPolicy)
    assert not policy.training
    assert float(policy.mean[0]) == 0.25, "the statistics are in it"
    assert info.description["cameras"] == ["cam_high"]
    assert info.data["task"] == "click_alarmclock"
    assert info.data["split"] == {"train": [0, 1, 2], "validation": [3]}
    assert info.data["image_size"] == [4, 4]
    assert torch.__version__.startswith(info.description["versions"]["torch"]), "which may name its build, too"
    assert info.sha256 == sha256(checkpoint)
    chunk = policy.predict(Observation(torch.zeros(1, 1, 3, 4, 4, dtype=torch.uint8), torch.zeros(1, 3)))
    assert chunk.actions.shape == (1, 5, 3)


def test_a_checkpoint_opens_where_no_class_may_be_looked_up(checkpoint):
    program = f"""
import pickle
class Refusing(pickle._Unpickler):
    def find_class(self, *names): raise AssertionError(f"code was looked up: {{names}}")
pickle.Unpickler = Refusing
import torch
content = torch.load({str(checkpoint)!r}, weights_only=True)
assert "policy" in content and "optimizer_states" in content
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


class Payload:
    def __reduce__(self):
        return (Path.touch, (Path("was_run"),))


def test_a_file_that_would_run_code_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"policy": Payload()}, "evil.ckpt")
    with pytest.raises(CheckpointError, match="could run code"):
        load_policy("evil.ckpt")
    assert not Path("was_run").exists()


def test_damaged_missing_and_foreign_files_are_refused_in_one_paragraph(tmp_path, checkpoint):
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(checkpoint.read_bytes()[:2000])
    foreign = tmp_path / "foreign.ckpt"
    torch.save({"state_dict": {}}, foreign)
    for path in (cut, foreign, tmp_path / "none.ckpt"):
        with pytest.raises(CheckpointError, match=path.name):
            load_policy(path)


PARTS = ("blueprint", "cameras", "chunk_length", "state_dim", "action_dim", "data", "versions")
WRONG = {
    "nothing of a part": lambda policy, part: policy.pop(part),
    "something else": lambda policy, part: policy.update({part: None}),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("part", PARTS)
def test_a_checkpoint_that_lacks_a_part_is_refused_by_name(tmp_path, checkpoint, part, wrong):
    content = torch.load(checkpoint, weights_only=True)
    WRONG[wrong](content["policy"], part)
    torch.save(content, tmp_path / "lacking.ckpt")
    with pytest.raises(CheckpointError, match=rf"lacking\.ckpt: .* got no {part}\."):
        load_policy(tmp_path / "lacking.ckpt")


def test_a_checkpoint_of_another_version_names_itself_and_both_versions(tmp_path, checkpoint):
    content = torch.load(checkpoint, weights_only=True)
    content["policy"]["versions"]["ugr-lightning"] = "99.0"
    content["policy"]["blueprint"]["init_args"]["depth"] = 3
    torch.save(content, tmp_path / "later.ckpt")
    with pytest.raises(CheckpointError, match=r"later\.ckpt, init_args: .*'depth'.* ugr-lightning 99\.0, this is"):
        load_policy(tmp_path / "later.ckpt")
    content["policy"]["format"] = "another"
    torch.save(content, tmp_path / "later.ckpt")
    with pytest.raises(CheckpointError, match="format 1 or older, got another"):
        load_policy(tmp_path / "later.ckpt")


@pytest.mark.parametrize("zoom", [-8, 4, 2.5])
def test_a_checkpoint_with_a_setting_that_its_policy_refuses_names_itself(tmp_path, zoom):
    content = torch.load(save(looking_act(), tmp_path / "whole.ckpt"), weights_only=True)
    content["policy"]["blueprint"]["init_args"]["keyframes"]["zoom"] = zoom
    torch.save(content, tmp_path / "changed.ckpt")
    with pytest.raises(CheckpointError, match=rf"changed\.ckpt, .*{zoom}.* written by ugr-lightning"):
        load_policy(tmp_path / "changed.ckpt")


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("mmap", [False, True], ids=["read at once", "read in parts"])
@pytest.mark.parametrize("zipped", [True, False], ids=["today's files", "files of torch before 1.6"])
def test_a_damaged_file_is_never_a_crash(tmp_path, zipped, mmap):
    content = {"state_dict": {f"policy.layer{i}": torch.arange(3.0) + i for i in range(4)}, "step": 1}
    torch.save(content, tmp_path / "whole.ckpt", _use_new_zipfile_serialization=zipped)
    whole, draw, path = (tmp_path / "whole.ckpt").read_bytes(), random.Random(0), tmp_path / "damaged.ckpt"
    refused = 0
    for _ in range(150):
        damaged = bytearray(whole)
        for _ in range(draw.choice((1, 2, 8))):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        path.write_bytes(damaged[: draw.randrange(len(damaged))] if draw.random() < 0.2 else damaged)
        try:
            state = read_checkpoint(path, mmap=mmap).get("state_dict")
        except CheckpointError:
            refused += 1
            continue
        copies = [one.clone() for one in (state.values() if isinstance(state, dict) else ()) if torch.is_tensor(one)]
        assert all(copy.numel() < 100 for copy in copies), "touched, so that a tensor beyond the file would show"
    assert refused > 30


def test_a_full_disk_leaves_the_previous_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint({"step": 1}, path)

    def full(content, file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(CheckpointError, match="No space left"):
        AtomicCheckpointIO().save_checkpoint({"step": 2}, path)
    assert read_checkpoint(path) == {"step": 1}
    assert list(tmp_path.iterdir()) == [path], "nothing half-written remains"
