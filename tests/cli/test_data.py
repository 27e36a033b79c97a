"""`ugr data`: what a folder is, in words and pictures, and in another format."""

import json
import shutil
from pathlib import Path

import h5py
import pytest
from PIL import Image

from ugr_lightning.cli.main import main
from ugr_lightning.data.formats import detect


@pytest.fixture
def folder(recording, monkeypatch, tmp_path):
    """Five demonstrations of 12 steps; the working folder is an empty one."""
    monkeypatch.chdir(tmp_path)
    return recording / "click_alarmclock" / "demo_clean"


def test_inspecting_says_everything_and_both_commands_say_the_same(folder, capsys):
    assert main(["data", "inspect", str(folder), "--picture", "one.png"]) == 0
    told = capsys.readouterr().out
    assert main(["inspect", str(folder), "--picture", "one.png"]) == 0
    assert capsys.readouterr().out == told
    for line in (
        "robotwin, 5 demonstrations, all readable",
        "steps       12 to 12 decision steps, mean 12, 60 in all",
        "rate        25 steps per second",
        "cameras     cam_high 8x12, cam_right_wrist 8x12, cam_left_wrist 8x12 (height x width), JPEGs with red",
        "seeds       0, 1, 2, 3, 4",
        "task        click_alarmclock",
        "action[t] is a command of its own: state[t+1] in 0 and state[t] in 0 of 55 steps",
        "keyframes   pins from the table to the tool",
        "right_joint_6",
        "oddities    5 episodes shorter than a chunk of 50 steps: 0, 1, 2, 3, 4",
    ):
        assert line in told, line
    assert Image.open("one.png").size == (3 * 12, 5 * 3 * 8)


def test_options_choose_what_is_looked_at(folder, capsys):
    options = ["--cameras", '["cam_high"]', "--layout.state", '[0, "left_gripper"]', "--episodes", "2"]
    assert main(["data", "inspect", str(folder), *options, "--chunk_length", "12"]) == 0
    told = capsys.readouterr().out
    assert "2 of 5 demonstrations" in told
    assert "(2 columns;" in told
    assert "cam_left_wrist" not in told
    assert "shorter" not in told
    assert Image.open("click_alarmclock-demo_clean.png").size == (12, 2 * 3 * 8)


def test_a_contact_sheet_takes_the_place_of_its_own_only(folder, capsys):
    for copy in ("a/hanging_mug/demo_clean", "b/hanging_mug/demo_clean", "b/open_microwave/demo_clean"):
        shutil.copytree(folder, copy)
    for _ in range(2):
        assert main(["data", "inspect", "a/hanging_mug/demo_clean"]) == 0
    assert main(["data", "inspect", "b/open_microwave/demo_clean/"]) == 0
    assert main(["data", "inspect", "b/open_microwave/demo_clean/data/episode1.hdf5"]) == 0
    names = ["hanging_mug-demo_clean", "open_microwave-demo_clean", "open_microwave-demo_clean-episode1"]
    assert sorted(path.stem for path in Path().glob("*.png")) == names
    Path("mine.png").write_text("mine")
    before = {path: path.read_bytes() for path in Path().glob("*.png")}
    capsys.readouterr()
    for more in (["--picture", "hanging_mug-demo_clean.png"], ["--picture", "mine.png"], ["--picture", "a"]):
        assert main(["data", "inspect", "b/hanging_mug/demo_clean", *more]) == 2
        error = capsys.readouterr().err
        assert "expected nothing, or an earlier contact sheet of b/hanging_mug/demo_clean" in error
        assert "choose another place: `--picture FILE.png`" in error
    assert {path: path.read_bytes() for path in Path().glob("*.png")} == before
    assert main(["data", "inspect", "b/hanging_mug/demo_clean"]) == 0
    assert {path.name for path in Path().glob("*.png") if path not in before} == {"b-hanging_mug-demo_clean.png"}
    assert {path: path.read_bytes() for path in before} == before


def test_an_unreadable_episode_is_the_exit_code(folder, capsys):
    shutil.copytree(folder, "copy")
    path = Path("copy/data/episode1.hdf5")
    path.write_bytes(path.read_bytes()[:3000])
    assert main(["data", "inspect", "copy"]) == 2
    told = capsys.readouterr().out
    assert "1 of them UNREADABLE" in told
    assert f"UNREADABLE  1: {path}" in told


def test_converting_writes_says_what_was_lost_and_goes_on(folder, capsys):
    for _ in range(2):
        assert main(["data", "convert", str(folder), "out", "--to", "act"]) == 0
        told = capsys.readouterr()
        assert "out: 5 episodes, 60 steps as act; states and actions are the same to the bit" in told.out
        assert "left out    contacts, endpose, measured, phase, projection, slack" in told.out
        assert "checking: 5/5" in told.err
    assert main(["data", "inspect", "out"]) == 0
    assert "no policy with `keyframes` learns from them; missing: tool poses (`endpose`)" in capsys.readouterr().out
    assert main(["data", "convert", "out", "back", "--to", "robotwin", "--episodes", "3"]) == 0
    form = detect("back")
    assert (form.name, len(form.find("back"))) == ("robotwin", 3)
    with h5py.File(folder / "data/episode2.hdf5") as one, h5py.File("back/data/episode2.hdf5") as two:
        for key in ("joint_action/vector", "observation/head_camera/rgb"):
            assert (one[key][:12] == two[key][:12]).all(), key
    assert json.loads(Path("back/conversion.json").read_text())["to"] == "robotwin"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data"], "one of inspect, convert"),
        (["data", "look"], "one of inspect, convert"),
        (["data", "inspect"], "path"),
        (["data", "inspect", "nowhere"], "nothing there"),
        (["data", "inspect", ".", "--episodes", "0"], "at least 1"),
        (["data", "convert", "{folder}", "out"], "to"),
        (["data", "convert", "{folder}", "out", "--to", "xpolicylab"], "robotwin, got xpolicylab"),
        (
            ["data", "convert", "{folder}", "out", "--to", "act", "--rate", "0"],
            "--rate: expected a number of steps",
        ),
        (["data", "convert", "{folder}", "out", "--to", "act", "--cameras", '["top"]'], "top"),
        (["data", "convert", "{folder}", "{folder}", "--to", "act"], "another folder than the source"),
        (["data", "convert", "{folder}", "out", "--to", "lerobot", "--rate", "1e300"], "no more than 1e5, got 1e+300"),
        (["data", "convert", "{folder}", "out", "act"], "Write `--NAME act`"),
        (
            ["data", "inspect", "{folder}", "--layout.state", "0"],
            "data.layout.state: expected at least one joint, got 0.",
        ),
        (
            ["data", "inspect", "{folder}", "--chunk_length", "0"],
            "chunk_length: expected a whole number above 0, got 0.",
        ),
        (["data", "inspect", "{folder}", "--picture", "{folder}/seed.txt/a.png"], "a part of it is a file"),
    ],
)
def test_what_cannot_work_is_one_message_and_exit_code_2(arguments, message, folder, capsys):
    assert main([argument.replace("{folder}", str(folder)) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
