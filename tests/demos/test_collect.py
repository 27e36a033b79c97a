import contextlib
import hashlib
import json
import os
import select
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from fake_simulator import MARKER, STEPS, FakeSimulator

from ugr_lightning.data.folder import episode_path, find_episodes, read_scene_info, read_seeds
from ugr_lightning.data.formats import find_format
from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.demos.collect import EVERY, collect
from ugr_lightning.demos.executed import read_executed
from ugr_lightning.demos.noise import Noise
from ugr_lightning.demos.recorder import Recorder, staged_episode
from ugr_lightning.errors import ConfigError, DataError, SimulationError
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.system.lock import locked

pytestmark = pytest.mark.usefixtures("fake_tasks")

SMALL = {"image_size": (24, 32), "progress": False}
SOLVED = [0, 1, 2, 4, 5, 6, 7]  # the expert gives up on 3


def record(folder, episodes=5, workers=1, task="reach", **more):
    collect(task, folder, episodes=episodes, workers=workers, **(SMALL | more))


def content(folder):
    names = ["seed.txt", "scene_info.json", "recording.json", *(f"data/episode{i}.hdf5" for i in range(9))]
    paths = [folder / name for name in names if (folder / name).exists()]
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


@pytest.fixture(scope="module")
def reference(tmp_path_factory, fake_tasks):
    folder = tmp_path_factory.mktemp("reference")
    record(folder)
    return folder


def test_folder_has_the_layout_of_robotwin(reference):
    assert sorted(find_episodes(reference)) == [0, 1, 2, 3, 4]
    assert read_seeds(reference) == SOLVED[:5]
    assert [read_scene_info(reference)[i]["seed"] for i in range(5)] == SOLVED[:5]
    assert json.loads((reference / "instructions" / "episode4.json").read_text())["seen"]
    names = {path.name for path in reference.iterdir()}
    assert names == {"data", "instructions", "seed.txt", "scene_info.json", "recording.json", "recording.lock"}


def test_an_episode_has_one_frame_more_than_steps_and_the_intention_as_its_label(reference):
    episode = read_episode(episode_path(reference, 3))
    assert (episode.length, episode.seed) == (STEPS, SOLVED[3])
    assert episode.extras["phase"][0] == "reach"
    intended = FakeSimulator("reach", image_size=(2, 2))
    intended.reset(SOLVED[3])
    labels = np.stack([step.action for step in intended.expert()])
    assert np.allclose(episode.action, labels, atol=1e-6)
    executed = episode.state[1:]  # (N - 1, 14): what was in force after each step
    strayed = np.abs(executed - labels[:-1])
    assert strayed[:7, 0].max() > 1e-3
    assert not strayed[:, [6, 13]].any()
    assert not strayed[8:].any()


def test_workers_and_interruptions_do_not_change_the_data_set(reference, tmp_path):
    record(tmp_path, episodes=2, workers=3)
    record(tmp_path, workers=3)
    assert content(tmp_path) == content(reference)


def test_a_complete_folder_is_left_alone(reference, monkeypatch):
    before = content(reference)
    monkeypatch.setattr("ugr_lightning.demos.collect.spread", lambda *_, **__: pytest.fail("opened a simulator"))
    record(reference, episodes=4)
    assert content(reference) == before


def test_a_removed_episode_is_recorded_again_as_it_was(reference, tmp_path):
    record(tmp_path, episodes=3)
    before = content(tmp_path)
    episode_path(tmp_path, 1).unlink()
    record(tmp_path, episodes=3)
    assert content(tmp_path) == before


SCRIPT = """
import sys; sys.path[:0] = {folders!r}
from test_collect import record
record({folder!r}, workers=2, part={part!r})
"""


def start(folder, part=EVERY):
    here = Path(__file__).parent
    code = SCRIPT.format(folders=[str(here), str(here.parent / "stand_ins")], folder=str(folder), part=part)
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE)


def wait_for_first_episode(folder, process):
    while process.poll() is None and not any(folder.glob("**/*.hdf5")):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.02)


