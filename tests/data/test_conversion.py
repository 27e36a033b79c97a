"""Conversions lose nothing that they promise to keep, and leave whole episodes only wherever they are stopped."""

import os
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
from folders import files_of
from foreign_files import write_act
from recordings import record

from ugr_lightning.data.conversion import NOTE, convert, left_out
from ugr_lightning.data.formats import detect, find_format, formats
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.data.selection import Selection
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.system import files as folders

WRITTEN = [form.name for form in formats() if form.writable]


def skip_without_extra(name):
    if name == "lerobot":
        pytest.importorskip("av", reason="the extra `lerobot` is not installed")
        pytest.importorskip("pyarrow", reason="the extra `lerobot` is not installed")


def read_all(folder):
    form = detect(folder)
    return [form.read(location, CAMERAS) for location in form.find(folder).values()]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Three recordings of 5, 8 and 11 steps; not to be changed."""
    return record(tmp_path_factory.mktemp("source"), count=3, steps=5)


def test_the_formats_that_can_be_written_are_known():
    assert WRITTEN == ["act", "lerobot", "original-act", "robotwin"]


@pytest.mark.parametrize("name", WRITTEN)
def test_states_and_actions_are_exact_and_pictures_within_the_codecs_bound(name, recording, tmp_path):
    skip_without_extra(name)
    before = files_of(recording)
    said = []
    given = convert(recording, tmp_path / "out", name, done=lambda *progress: said.append(progress))
    assert detect(tmp_path / "out").name == name
    for one, other in zip(given, read_all(tmp_path / "out"), strict=True):
        assert np.array_equal(one.state, other.state)
        assert np.array_equal(one.action, other.action)
        for step in range(one.length):
            error = np.abs(one.images(step).astype(int) - other.images(step))
            assert error.mean() <= 4 if name == "lerobot" else error.max() == 0
    assert said == [(what, number, 3) for what in ("reading", "writing", "checking") for number in (1, 2, 3)]
    assert not list((tmp_path / "out").rglob("*.partial"))
    assert files_of(recording) == before


@pytest.mark.parametrize("name", WRITTEN)
def test_there_and_back_is_exact(name, recording, tmp_path):
    skip_without_extra(name)
    convert(recording, tmp_path / "there", name)
    convert(tmp_path / "there", tmp_path / "back", "robotwin")
    for one, other in zip(read_all(recording), read_all(tmp_path / "back"), strict=True):
        assert np.array_equal(one.state, other.state)
        assert np.array_equal(one.action, other.action)
        if name in ("act", "robotwin"):
            assert (one.seed, one.extras["task"], one.extras["control_hz"]) == (
                other.seed,
                other.extras["task"],
                other.extras["control_hz"],
            )
            assert [one.frames.jpegs(t) for t in range(one.length)] == [
                other.frames.jpegs(t) for t in range(one.length)
            ]


def test_two_conversions_into_one_folder_at_once_are_refused(recording, tmp_path):
    seen = []

    def begin_another(what, number, total):
        if what == "writing" and not seen:
            with pytest.raises(DataError) as error:
                convert(recording, tmp_path / "out", "act")
            seen.append(str(error.value))

    convert(recording, tmp_path / "out", "act", done=begin_another)
    assert "another conversion" in seen[0]
    assert len(read_all(tmp_path / "out")) == 3
    convert(recording, tmp_path / "out", "act")


def _stop_at(monkeypatch, call):
    """Ends the conversion at the given rename, as a loss of power would: nothing is tidied up."""
    count = 0
    rename = os.replace

    def stopping(source, target):
        nonlocal count
        count += 1
        if count == call:
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr(folders.os, "replace", stopping)


@pytest.mark.parametrize("name", WRITTEN)
def test_stopped_anywhere_it_leaves_whole_episodes_and_goes_on_to_the_same_result(
    name, recording, tmp_path, monkeypatch
):
    skip_without_extra(name)
    whole = convert(recording, tmp_path / "whole", name)
    expected = files_of(tmp_path / "whole")
    renames = len(expected)
    assert renames >= 4
    for call in range(1, renames + 1) if name != "lerobot" else (1, 5, renames):
        out = tmp_path / f"stopped {call}"
        with monkeypatch.context() as patch:
            _stop_at(patch, call)
            with pytest.raises(KeyboardInterrupt):
                convert(recording, out, name)
        there = {path: data for path, data in files_of(out).items() if not path.endswith(".partial")}
        assert len(there) == call - 1
        assert all(expected[path] == data for path, data in there.items())
        times = {path: (out / path).stat().st_mtime_ns for path in there if path != NOTE}
        assert len(convert(recording, out, name)) == len(whole)
        assert files_of(out) == expected
        kept = {path for path, then in times.items() if (out / path).stat().st_mtime_ns == then}
        assert kept >= {path for path in times if path.endswith(".hdf5")}


def test_a_finished_conversion_is_left_as_it_is(recording, tmp_path):
    convert(recording, tmp_path / "out", "act")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.hdf5")}
    convert(recording, tmp_path / "out", "act")
    assert {path: path.stat().st_mtime_ns for path in before} == before


def _something(folder):
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")


def _other_format(folder):
    convert(_source(folder), folder, "original-act")


def _other_cameras(folder):
    convert(_source(folder), folder, "act", cameras=("cam_high",))


def _fewer(folder):
    convert(_source(folder), folder, "act", selection=Selection(episodes=2))


def _other_note(folder):
    folder.mkdir()
    (folder / NOTE).write_text("[1]")


def _file(folder):
    folder.write_text("mine")


def _source(folder):
    return folder.parent / "source"


OTHERS = {
    "something else": (_something, r"an empty folder.*notes\.txt"),
    "another format": (_other_format, "one with other to"),
    "other cameras": (_other_cameras, "one with other cameras and sha256|one with other cameras"),
    "fewer episodes": (_fewer, "one with other episodes"),
    "another note": (_other_note, "the note of a conversion"),
    "a file": (_file, "a folder, got the file"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_a_folder_with_something_else_is_refused_and_left_alone(case, recording, tmp_path):
    shutil.copytree(recording, tmp_path / "source")
    make, message = OTHERS[case]
    make(tmp_path / "out")
    before = files_of(tmp_path)
    with pytest.raises((ConfigError, DataError), match=message):
        convert(tmp_path / "source", tmp_path / "out", "act")
    assert files_of(tmp_path) == before


def test_the_source_is_no_target_and_a_changed_source_is_another_conversion(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "source")
    with pytest.raises(ConfigError, match="another folder than the source"):
        convert(tmp_path / "source", tmp_path / "source" / ".", "act")
    convert(tmp_path / "source", tmp_path / "out", "act")
    shutil.move(tmp_path / "source", tmp_path / "moved")
    convert(tmp_path / "moved", tmp_path / "out", "act")
    shutil.copy(tmp_path / "moved/data/episode1.hdf5", tmp_path / "moved/data/episode0.hdf5")
    with pytest.raises(DataError, match="sha256"):
        convert(tmp_path / "moved", tmp_path / "out", "act")


def test_a_damaged_episode_is_found_before_anything_is_written(recording, tmp_path):
    shutil.copytree(recording, tmp_path / "source")
    (tmp_path / "source/data/episode2.hdf5").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"episode2\.hdf5"):
        convert(tmp_path / "source", tmp_path / "out", "act")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "made", "message"),
    [
        ("original-act", {}, "control_hz.*--rate"),
        ("lerobot", {}, "one rate.*--rate"),
        ("robotwin", {"width": 7}, "two arms.*Convert to `act`"),
    ],
)
def test_what_the_target_needs_is_asked_for_before_anything_is_written(name, made, message, tmp_path):
    skip_without_extra(name)
    source = write_act(tmp_path / "source", 2, **made)
    with pytest.raises(DataError, match=message):
        convert(source, tmp_path / "out", name)
    assert not (tmp_path / "out").exists()
    if name != "robotwin":
        assert len(convert(source, tmp_path / "out", name, rate=17)) == 2


def test_a_stray_file_neither_renumbers_nor_goes_unmentioned(tmp_path, recording):
    source = write_act(tmp_path / "source", 12, steps=4, name="demo_{}.hdf5")
    shutil.copy(source / "demo_9.hdf5", source / "calibration.hdf5")
    with pytest.warns(UserWarning, match=r"source: files that are taken for no demonstrations: calibration\.hdf5$"):
        (only,) = convert(source, tmp_path / "out", "robotwin", selection=Selection(episodes=(2,)))
    assert only.name == "demo_2"


def test_a_full_disk_is_an_error_of_ours_and_the_next_run_goes_on(recording, tmp_path, monkeypatch):
    def full(path, write):
        if path.name == "episode_1.hdf5":
            raise OSError(28, "No space left on device")
        folders.publish(path, write)

    with monkeypatch.context() as patch:
        patch.setattr("ugr_lightning.data.storage.hdf5.publish", full)
        with pytest.raises(DataError, match=r"No space left.*the same command goes on"):
            convert(recording, tmp_path / "out", "act")
    assert len(convert(recording, tmp_path / "out", "act")) == len(list((tmp_path / "out").glob("*.hdf5"))) == 3


def test_numbers_that_do_not_come_back_are_noticed(recording, tmp_path, monkeypatch):
    form = find_format("act")
    write = type(form).fill

    def wrong(self, file, episode):
        write(self, file, episode)
        file["action"][0, 0] += 1e-6

    monkeypatch.setattr(type(form), "fill", wrong)
    with pytest.raises(DataError, match="other numbers"):
        convert(recording, tmp_path / "out", "act")


def test_formats_that_are_only_read_and_unknown_ones_are_refused(recording, tmp_path):
    for name in ("xpolicylab", "maniskill", "zarr"):
        with pytest.raises(ConfigError, match=r"act, .*robotwin"):
            convert(recording, tmp_path / "out", name)
    assert not (tmp_path / "out").exists()


def test_a_layout_cameras_and_a_rate_are_written(recording, tmp_path):
    layout = Layout(state=("left_joint_1", Joint("left_gripper", scale=2.0)), action=(13,))
    options = {"cameras": ("cam_left_wrist",), "layout": layout, "selection": Selection(episodes=2), "rate": 10}
    (first, _) = convert(recording, tmp_path / "out", "original-act", **options)
    form = find_format("original-act")
    contents = form.peek(form.find(tmp_path / "out")[0])
    assert (contents.cameras, len(contents.state), len(contents.action)) == (("cam_left_wrist",), 2, 1)
    source = read_all(recording)[0]
    back = form.read(form.find(tmp_path / "out")[0], contents.cameras, contents.layout)
    assert np.array_equal(back.action[:, 0], source.action[:, 13])
    assert np.allclose(back.state[:, 1], 2 * source.state[:, 6])
    assert np.allclose(back.extras["qvel"][1:], np.diff(first.measured, axis=0) * 10)


LOST = ["contacts", "endpose", "measured", "phase", "projection", "slack"]


def test_what_has_no_place_in_the_target_is_told(recording, tmp_path):
    episodes = convert(recording, tmp_path / "out", "act")
    assert left_out(find_format("act"), tmp_path / "out", episodes) == LOST
    again = convert(recording, tmp_path / "again", "robotwin")
    assert left_out(find_format("robotwin"), tmp_path / "again", again) == LOST
    original = convert(recording, tmp_path / "original", "original-act")
    assert left_out(find_format("original-act"), tmp_path / "original", original) == [
        name for name in LOST if name != "measured"
    ]


@pytest.mark.parametrize("name", WRITTEN)
def test_measured_joints_come_back_as_they_were_or_not_at_all_and_are_told(name, recording, tmp_path):
    skip_without_extra(name)
    given = convert(recording, tmp_path / "out", name)
    assert not any(np.array_equal(one.measured, one.state) for one in given)
    back = read_all(tmp_path / "out")
    told = "measured" in left_out(find_format(name), tmp_path / "out", given)
    assert all(other.measured is None for other in back) == told
    assert told or all(np.array_equal(one.measured, other.measured) for one, other in zip(given, back, strict=True))


def test_the_original_act_finds_measured_joints_and_their_velocities(recording, tmp_path):
    convert(recording, tmp_path / "out", "original-act")
    convert(recording, tmp_path / "act", "act")
    convert(tmp_path / "act", tmp_path / "again", "original-act")
    for index, one in enumerate(read_all(recording)):
        with h5py.File(tmp_path / f"out/episode_{index}.hdf5") as file:
            assert np.array_equal(file["observations/qpos"], one.measured)
            assert np.allclose(file["observations/qvel"][1:], np.diff(one.measured, axis=0) * 25)
    for one, other in zip(read_all(tmp_path / "act"), read_all(tmp_path / "again"), strict=True):
        assert np.array_equal(one.state, other.state)
        assert other.measured is None, "nobody has measured them"


def test_velocities_of_other_joints_are_not_taken_along(tmp_path):
    write_act(tmp_path / "source", 2, original=True)
    options = {"layout": Layout(state=(2, 0)), "rate": 10}
    convert(tmp_path / "source", tmp_path / "out", "original-act", **options)
    with h5py.File(tmp_path / "out/episode_0.hdf5") as file:
        assert np.allclose(file["observations/qvel"][1:], np.diff(file["observations/qpos"], axis=0) * 10)


def test_a_value_that_comes_back_as_another_is_told(recording, tmp_path, monkeypatch):
    episodes = convert(recording, tmp_path / "out", "act")
    changed = [*episodes[:-1], replace(episodes[-1], seed=77)]
    assert left_out(find_format("act"), tmp_path / "out", changed) == sorted([*LOST, "seed"])


def test_measured_joints_that_were_not_measured_are_noticed(recording, tmp_path, monkeypatch):
    form = type(find_format("act"))
    monkeypatch.setattr(form, "_read_joints", lambda self, file, qpos: (qpos, qpos))
    with pytest.raises(DataError, match="other numbers"):
        convert(recording, tmp_path / "out", "act")
