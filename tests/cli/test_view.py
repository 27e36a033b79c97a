import sys

import numpy as np
import pytest
from made_up import episode
from tiny import TinyPolicy

from ugr_lightning.cli.main import main
from ugr_lightning.cli.view import DISPLAYS
from ugr_lightning.contract import CAMERAS
from ugr_lightning.data.formats import detect
from ugr_lightning.data.layout import Layout
from ugr_lightning.rollout.traces import write_trace
from ugr_lightning.rollout.trajectory import EpisodeTrace
from ugr_lightning.sim.frame import Frame

chunk = pytest.importorskip("rerun.chunk")  # the extra `view`


def read_back(path):
    """By entity, what an `.rrd` file holds on the timeline of control steps: steps, and values of a curve."""
    found = {}
    for part in chunk.RrdReader(path).stream().to_chunks():
        if part.is_static:
            continue
        rows = part.to_record_batch().to_pydict()
        steps, values = found.setdefault(part.entity_path, ([], []))
        steps += rows["control step"]
        values += rows.get("Scalars:scalars", [])
    return found


@pytest.fixture
def folder(recording):
    return recording / "click_alarmclock" / "demo_clean"


def test_a_demonstration_is_a_timeline_of_all_that_it_holds(folder, tmp_path, capsys):
    out = tmp_path / "view.rrd"
    assert main(["view", str(folder), "--episode", "3", "--out", str(out)]) == 0
    form = detect(folder)
    episode = form.read(form.find(folder)[3], form.peek(form.find(folder)[3]).cameras)
    found = read_back(out)
    assert sorted(found["/cameras/cam_high"][0]) == list(range(episode.length))
    assert np.allclose(found["/joints/command"][1], episode.action, atol=1e-6)
    assert np.allclose(found["/joints/state"][1], episode.state, atol=1e-6)
    assert {"/episode/contacts", "/episode/slack", "/episode/phase"} <= set(found)
    assert "view.rrd" in capsys.readouterr().out


def test_predictions_are_shown_at_the_step_they_are_for(ten_demonstrations, untrained, tiny_act, tmp_path):
    checkpoint = untrained(tiny_act(chunk_length=11), tmp_path / "run")
    folder = ten_demonstrations / "click_alarmclock" / "demo_clean"
    arguments = ["--checkpoint", str(checkpoint), "--stride", "1", "--out", str(tmp_path / "view.rrd")]
    assert main(["view", str(folder), *arguments]) == 0
    found = read_back(tmp_path / "view.rrd")
    assert found["/predicted/0_steps_before"][0] == list(range(12))
    assert found["/predicted/10_steps_before"][0] == [10, 11]
    assert "/predicted/25_steps_before" not in found
    assert found["/uncertainty"][0] == list(range(12))


def test_curves_are_called_as_the_layout_of_the_training_picked_them(ten_demonstrations, untrained, tmp_path):
    folder = ten_demonstrations / "click_alarmclock" / "demo_clean"
    picked = {"folder": str(folder), "layout": Layout(state=(13, "left_joint_2"))}
    checkpoint = untrained(TinyPolicy(cameras=CAMERAS, dim=2), tmp_path, picked)
    out = tmp_path / "view.rrd"
    assert main(["view", str(folder), "--checkpoint", str(checkpoint), "--out", str(out)]) == 0
    names = [
        part.to_record_batch().to_pydict()["SeriesLines:names"]
        for part in chunk.RrdReader(out).stream().to_chunks()
        if part.is_static and part.entity_path == "/joints/command"
    ]
    assert names == [[["right_gripper", "left_joint_2"]]]


def test_a_rollout_is_shown_from_its_trace(tmp_path):
    frame = Frame(np.zeros((0, 4, 4, 3)), *np.zeros((2, 14), np.float32), np.zeros((2, 7)), np.zeros(2, bool), True)
    plan, doubt = np.ones((10, 14)), np.zeros(10)
    trace = EpisodeTrace([frame] * 3, [None] * 2, [plan, None], [doubt, None])
    write_trace(tmp_path, episode(5, task="reach", steps=2), trace)
    (path,) = tmp_path.glob("*.npz")
    assert main(["view", str(path), "--out", str(tmp_path / "view.rrd")]) == 0
    found = read_back(tmp_path / "view.rrd")
    assert found["/predicted/0_steps_before"] == ([0], [[1.0] * 14])
    assert found["/episode/contacts"][0] == [0, 1, 2]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "nothing there"),
        (["{folder}", "--episode", "9"], "there are 0 to 4"),
        (["a.ckpt"], "--checkpoint"),
    ],
)
def test_what_cannot_be_shown_is_said(folder, tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.ckpt").touch()
    arguments = [argument.format(folder=folder) for argument in arguments]
    assert main(["view", *arguments, "--out", "view.rrd"]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "view.rrd").exists()


def test_without_a_display_a_file_is_advised_in_place_of_a_window(folder, monkeypatch, capsys):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr("subprocess.call", lambda *_: pytest.fail("opened a viewer"))
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(folder)]) == 2
    assert f"`ugr view {folder} --out view.rrd`" in capsys.readouterr().err


def test_without_the_viewer_the_extra_is_named(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", str(folder), "--out", str(tmp_path / "view.rrd")]) == 2
    assert "ugr-lightning[view]" in capsys.readouterr().err
