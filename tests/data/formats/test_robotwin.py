"""Demonstration files survive the round trip, and nothing damaged or foreign gets past the reader."""

import dataclasses
import io

import h5py
import numpy as np
import pytest
from foreign_files import ROBOTWIN_CAMERAS, marked_jpeg, pictures, poke, replace, waves, write_robotwin
from PIL import Image
from recordings import arrays

from ugr_lightning.data.folder import episode_path
from ugr_lightning.data.formats import detect, find_format, robotwin
from ugr_lightning.data.formats.robotwin import read_episode, write_episode
from ugr_lightning.data.layout import Layout
from ugr_lightning.data.storage.jpeg import encode_frame, encode_jpeg
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, DataError

VECTOR = "joint_action/vector"
HEAD = "observation/head_camera/rgb"


def test_the_numbers_of_an_episode_come_back_exactly(tmp_path):
    given = arrays(steps=9, seed=4)
    write_episode(episode_path(tmp_path, 4), **given)
    episode = read_episode(episode_path(tmp_path, 4))
    assert (episode.length, episode.seed, episode.name, episode.image_size) == (9, 4, "episode4", (24, 32))
    np.testing.assert_array_equal(episode.state, given["commanded"][:-1])
    np.testing.assert_array_equal(episode.measured, given["measured"][:-1])
    np.testing.assert_array_equal(episode.action, given["expert_action"])
    np.testing.assert_array_equal(episode.extras["contacts"], given["contacts"])
    np.testing.assert_array_equal(episode.extras["slack"], given["slack"])
    assert episode.extras["phase"] == tuple(given["phase"])
    assert episode.extras["task"] == "click_alarmclock"
    assert episode.extras["control_hz"] == 25.0


def test_pictures_come_back_in_true_rgb_and_in_the_order_asked_for(tmp_path):
    given = arrays(steps=3)
    write_episode(episode_path(tmp_path, 0), **given)
    for step in range(3):
        got = read_episode(episode_path(tmp_path, 0)).images(step).astype(int)
        assert np.abs(got - given["images"][step]).max() <= 8  # what JPEG at quality 95 costs here
    swapped = read_episode(episode_path(tmp_path, 0), ("cam_left_wrist", "cam_high")).images(1).astype(int)
    assert np.abs(swapped - given["images"][1][[2, 0]]).max() <= 8


def test_files_have_robotwins_colour_order_for_other_viewers(tmp_path):
    images = np.zeros((2, 3, 24, 32, 3), np.uint8)
    images[..., 0] = 200  # red
    write_episode(episode_path(tmp_path, 0), **arrays(steps=1, images=images))
    with h5py.File(episode_path(tmp_path, 0)) as file:
        seen = np.asarray(Image.open(io.BytesIO(bytes(file[HEAD][0]))))
    assert seen[12, 16, 2] > 190
    assert seen[12, 16, 0] < 10


def test_jpegs_marked_as_true_rgb_are_not_swapped(tmp_path):
    images = np.zeros((3, 24, 32, 3), np.uint8)
    images[..., 0] = 200
    marked = [marked_jpeg(encode_jpeg(image[..., ::-1])) for image in images]  # true RGB on disk
    write_episode(episode_path(tmp_path, 0), **arrays(steps=1, images=[marked, marked]))
    assert read_episode(episode_path(tmp_path, 0)).images(0)[0, 12, 16].tolist()[0] > 190


def test_tool_poses_are_those_without_noise_where_a_file_tells_them(tmp_path):
    given = arrays()
    write_episode(tmp_path / "plain.hdf5", **given)
    np.testing.assert_allclose(read_episode(tmp_path / "plain.hdf5").endpose, given["endpose"], rtol=1e-6)
    meant = given["endpose"] + 0.01
    write_episode(tmp_path / "noisy.hdf5", **given, intended_endpose=meant)
    np.testing.assert_allclose(read_episode(tmp_path / "noisy.hdf5").endpose, meant, rtol=1e-6)


