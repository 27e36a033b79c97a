"""ACT's two kinds of files, written as their own writers do, are read right; and what we write is such a file."""

import h5py
import numpy as np
import pytest
from foreign_files import ACT_CAMERAS, pictures, replace, waves, write_act
from recordings import record

from ugr_lightning.data.formats import EpisodeLocation, detect, find_format
from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.data.storage.hdf5_frames import RawFrames
from ugr_lightning.errors import ConfigError, DataError


def _read(path, wanted, **layout):
    return detect(path.parent).read(EpisodeLocation(path), wanted, Layout(**layout))


def test_a_processed_episode_is_read_with_its_label_beside_each_state(tmp_path):
    write_act(tmp_path, 1, steps=8)
    vector = waves(9, 14)
    assert detect(tmp_path).name == "act"
    episode = _read(tmp_path / "episode_0.hdf5", ACT_CAMERAS)
    assert (episode.length, episode.image_size, episode.measured) == (8, (24, 32), None)
    assert np.array_equal(episode.state, vector[:-1])
    assert np.array_equal(episode.action, vector[1:])
    for step in (0, 7):
        assert np.array_equal(episode.images(step), [pictures(8, seed=view)[step] for view in range(3)])
    assert np.array_equal(_read(tmp_path / "episode_0.hdf5", ACT_CAMERAS[::-1]).images(3), episode.images(3)[::-1])


def test_frames_are_read_one_at_a_time(tmp_path, monkeypatch):
    write_act(tmp_path, 1)
    read = []
    original = h5py.Dataset.__getitem__

    def watch(dataset, key, *more):
        if "images" in dataset.name:
            read.append(key)
        return original(dataset, key, *more)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", watch)
    episode = _read(tmp_path / "episode_0.hdf5", ACT_CAMERAS)
    assert read == []
    episode.images(5)
    assert read == [5, 5, 5]


def test_xpolicylabs_copies_of_the_format_call_the_head_camera_otherwise(tmp_path):
    write_act(tmp_path, 1, cameras=("cam_head", "cam_right_wrist", "cam_left_wrist"))
    episode = _read(tmp_path / "episode_0.hdf5", ACT_CAMERAS)
    assert np.array_equal(episode.images(2)[0], pictures(14)[2])
    assert detect(tmp_path).peek(EpisodeLocation(tmp_path / "episode_0.hdf5")).cameras == ACT_CAMERAS


@pytest.mark.parametrize("simulated", [True, False])
def test_an_original_episode_is_read_with_the_command_of_its_own_row_as_label(simulated, tmp_path):
    write_act(tmp_path, 1, 8, cameras=("top",), name="episode_3.hdf5", original=True, simulated=simulated)
    form = detect(tmp_path)
    assert form.name == "original-act"
    assert list(form.find(tmp_path)) == [3]
    assert form.peek(form.find(tmp_path)[3]).cameras == ("top",)
    episode = _read(tmp_path / "episode_3.hdf5", ("top",))
    assert (episode.length, episode.cameras, episode.extras["sim"]) == (8, ("top",), simulated)
    assert np.array_equal(episode.action, waves(9, 14)[1:])
    assert np.array_equal(episode.state, waves(9, 14)[:-1])
    assert np.array_equal(episode.measured, episode.state)
    assert np.array_equal(episode.extras["qvel"], waves(8, 14, 100))
    assert np.array_equal(episode.images(7)[0], pictures(8)[7])
    renamed = _read(tmp_path / "episode_3.hdf5", ("cam_high",), cameras={"cam_high": "top"})
    assert np.array_equal(renamed.images(7), episode.images(7))


@pytest.mark.parametrize("joints", [7, 16])
def test_other_robots_are_a_matter_of_the_layout(joints, tmp_path):
    write_act(tmp_path, 1, steps=8, width=joints)
    vector = waves(9, joints)
    with pytest.raises(DataError, match=rf"qpos.*\(T, 14\).*\(8, {joints}\)"):
        _read(tmp_path / "episode_0.hdf5", ACT_CAMERAS)
    assert len(detect(tmp_path).peek(EpisodeLocation(tmp_path / "episode_0.hdf5")).state) == joints
    whole = _read(tmp_path / "episode_0.hdf5", ACT_CAMERAS, state=joints)
    assert np.array_equal(whole.state, vector[:-1])
    picked = _read(tmp_path / "episode_0.hdf5", ("cam_high",), state=(2, Joint(joints - 1, scale=2.0)), action=(0,))
    assert np.allclose(picked.state, vector[:-1, [2, joints - 1]] * [1, 2])
    assert np.array_equal(picked.action, vector[1:, :1])


def test_a_recording_becomes_what_robotwins_converter_writes(tmp_path, episode_file):
    find_format("act").write(tmp_path / "act", [read_episode(episode_file)])
    assert isinstance(_read(tmp_path / "act" / "episode_0.hdf5", ACT_CAMERAS).frames, RawFrames)
    with h5py.File(tmp_path / "act" / "episode_0.hdf5") as file:
        assert sorted(file) == ["action", "observations", "ugr"]
        assert "sim" not in file.attrs
        assert sorted(file["observations"]) == ["images", "left_arm_dim", "qpos", "right_arm_dim"]
        assert file["observations/left_arm_dim"][()].tolist() == [6] * 12
        assert file["observations/left_arm_dim"].dtype == np.int64
        for key in ("action", "observations/qpos"):
            assert (file[key].shape, file[key].dtype) == ((12, 14), np.float32)
        for camera in ACT_CAMERAS:
            pictures = file[f"observations/images/{camera}"]
            assert (pictures.shape, pictures.dtype, pictures.chunks) == ((12, 24, 32, 3), np.uint8, None)


