"""Robots, cameras and files that are not ours: read, inspected, converted, or refused with advice that is right."""

import errno
import os
import subprocess
import sys

import h5py
import numpy as np
import pytest
from foreign_files import pictures, waves, write_act, write_maniskill, write_robotwin
from recordings import prepared

from ugr_lightning.data.conversion import convert
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.formats import detect
from ugr_lightning.data.inspection import inspect_demonstrations
from ugr_lightning.data.layout import Layout
from ugr_lightning.data.oddities import find_oddities
from ugr_lightning.data.storage.hdf5 import open_hdf5
from ugr_lightning.errors import ConfigError, DataError


def first_batch(folder, cameras, **options):
    """One batch of training on a folder."""
    data = ChunkDataModule(folder=str(folder), cameras=cameras, episodes=4, chunk_length=5, batch_size=3, **options)
    return next(iter(prepared(data).train_dataloader()))


ROBOTS = {
    "two arms of seven joints": (lambda folder: write_robotwin(folder, joints=7), 16),
    "one arm of seven joints": (lambda folder: write_act(folder, width=8, cameras=("top",)), 8),
    "the head camera only": (lambda folder: write_robotwin(folder, cameras=("head_camera",)), 14),
    "whole numbers": (lambda folder: write_act(folder, dtype=np.int32), 14),
    "compressed pictures": (lambda folder: write_act(folder, compress=True), 14),
    "files of other names": (lambda folder: write_act(folder, name="demo_{}.h5"), 14),
}


@pytest.mark.parametrize("robot", ROBOTS)
def test_other_robots_are_inspected_trained_on_and_converted(robot, tmp_path):
    make, width = ROBOTS[robot]
    folder = make(tmp_path / "source")
    found = inspect_demonstrations(folder)
    assert not found.unreadable
    assert len(found.seen) == 5
    assert {rows.shape[1] for rows in found.rows("state")} == {width}
    find_oddities(found, 50)
    batch = first_batch(folder, found.contents.cameras, layout=Layout(state=width))
    assert batch.state.shape == (3, width)
    assert batch.actions.shape == (3, 5, width)
    convert(folder, tmp_path / "act", "act")
    back = inspect_demonstrations(tmp_path / "act")
    assert all(np.array_equal(*both) for both in zip(back.rows("action"), found.rows("action"), strict=True))


@pytest.mark.parametrize("write", [write_act, write_robotwin])
def test_cameras_of_different_sizes_are_trained_on_at_one_size(write, tmp_path):
    wrist = "cam_left_wrist" if write is write_act else "left_camera"
    folder = write(tmp_path / "source", sizes={wrist: (48, 40)})
    cameras = ("cam_high", "cam_left_wrist")
    assert first_batch(folder, cameras, image_size=(12, 16)).images.shape == (3, 2, 3, 12, 16)
    with pytest.raises(ConfigError, match=r"data\.image_size.*\[24,32\]"):
        first_batch(folder, cameras)
    found = inspect_demonstrations(folder)
    assert found.seen[0].views["cam_left_wrist"].size == (48, 40)
    convert(folder, tmp_path / "act", "act")
    assert inspect_demonstrations(tmp_path / "act").seen[0].views["cam_left_wrist"].size == (48, 40)


def test_compressed_pictures_have_the_colours_that_were_recorded(tmp_path):
    folder = write_act(tmp_path, compress=True, original=True)
    form = detect(folder)
    assert form.name == "original-act"
    episode = form.read(form.find(folder)[2], ("cam_right_wrist",))
    error = np.abs(episode.images(3)[0].astype(int) - pictures(14, seed=11)[3])
    assert np.median(error) < 6, "a swap of red and blue would be an error of 120"


OTHERS = {
    "depth": np.zeros((14, 24, 32), np.uint16),
    "grey": np.zeros((14, 24, 32, 1), np.uint8),
    "channels first": np.zeros((14, 3, 24, 32), np.uint8),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_a_camera_without_colour_is_left_out_and_said_so(kind, tmp_path):
    folder = write_act(tmp_path / "source")
    for path in folder.iterdir():
        with h5py.File(path, "r+") as file:
            file["observations/images/odd"] = OTHERS[kind]
    found = inspect_demonstrations(folder)
    assert not found.unreadable
    assert "odd" not in found.seen[0].views
    assert [line for line in find_oddities(found, 5) if "without colour pictures" in line and "odd" in line]
    assert len(convert(folder, tmp_path / "out", "act")) == 5
    form = detect(folder)
    with pytest.raises(DataError, match="choose cameras with colour"):
        form.read(form.find(folder)[0], ("odd",))


@pytest.mark.parametrize("steps", [1, 2, 5, 11])
def test_short_episodes_are_inspected(steps, tmp_path):
    found = inspect_demonstrations(write_act(tmp_path, steps=steps))
    assert [one.episode.length for one in found.seen] == [steps] * 5
    assert any("shorter than a chunk" in line for line in find_oddities(found, 50))


def test_what_maniskill_observed_beside_the_joints_can_be_part_of_the_state(tmp_path):
    folder = write_maniskill(tmp_path)
    form = detect(folder)
    location = form.find(folder)[1]
    contents = form.peek(location)
    assert (len(contents.state), contents.further) == (9, ("is_grasped", *(f"tcp_pose_{i}" for i in range(7))))
    layout = Layout(state=(0, 8, "tcp_pose_2", "is_grasped"), action=8)
    episode = form.read(location, ("base_camera",), layout)
    expected = [waves(13, 9, 1)[:-1, 0], waves(13, 9, 1)[:-1, 8], waves(13, 7, 2)[:-1, 2], np.arange(12) > 5]
    assert np.array_equal(episode.state, np.stack(expected, axis=1).astype(np.float32))
    assert form.read(location, ("base_camera",), Layout(state=9, action=8)).state.shape == (12, 9)


def test_where_maniskills_replay_left_both_files_the_translated_one_is_read(tmp_path):
    write_maniskill(tmp_path, "trajectory", mode="pd_ee_delta_pose", cameras=())
    write_maniskill(tmp_path, "trajectory.rgb.pd_joint_pos", lengths=(12, 12, 12))
    form = detect(tmp_path)
    assert {place.path.name for place in form.find(tmp_path).values()} == {"trajectory.rgb.pd_joint_pos.h5"}
    assert len(inspect_demonstrations(tmp_path).seen) == 3


def test_a_file_that_is_being_written_or_may_not_be_read_is_called_that(tmp_path, monkeypatch):
    path = write_act(tmp_path) / "episode_0.hdf5"
    program = "import h5py, sys; file = h5py.File(sys.argv[1], 'r+'); print('open', flush=True); sys.stdin.read()"
    writer = subprocess.Popen([sys.executable, "-c", program, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert writer.stdout.readline()
        with pytest.raises(DataError, match="another program has locked") as caught, open_hdf5(path):
            pass
        assert "out of the folder" not in str(caught.value)
    finally:
        writer.communicate()
    denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    monkeypatch.setattr(h5py, "File", lambda *given, **options: (_ for _ in ()).throw(denied))
    with pytest.raises(DataError, match="no permission"), open_hdf5(path):
        pass