def test_the_layout_on_disk_is_robotwins(episode_file):
    given = arrays()
    with h5py.File(episode_file) as file:
        assert file[VECTOR].shape == (13, 14)
        for key in (VECTOR, "joint_action/left_arm", "joint_action/right_gripper", "endpose/left_endpose"):
            assert file[key].dtype == np.float64, key
        np.testing.assert_array_equal(file["joint_action/left_arm"], given["commanded"][:, :6])
        np.testing.assert_array_equal(file["joint_action/left_gripper"], given["commanded"][:, 6])
        np.testing.assert_array_equal(file["joint_action/right_arm"], given["commanded"][:, 7:13])
        np.testing.assert_array_equal(file["joint_action/right_gripper"], given["commanded"][:, 13])
        np.testing.assert_array_equal(file["endpose/right_endpose"], given["endpose"][:, 1])
        np.testing.assert_array_equal(file["endpose/right_gripper"], given["commanded"][:, 13])
        assert file["pointcloud"].shape == (13, 0)
        for camera in ("head_camera", "left_camera", "right_camera"):
            rgb = file[f"observation/{camera}/rgb"]
            assert rgb.dtype.kind == "S"
            assert rgb.dtype.itemsize == max(len(jpeg) for jpeg in rgb[()])
            assert bytes(rgb[0]).endswith(b"\xff\xd9")
            assert file[f"observation/{camera}/intrinsic_cv"].shape == (13, 3, 3)
            assert file[f"observation/{camera}/extrinsic_cv"].shape == (13, 3, 4)
            assert file[f"observation/{camera}/cam2world_gl"].shape == (13, 4, 4)


def test_encoded_frames_are_stored_as_they_are(tmp_path):
    given = arrays(steps=2)
    jpegs = [encode_frame(frame) for frame in given["images"]]
    write_episode(episode_path(tmp_path, 0), **{**given, "images": jpegs})
    assert read_episode(episode_path(tmp_path, 0)).frames.jpegs(1) == jpegs[1]


def test_texts_are_stored_with_fixed_width_and_read_with_any(episode_file):
    with h5py.File(episode_file, "r+") as file:
        assert all(file.attrs.get_id(name).dtype.kind in "iufS" for name in file.attrs)
        assert file["ugr/phase"].dtype.kind == "S"
        file.attrs["task"] = "text of variable width"
    assert read_episode(episode_file).extras["task"] == "text of variable width"


def test_moving_cameras_keep_their_parameters_of_each_frame(tmp_path):
    given = arrays(steps=2)
    moving = []
    for frame in range(3):
        now = {camera: dict(given["camera_parameters"][camera]) for camera in CAMERAS}
        now["cam_left_wrist"]["extrinsic_cv"] = np.full((3, 4), float(frame))
        moving.append(now)
    write_episode(episode_path(tmp_path, 0), **{**given, "camera_parameters": moving})
    with h5py.File(episode_path(tmp_path, 0)) as file:
        assert file["observation/left_camera/extrinsic_cv"][:, 0, 0].tolist() == [0, 1, 2]


def test_without_an_expert_action_the_label_is_the_next_command(episode_file):
    with h5py.File(episode_file, "r+") as file:
        del file["ugr"]
        for name in list(file.attrs):
            del file.attrs[name]
    episode = read_episode(episode_file, seed=17)
    np.testing.assert_array_equal(episode.action, arrays()["commanded"][1:])
    assert (episode.seed, episode.measured, episode.extras) == (17, None, {"table_height": 0.74})  # as RoboTwin's own
    with pytest.raises(ConfigError, match="commanded"):
        episode.proprioception("measured")


def test_a_failure_while_writing_leaves_no_file_and_keeps_the_old_one(tmp_path, monkeypatch):
    path = episode_path(tmp_path, 0)
    write_episode(path, **arrays(seed=1))
    before = path.read_bytes()

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(robotwin, "_write_joints", fail)
    for target in (path, episode_path(tmp_path, 1)):
        with pytest.raises(KeyboardInterrupt):
            write_episode(target, **arrays(seed=2))
    assert path.read_bytes() == before
    assert not episode_path(tmp_path, 1).exists()


