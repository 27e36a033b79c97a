"""`ugr predict` from a checkpoint to its table and pictures."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from folders import files_of
from PIL import Image
from recordings import record
from tiny import TinyPolicy

from ugr_lightning.cli.main import main
from ugr_lightning.contract import CAMERAS, Observation
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.layout import Layout
from ugr_lightning.models.checkpoint import load_policy, save_policy
from ugr_lightning.models.diffusion import DiffusionPolicy


@pytest.fixture
def command(ten_demonstrations, tmp_path, untrained):
    """The command line for a checkpoint of a policy that was told the statistics and learned nothing."""
    untrained(TinyPolicy(cameras=CAMERAS, dim=14), tmp_path)
    return ["predict", str(tmp_path / "policy_best.ckpt"), "--data", str(ten_demonstrations)]


@pytest.mark.parametrize("name", ["predict", "analyze"])
def test_an_imported_policy_says_that_its_episodes_are_not_known(name, tmp_path, capsys):
    path = tmp_path / "imported.ckpt"
    save_policy(path, TinyPolicy(cameras=CAMERAS, dim=14), {"task": "click_alarmclock", "setting": "demo_clean"})
    assert main([name, str(path)]) == 2
    assert "the episodes it was trained on, got no episodes" in capsys.readouterr().err


def test_it_writes_errors_by_command_and_pictures_of_both_parts(command, capsys, tmp_path):
    assert main([*command, "--pictures", "1"]) == 0
    said = capsys.readouterr().out
    folder = tmp_path / "predictions-policy_best"
    found = json.loads((folder / "predictions.json").read_text())
    assert found["conclusion"] in said
    assert "On 8 training episodes" in said
    assert "does not fit the demonstrations" in said, "it learned nothing"
    assert found["conclusion"] in (folder / "predictions.md").read_text()
    pictures = sorted(folder.glob("*.png"))
    assert [picture.name.partition("-")[0] for picture in pictures] == ["training", "validation"]
    assert all(np.asarray(Image.open(picture)).std() > 0 for picture in pictures)


def test_the_errors_are_those_of_the_queries(command, ten_demonstrations, tmp_path):
    assert main([*command, "--stride", "4", "--pictures", "0", "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "predictions.json").read_text())["errors"]
    policy, _ = load_policy(tmp_path / "policy_best.ckpt")
    steps = policy.chunk_length
    data = ChunkDataModule(root=str(ten_demonstrations), episodes=10, chunk_length=steps, after_end="hold")
    data.setup()
    off = []
    for number in data.episode_split.validation:
        episode = data.demonstrations[number]
        for step in range(0, episode.length, 4):
            images = torch.from_numpy(episode.images(step)).movedim(-1, -3)[None]  # (1, V, 3, H, W)
            plan = policy.predict(Observation(images, torch.from_numpy(episode.state[step])[None])).actions[0].numpy()
            done = episode.action[np.minimum(step + np.arange(steps), episode.length - 1)]  # (K, A), held at the end
            off.append(np.abs(plan - done))
    assert found["validation"] == pytest.approx(np.concatenate(off).mean(0), rel=1e-4)
    assert not list((tmp_path / "out").glob("*.png"))


def test_the_folder_of_the_task_may_be_given_in_place_of_the_one_of_all_recordings(
    command, ten_demonstrations, tmp_path
):
    numbers = []
    for data in (ten_demonstrations, ten_demonstrations / "click_alarmclock" / "demo_clean"):
        assert main([*command[:-1], str(data), "--pictures", "0", "--out", str(tmp_path / "out")]) == 0
        numbers.append(json.loads((tmp_path / "out" / "predictions.json").read_text())["errors"])
    assert numbers[0] == numbers[1]


@pytest.mark.parametrize("name", ["predict", "analyze", "refine"])
def test_demonstrations_of_another_task_with_the_same_names_and_seeds_are_none_of_the_checkpoint(
    name, ten_demonstrations, tmp_path, tiny_act, untrained, capsys
):
    own = ten_demonstrations / "click_alarmclock" / "demo_clean"
    untrained(tiny_act(), tmp_path, {"folder": str(own)})
    other = record(tmp_path / "other", 10, steps=12, longer=0, size=(8, 12), task="handover_block", first_draw=50)
    before = files_of(tmp_path)
    assert main([name, str(tmp_path / "policy_best.ckpt"), "--data", str(other)]) == 2
    assert "the episodes of the checkpoint's split, got others" in " ".join(capsys.readouterr().err.split())
    assert files_of(tmp_path) == before


def test_a_policy_that_was_told_the_statistics_of_all_episodes_finds_its_own_again(
    ten_demonstrations, tmp_path, untrained
):
    chosen = {"root": str(ten_demonstrations), "normalise_over": "all"}
    untrained(TinyPolicy(cameras=CAMERAS, dim=14), tmp_path, chosen)
    command = ["predict", str(tmp_path / "policy_best.ckpt"), "--data", str(ten_demonstrations), "--pictures", "0"]
    assert main(command) == 0


def test_a_policy_that_sees_a_history_is_followed_too(ten_demonstrations, tmp_path, untrained, capsys):
    policy = DiffusionPolicy(
        cameras=CAMERAS, diffusion_steps=2, sampling_steps=2, unet_widths=(16, 32), backbone_width=8, precision="fp32"
    )
    untrained(policy, tmp_path)
    command = ["predict", str(tmp_path / "policy_best.ckpt"), "--data", str(ten_demonstrations), "--episodes", "1"]
    assert main([*command, "--stride", "6"]) == 0
    assert "On 1 training episodes" in capsys.readouterr().out


def test_only_the_chosen_tasks_are_followed(command, monkeypatch, capsys):
    monkeypatch.setattr(
        ChunkDataModule,
        "positions_of",
        lambda self, tasks: {*self.episode_split.train[:3], *self.episode_split.validation},
    )
    assert main([*command, "--tasks", "click_*", "--pictures", "0"]) == 0
    assert "On 3 training episodes" in capsys.readouterr().out
    monkeypatch.setattr(ChunkDataModule, "positions_of", lambda self, tasks: set(self.episode_split.train[:3]))
    assert main([*command, "--tasks", "click_*"]) == 2
    assert "3 training, 0 validation" in capsys.readouterr().err


def test_what_older_checkpoints_do_not_say_of_their_data_is_as_it_was_then(command, capsys):
    checkpoint = Path(command[1])
    content = torch.load(checkpoint, weights_only=True)
    for name in ("state", "action_offset", "layout", "tasks"):
        content["policy"]["data"].pop(name)
    torch.save(content, checkpoint)
    assert main([*command, "--pictures", "0"]) == 0
    content["policy"]["data"]["layout"] = {"cameras": {}, "state": [{"source": 0, "power": 2}], "action": None}
    torch.save(content, checkpoint)
    assert main([*command, "--pictures", "0"]) == 2
    assert "the layout in the checkpoint: expected cameras and joints" in capsys.readouterr().err


def test_numbers_that_make_no_sense_are_refused(command, capsys):
    assert main([*command, "--episodes", "0"]) == 2
    assert "episodes: expected a whole number above 0, got 0" in " ".join(capsys.readouterr().err.split())


def test_commands_are_called_as_the_layout_picked_them(ten_demonstrations, tmp_path, untrained, capsys):
    place = ten_demonstrations / "click_alarmclock" / "demo_clean"
    picked = {"folder": str(place), "layout": Layout(state=("right_joint_2", 0))}
    checkpoint = untrained(TinyPolicy(cameras=CAMERAS, dim=2), tmp_path, picked)
    assert main(["predict", str(checkpoint), "--data", str(place), "--pictures", "1"]) == 0
    said = capsys.readouterr().out
    assert said.index("right joint 2") < said.index("left joint 1")
    assert "left joint 2" not in said