def test_jpegs_that_no_longer_match_the_frames_are_not_used(tmp_path, episode_file):
    find_format("act").write(tmp_path / "act", [read_episode(episode_file)])
    with h5py.File(tmp_path / "act" / "episode_0.hdf5", "r+") as file:
        file["observations/images/cam_high"][3] = 200
    find_format("robotwin").write(tmp_path / "back", [_read(tmp_path / "act" / "episode_0.hdf5", ACT_CAMERAS)])
    back = read_episode(tmp_path / "back" / "data" / "episode0.hdf5")
    assert np.abs(back.images(3)[0].astype(int) - 200).max() <= 2


def test_a_processed_file_of_others_converted_to_a_recording_keeps_joints_to_the_bit_and_pictures_within_a_bound(
    tmp_path, episode_file
):
    find_format("act").write(tmp_path / "act", [read_episode(episode_file)])
    with h5py.File(tmp_path / "act" / "episode_0.hdf5", "r+") as file:
        del file["ugr"]
    given = _read(tmp_path / "act" / "episode_0.hdf5", ACT_CAMERAS)
    find_format("robotwin").write(tmp_path / "back", [given])
    back = read_episode(tmp_path / "back" / "data" / "episode0.hdf5")
    assert np.array_equal(back.state, given.state)
    assert np.array_equal(back.action, given.action)
    worst = max(np.abs(back.images(t).astype(int) - given.images(t)).max() for t in range(given.length))
    assert worst <= 8  # JPEG of quality 95 on these pictures


def test_an_original_file_goes_round_without_loss(tmp_path):
    write_act(tmp_path / "a", 1, 8, cameras=("top",), original=True)
    given = _read(tmp_path / "a" / "episode_0.hdf5", ("top",))
    find_format("original-act").write(tmp_path / "b", [given])
    with h5py.File(tmp_path / "a" / "episode_0.hdf5") as one, h5py.File(tmp_path / "b" / "episode_0.hdf5") as two:
        assert bool(two.attrs["sim"]) is True
        for key in ("action", "observations/qpos", "observations/qvel", "observations/images/top"):
            assert (one[key].dtype, one[key].chunks) == (two[key].dtype, two[key].chunks), key
            assert np.array_equal(one[key], two[key]), key


def test_velocities_that_were_not_recorded_are_differences_of_the_joints(tmp_path, episode_file):
    given = read_episode(episode_file)
    find_format("original-act").write(tmp_path / "original", [given])
    back = _read(tmp_path / "original" / "episode_0.hdf5", ACT_CAMERAS)
    assert np.allclose(back.extras["qvel"][4], (given.measured[4] - given.measured[3]) * 25, rtol=1e-5)
    find_format("act").write(tmp_path / "act", [given])
    with h5py.File(tmp_path / "act" / "episode_0.hdf5", "r+") as file:
        del file.attrs["control_hz"]
    without_rate = _read(tmp_path / "act" / "episode_0.hdf5", ACT_CAMERAS)
    with pytest.raises(DataError, match="control_hz"):
        find_format("original-act").write(tmp_path / "again", [without_rate])
    assert not list((tmp_path / "again").glob("*.hdf5"))


def test_a_folder_of_another_format_is_not_written_into(tmp_path):
    folder = record(tmp_path, count=2)
    with pytest.raises(DataError, match="a folder for act, got demonstrations of robotwin"):
        find_format("act").write(folder, [read_episode(folder / "data" / "episode0.hdf5")])


IMAGE = "observations/images/cam_high"
HOSTILE = {
    "other number of actions": (replace("action", data=np.zeros((9, 14), "f4")), r"action.*\(8, D\).*\(9, 14\)"),
    "no rows": (replace("observations/qpos", data=np.zeros((0, 14))), "qpos.*at least 1 row"),
    "one picture short": (replace(IMAGE, data=np.zeros((7, 24, 32, 3), "u1")), f"{IMAGE}.*8 pictures.*7, 24, 32, 3"),
    "grey": (replace(IMAGE, data=np.zeros((8, 24, 32), "u1")), f"{IMAGE}.*colour pictures.*choose cameras"),
    "pictures as floats": (replace(IMAGE, data=np.zeros((8, 24, 32, 3), "f4")), f"{IMAGE}.*uint8.*float32"),
    "never stored": (
        replace(IMAGE, (8, 24, 32, 3), "u1", chunks=(1, 24, 32, 3)),
        f"{IMAGE}.*stored completely.*0 bytes",
    ),
    "absurd size": (replace(IMAGE, (8, 10**6, 10**6, 3), "u1", chunks=(1, 10, 10, 3)), f"{IMAGE}.*at most"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_damaged_and_foreign_content_is_one_clear_error(case, tmp_path):
    path = write_act(tmp_path, 1, steps=8) / "episode_0.hdf5"
    change, message = HOSTILE[case]
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises((DataError, ConfigError), match=message) as caught:
        _read(path, ACT_CAMERAS)
    assert str(path) in str(caught.value)