WRONG = [
    ("commanded", np.zeros((12, 14))),
    ("measured", np.zeros((12, 14))),
    ("endpose", np.full((13, 2, 7), np.nan)),
    ("intended_endpose", np.zeros((12, 2, 7))),
    ("contacts", np.zeros((13,), bool)),
    ("expert_action", np.full((12, 14), np.inf)),
    ("phase", ["reach"]),
    ("slack", np.zeros(13)),
    ("camera_parameters", []),
    ("images", np.zeros((13, 3, 24, 32, 3), np.float32)),
    ("images", np.zeros((12, 3, 24, 32, 3), np.uint8)),
    ("images", np.zeros((13, 2, 24, 32, 3), np.uint8)),
    ("images", np.zeros((13, 3, 24, 32, 1), np.uint8)),
    ("images", [(b"x", b"y", b"z")] * 13),
]


@pytest.mark.parametrize(("name", "value"), WRONG)
def test_wrong_arguments_are_refused_before_anything_is_written(name, value, tmp_path):
    with pytest.raises(DataError, match=name):
        write_episode(episode_path(tmp_path, 0), **arrays(**{name: value}))
    assert not list(tmp_path.rglob("*.*"))


def _group_instead(file):
    del file[VECTOR]
    file.create_group(VECTOR)