def watch_children(pid):
    """File descriptors that become readable when the children of a process end."""
    return [os.pidfd_open(int(word)) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_kill_at_any_moment_leaves_a_folder_that_can_be_completed(reference, tmp_path, how):
    process = start(tmp_path)
    wait_for_first_episode(tmp_path, process)
    workers = watch_children(process.pid)
    assert len(workers) == 2
    os.kill(process.pid, how)
    process.communicate()
    for worker in workers:
        assert select.select([worker], [], [], 30)[0], "a process was left behind"
        os.close(worker)
    record(tmp_path)
    assert content(tmp_path) == content(reference)


def test_parts_recorded_side_by_side_make_the_data_set_of_one_recording(reference, tmp_path):
    parts = [slice(first, None, 3) for first in range(3)]
    with locked(tmp_path / "recording.lock", "another part", shared=True):
        record(tmp_path, part=parts[0])
        killed = start(tmp_path, parts[1])
        wait_for_first_episode(tmp_path / "staging", killed)
        killed.kill()
        killed.communicate()
        for part in parts[1:]:
            record(tmp_path, part=part)
    assert not find_episodes(tmp_path), "they wait for one that has the whole"
    record(tmp_path)
    record(tmp_path, part=parts[0])
    assert content(tmp_path) == content(reference)
    assert not (tmp_path / "staging").exists()


def test_a_part_is_not_recorded_twice_and_what_is_missing_afterwards_is(reference, tmp_path):
    record(tmp_path, episodes=2)
    part = slice(1, None, 2)  # of the seeds 2, 3, 4, 5 ... every second: 3, which fails, and 5
    record(tmp_path, part=part)
    staged = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "staging").glob("*.hdf5")}
    assert list(staged) == ["seed5.hdf5"]
    record(tmp_path, part=part)
    assert staged == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "staging").glob("*.hdf5")}
    record(tmp_path)
    assert content(tmp_path) == content(reference)


def test_a_kill_while_an_episode_is_filed_loses_nothing(reference, tmp_path, monkeypatch):
    real = os.replace
    for episodes, moment in enumerate(["seed.txt", "scene_info.json", "episode2.json"], start=1):

        def stop(source, target, episodes=episodes, moment=moment):
            real(source, target)
            if Path(target).name == moment and len(read_seeds(tmp_path)) == episodes:
                raise KeyboardInterrupt

        monkeypatch.setattr(os, "replace", stop)
        with pytest.raises(KeyboardInterrupt):
            record(tmp_path)
        assert len(find_episodes(tmp_path)) == len(read_seeds(tmp_path)) - 1
    monkeypatch.undo()
    for name in ("seed.txt.1.partial", "scene_info.json.1.partial", "instructions/episode0.json.1.partial"):
        (tmp_path / name).touch()  # as SIGKILL leaves them
    record(tmp_path)
    assert content(tmp_path) == content(reference)
    assert not list(tmp_path.rglob("*.partial"))


def test_another_recording_in_the_folder_is_an_error_that_says_what_differs(reference):
    with pytest.raises(DataError, match=r"'std': 0.1.*'std': 0.04"):
        record(reference, noise=Noise(std=0.1))
    with pytest.raises(DataError, match=r"image_size \[12, 16\]"):
        record(reference, episodes=9, image_size=(12, 16))


def test_episodes_from_elsewhere_are_enough_or_an_error(reference, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "episode0.hdf5").write_bytes(episode_path(reference, 0).read_bytes())
    record(tmp_path, episodes=1)
    with pytest.raises(DataError, match="1 episodes from elsewhere"):
        record(tmp_path, episodes=2)
    assert [path.name for path in tmp_path.glob("*/*")] == ["episode0.hdf5"]