HOSTILE = {
    "vector missing": (lambda file: file.pop(VECTOR), f"{VECTOR}.*left_arm"),
    "vector renamed": (lambda file: file.move(VECTOR, "joint_action/vektor"), f"{VECTOR}.*vektor"),
    "vector a group": (_group_instead, f"{VECTOR}.*group"),
    "vector of strings": (replace(VECTOR, data=np.full((13, 14), b"0.5")), f"{VECTOR}.*S3"),
    "vector of 7-joint arms": (replace(VECTOR, data=np.zeros((13, 16))), VECTOR + r".*\(12, 16\).*layout.state 16"),
    "vector flat": (replace(VECTOR, data=np.zeros(13 * 14)), VECTOR + r".*\(182,\)"),
    "vector a scalar": (replace(VECTOR, data=1.0), VECTOR + r".*\(\)"),
    "vector without content": (replace(VECTOR, data=h5py.Empty("f8")), f"{VECTOR}.*None"),
    "no frames": (replace(VECTOR, data=np.zeros((0, 14))), f"{VECTOR}.*at least 2 frames, got 0"),
    "one frame": (replace(VECTOR, data=np.zeros((1, 14))), f"{VECTOR}.*at least 2 frames, got 1"),
    "other number of frames": (replace(VECTOR, data=np.zeros((12, 14))), "expert_action|head_camera"),
    "NaN": (poke(VECTOR, (3, 7), np.nan), VECTOR + r".*finite.*nan at \[3, 7\]"),
    "infinity": (poke(VECTOR, (0, 0), -np.inf), VECTOR + r".*-inf at \[0, 0\]"),
    "beyond float32": (poke(VECTOR, (12, 13), 1e300), VECTOR + r".*inf at \[12, 13\]"),
    "absurd length": (replace(VECTOR, (10**12, 14), np.float64, chunks=(1, 14)), f"{VECTOR}.*at most 100000 frames"),
    "absurd chunk": (
        replace(VECTOR, data=np.zeros((13, 14)), chunks=(10**6, 14), maxshape=(None, 14)),
        f"{VECTOR}.*chunk",
    ),
    "camera missing": (lambda file: file.pop("observation/head_camera"), "cam_left_wrist, got cam_high"),
    "pictures missing": (lambda file: file.pop(HEAD), f"{HEAD}.*no 'rgb'"),
    "pictures as numbers": (replace(HEAD, data=np.zeros(13)), f"{HEAD}.*colour pictures.*float64"),
    "pictures of absurd size": (replace(HEAD, (13,), "S300000000", chunks=(1,)), f"{HEAD}.*rows of at most"),
    "one picture short": (replace(HEAD, data=np.array([b"x"] * 12)), HEAD + r".*13 pictures.*\(12,\)"),
    "no JPEG": (poke(HEAD, 4, b"GIF89a"), HEAD + r"\[4\].*JPEG"),
    "empty picture": (poke(HEAD, 12, b""), HEAD + r"\[12\].*JPEG"),
    "JPEG markers around nothing": (poke(HEAD, 0, b"\xff\xd8junk\xff\xd9"), HEAD + r"\[0\].*JPEG"),
    "a picture of another size": (
        poke(HEAD, 5, encode_jpeg(np.zeros((16, 16, 3), np.uint8))),
        HEAD + r"\[5\].*\(24, 32\).*\(16, 16\)",
    ),
    "expert action too long": (replace("ugr/expert_action", data=np.zeros((13, 14))), "expert_action.*12"),
    "NaN in expert action": (poke("ugr/expert_action", (1, 1), np.nan), "expert_action.*finite"),
    "measured of another length": (replace("ugr/measured", data=np.zeros((12, 14))), "measured.*13"),
    "contacts as numbers": (replace("ugr/contacts", data=np.zeros((13, 2))), "contacts.*booleans"),
    "phases as numbers": (replace("ugr/phase", data=np.zeros(12)), "phase.*texts"),
    "seed no number": (lambda file: file.attrs.__setitem__("seed", np.bytes_(b"many")), "@seed.*int.*many"),
    "format of the future": (lambda file: file.attrs.__setitem__("ugr_format_version", 99), "version 99.*Update"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_damaged_and_foreign_content_is_one_clear_error(case, episode_file):
    damage, message = HOSTILE[case]
    with h5py.File(episode_file, "r+") as file:
        damage(file)
    with pytest.raises((DataError, ConfigError), match=message) as caught:
        read_episode(episode_file)
    assert str(episode_file) in str(caught.value)
    assert "\n" not in str(caught.value)


CONTENT = {
    "empty file": lambda good: b"",
    "text": lambda good: b"not hdf5 at all" * 100,
    "cut in half": lambda good: good[: len(good) // 2],
    "last bytes missing": lambda good: good[:-100],
    "only the signature": lambda good: good[:8] + b"\0" * 5000,
}


@pytest.mark.parametrize("case", CONTENT)
def test_files_that_are_not_whole_hdf5_files_are_refused(case, episode_file):
    episode_file.write_bytes(CONTENT[case](episode_file.read_bytes()))
    with pytest.raises(DataError, match=r"episode0\.hdf5.*HDF5"):
        read_episode(episode_file)


def test_overwritten_bytes_never_give_anything_but_a_data_error(episode_file):
    good = episode_file.read_bytes()
    rng = np.random.default_rng(0)
    outcomes = []
    for attempt in range(60):
        damaged = bytearray(good)
        at = int(rng.integers(0, len(good) - 16))
        damaged[at : at + 16] = rng.bytes(16)
        path = episode_file.with_name(f"episode{attempt}.hdf5")
        path.write_bytes(damaged)
        try:
            episode = read_episode(path)
            for step in range(episode.length):
                episode.images(step)
        except DataError:
            outcomes.append("refused")
        else:
            outcomes.append("unharmed")
    assert set(outcomes) == {"refused", "unharmed"}


def test_robotwins_tool_poses_are_moved_from_the_flange_to_the_fingers(tmp_path):
    """Its hands point down here."""
    episode = read_episode(write_robotwin(tmp_path, 1) / "data" / "episode0.hdf5")
    assert episode.endpose[3, 1, :3] == pytest.approx([0.1, 0.2, 0.88], abs=1e-6)
    assert episode.extras["table_height"] == 0.74


@pytest.mark.parametrize("spelling", ["episode{}.hdf5", "episode_{}.hdf5", "episode_{:07d}.hdf5"])
def test_robotwins_own_episodes_are_read_under_all_their_spellings(spelling, tmp_path):
    seen = {camera: seed for seed, camera in enumerate(("front_camera", *CAMERAS), start=5)}
    cameras = ("front_camera", *ROBOTWIN_CAMERAS)
    form = detect(write_robotwin(tmp_path, 3, 5, cameras=cameras, name=spelling))
    assert form.name == "robotwin"
    found = form.find(tmp_path)
    assert list(found) == [0, 1, 2]
    assert form.peek(found[1]).cameras == (*CAMERAS, "front_camera")
    vector = waves(6, 14, 1)
    episode = form.read(found[1], (*CAMERAS, "front_camera"))
    assert (episode.length, episode.seed, episode.measured) == (5, 9, None)
    assert np.array_equal(episode.state, vector[:-1])
    assert np.array_equal(episode.action, vector[1:])
    for step in (0, 4):
        for camera, picture in zip(episode.cameras, episode.images(step).astype(int), strict=True):
            assert np.median(np.abs(picture - pictures(6, seed=seen[camera])[step])) < 4


def test_seven_joints_per_arm_are_named_and_picked(tmp_path):
    form = detect(write_robotwin(tmp_path, 1, 5, joints=7))
    location = form.find(tmp_path)[0]
    vector = waves(6, 16)
    names = form.peek(location).state
    assert (len(names), names[6:9]) == (16, ("left_joint_7", "left_gripper", "right_joint_1"))
    with pytest.raises(DataError, match=r"\(T, 14\).*\(5, 16\).*--data.layout.state 16") as caught:
        form.read(location, CAMERAS)
    assert "ugr collect" not in str(caught.value)
    whole = form.read(location, CAMERAS, form.peek(location).layout)
    assert np.array_equal(whole.state, vector[:-1])
    right = tuple(name for name in names if name.startswith("right"))
    one_arm = form.read(location, ("cam_right_wrist",), Layout(state=right))
    assert np.array_equal(one_arm.state, vector[:-1, 8:])
    assert np.array_equal(one_arm.action, vector[1:, 8:])


@pytest.mark.parametrize("arm", [1.0, np.zeros((6, 10**4)), np.zeros(6)])
def test_arms_that_do_not_fit_the_vector_only_cost_the_names(arm, tmp_path):
    form = detect(write_robotwin(tmp_path, 1, 5))
    location = form.find(tmp_path)[0]
    with h5py.File(location.path, "r+") as file:
        replace("joint_action/left_arm", data=arm)(file)
    assert form.peek(location).state == tuple(map(str, range(14)))
    assert form.read(location, CAMERAS).length == 5


def test_an_episode_of_one_arm_cannot_be_written(tmp_path, episode_file):
    arms = {"state": np.zeros((12, 7), "f4"), "action": np.zeros((12, 7), "f4")}
    given = dataclasses.replace(read_episode(episode_file), **arms)
    with pytest.raises(DataError, match=r"two arms, each with a gripper.*got 7 states, 7 actions"):
        find_format("robotwin").write(tmp_path / "again", [given])
    assert not list((tmp_path / "again").rglob("*.hdf5"))


def test_a_missing_file_says_so(tmp_path):
    with pytest.raises(DataError, match=r"no such file.*ugr collect"):
        read_episode(tmp_path / "episode0.hdf5")


@pytest.mark.parametrize("cameras", [("cam_top",), (), ("head_camera",)])
def test_unknown_cameras_name_the_known_ones(cameras, episode_file):
    with pytest.raises(ConfigError, match="cam_high"):
        read_episode(episode_file, cameras)


def test_pictures_are_checked_many_at_a_read_and_a_damaged_one_is_still_named(tmp_path, monkeypatch):
    path, reads, read = episode_path(tmp_path, 0), [], h5py.Dataset.__getitem__
    write_episode(path, **arrays(steps=150))
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *given: reads.append(given[0].name) or read(*given))
    read_episode(path)
    assert 1 < reads.count(f"/{HEAD}") < 10
    monkeypatch.undo()
    with h5py.File(path, "r+") as file:
        poke(HEAD, 149, b"GIF89a")(file)
    with pytest.raises(DataError, match=HEAD + r"\[149\].*JPEG"):
        read_episode(path)