def test_nothing_is_recorded_into_a_folder_of_another_format(reference, tmp_path):
    find_format("act").write(tmp_path, [read_episode(episode_path(reference, 0))])
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(DataError, match="a folder to record into, got demonstrations of the format act"):
        record(tmp_path, episodes=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_seed_that_kills_its_process_is_tried_again(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv(MARKER, str(tmp_path / "marker"))
    record(tmp_path / "data", episodes=4, task="deadly_once")
    assert read_seeds(tmp_path / "data") == SOLVED[:4]
    assert (
        "Seed 2: process 1 was ended by SIGKILL, as the system does when memory runs out; trying"
        in capsys.readouterr().err
    )


def test_a_seed_that_kills_its_process_twice_is_skipped(tmp_path, capsys):
    record(tmp_path, episodes=3, workers=2, task="deadly")
    assert read_seeds(tmp_path) == [0, 1, 4]
    assert "skipped" in capsys.readouterr().err


def test_a_seed_that_is_skipped_is_told_with_where_the_expert_could_not_reach(tmp_path, capsys):
    record(tmp_path, episodes=4, task="out_of_reach")
    assert read_seeds(tmp_path) == SOLVED[:4]
    told = "Seed 3 is skipped: left arm, phase `reach`: expected a tool pose within its reach, got position [9.0, 0.0"
    assert told in capsys.readouterr().err


def test_a_task_that_the_expert_cannot_do_is_an_error(tmp_path):
    with pytest.raises(SimulationError, match="50 seeds in a row"):
        record(tmp_path, task="unsolvable", noise=Noise(std=0))


def test_a_disk_that_cannot_be_written_to_is_one_error(tmp_path):
    (tmp_path / "staging").write_text("a file where a folder should be")
    with pytest.raises(DataError, match="run the same command again"):
        record(tmp_path, episodes=1)


def test_a_video_is_written_when_asked_for(tmp_path):
    record(tmp_path, episodes=1, video=True)
    assert (tmp_path / "video" / "episode0.mp4").stat().st_size > 0


def test_impossible_numbers_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="0 episodes"):
        record(tmp_path, episodes=0)


def test_a_recording_says_its_setting_and_a_folder_holds_one_setting(tmp_path):
    record(tmp_path, episodes=1, setting="demo_randomized")
    assert read_episode(episode_path(tmp_path, 0)).extras["setting"] == "demo_randomized"
    assert json.loads((tmp_path / "recording.json").read_text())["setting"] == "demo_randomized"
    with pytest.raises(DataError, match="got setting 'demo_randomized'"):
        record(tmp_path, episodes=2, setting="demo_clean")


def test_a_folder_of_another_version_of_the_task_is_not_added_to(tmp_path, monkeypatch):
    monkeypatch.setattr("ugr_lightning.demos.collect.all_task_names", lambda: ("reach",))
    monkeypatch.setattr("ugr_lightning.demos.collect.task_version", lambda task: 1)
    record(tmp_path, episodes=1)
    monkeypatch.setattr("ugr_lightning.demos.collect.task_version", lambda task: 2)
    with pytest.raises(DataError, match="a recording with task_version 2, got task_version 1"):
        record(tmp_path, episodes=2)
    path = tmp_path / "recording.json"
    content = json.loads(path.read_text())
    del content["task_version"]  # as older recordings are
    path.write_text(json.dumps(content))
    record(tmp_path, episodes=2)
    assert read_seeds(tmp_path) == [0, 1]


def test_a_wrong_task_or_setting_leaves_no_folder(tmp_path):
    for wrong in ({"task": "click_alarm_clock"}, {"task": "click_alarmclock", "setting": "demo_dirty"}):
        with pytest.raises(ConfigError, match="expected"):
            record(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_a_robot_of_one_arm_is_recorded_with_its_seven_joints_and_an_undisturbed_gripper(tmp_path):
    recorder = Recorder(partial(open_simulator, "one_arm", image_size=(24, 32)), Noise(std=0.02), tmp_path)
    assert recorder.record(0).failure is None
    executed = read_executed(staged_episode(tmp_path, 0))
    assert executed.actions.shape == (STEPS, 7)
    assert executed.measured.shape == (STEPS + 1, 7)
    assert (executed.actions[:, 6] == 1).all()
    with h5py.File(staged_episode(tmp_path, 0)) as file:
        assert file["joint_action/left_arm"].shape == (STEPS + 1, 6)
        assert "right_arm" not in file["joint_action"]
        assert list(file["observation"]) == ["top"]


@pytest.mark.parametrize(("noise", "known"), [(0.02, True), (0.0, True), (0.02, False)])
def test_a_recording_with_noise_tells_where_the_tools_of_a_robot_we_know_were_meant_to_be(
    tmp_path, monkeypatch, noise, known
):
    monkeypatch.setattr(FakeSimulator, "viperx", known)
    recorder = Recorder(partial(open_simulator, "reach", image_size=(24, 32)), Noise(std=noise), tmp_path)
    assert recorder.record(0).failure is None
    with h5py.File(staged_episode(tmp_path, 0)) as file:
        slack, were = file["ugr/slack"][()], file["endpose/left_endpose"][()]
        told = bool(noise and known)
        assert ("intended_endpose" in file["ugr"]) == told
        if told:
            moved = np.abs(file["ugr/intended_endpose"][:, 0, :3] - were[:, :3]).max(1)
            assert (moved[1:] > 0).tolist() == (slack > 0).tolist()
