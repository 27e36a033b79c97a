"""Samples are written here as the two producers write them, by other libraries than the reader's."""

import io
import json

import h5py
import numpy as np
import pytest
from foreign_files import poke, replace
from PIL import Image

from ugr_lightning.data.formats import detect
from ugr_lightning.data.formats.xpolicylab import XPolicyLab
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, DataError

SIZE = (24, 32)
VIEWS = ("cam_head", "cam_left_wrist", "cam_right_wrist", "cam_third_view")
PARTS = {
    "left_arm_joint_states": slice(0, 6),
    "left_ee_joint_states": slice(6, 7),
    "right_arm_joint_states": slice(7, 13),
    "right_ee_joint_states": slice(13, 14),
}
TEXT = h5py.string_dtype(encoding="utf-8")
FORMAT = XPolicyLab()


def colour(view, step):
    """RGB of a picture, all three different; says camera and step."""
    return 200 - 8 * step, 40 + 40 * VIEWS.index(view), 20 + 5 * step


def jpeg(rgb, marked=False):
    """The collectors hand RGB to an encoder that takes it for BGR; marked files are encoded as they should be."""
    picture = np.full((*SIZE, 3), rgb, np.uint8)
    out = io.BytesIO()
    Image.fromarray(picture if marked else picture[..., ::-1].copy()).save(
        out, "JPEG", quality=95, **({"comment": b"XPL-RGB1"} if marked else {})
    )
    return out.getvalue()


def vector(frames, seed=0):
    return np.random.default_rng(seed).normal(size=(frames, 14)).astype(np.float32)


def write_vision(file, frames, extrinsics, marked=()):
    for view in VIEWS:
        colors = [jpeg(colour(view, step), step in marked) for step in range(frames)]
        file[f"vision/{view}/colors"] = np.array(colors, dtype=f"S{max(map(len, colors))}")
        file[f"vision/{view}/shape"] = np.array((*SIZE, 3), np.int32)
        file[f"vision/{view}/intrinsic_matrix"] = np.zeros((frames, 3, 3))
        file[f"vision/{view}/{extrinsics}"] = np.zeros((frames, 4, 4), np.float32)


def write_native(path, joints, instructions=("press it", "pousse l’horloge"), marked=()):
    """As RoboTwin's collector."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file.attrs["source_format"], file.attrs["source_path"] = "RoboTwin", "native_collection"
        file.create_dataset("data_format_version", data="v1.0", dtype=TEXT)
        file.create_dataset("instructions", data=json.dumps(instructions, ensure_ascii=False), dtype=TEXT)
        file.create_group("additional_info").create_dataset("frequency", data=np.asarray(15, np.int32))
        for part, columns in PARTS.items():
            file[f"state/{part}"], file[f"action/{part}"] = joints[:-1, columns], joints[1:, columns]
        for side in ("left", "right"):
            file[f"state/{side}_ee_poses"] = np.zeros((len(joints) - 1, 7), np.float32)
            file[f"action/{side}_ee_poses"] = np.zeros((len(joints) - 1, 7), np.float32)
        write_vision(file, len(joints) - 1, "extrinsics_matrix", marked)
    return path


def write_converted(path, joints, same_index=False, keep_last=False, meta=True):
    """As RoboTwin's converter from the older layout."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = joints if keep_last else joints[:-1]
    action = state if same_index else joints[1:]
    with h5py.File(path, "w") as file:
        file.attrs["source_format"] = "RoboTwin"
        file.create_dataset("data_format_version", data="v1.0", dtype=TEXT)
        file.create_dataset("instruction", data="press it", dtype=TEXT)
        file.create_dataset("instructions", data=np.asarray(["press it", "press that"], dtype=object), dtype=TEXT)
        file.create_group("additional_info").create_dataset("frequency", data=np.asarray(15, np.int32))
        for group, values in (("state", state), ("action", action)):
            for part, columns in PARTS.items():
                file[f"{group}/{part}"] = values[:, columns]
            file[f"{group}/joint_states"] = values
        write_vision(file, len(state), "extrinsic_matrix")
    if meta:
        content = {
            "source_format": "RoboTwin",
            "action_alignment": "same_index" if same_index else "next_state_as_action",
        }
        (path.parent.parent / "conversion_meta.json").write_text(json.dumps(content))
    return path


def read(folder, index=0, cameras=CAMERAS, layout=None):
    location = FORMAT.find(folder)[index]
    return FORMAT.read(location, cameras) if layout is None else FORMAT.read(location, cameras, layout)


@pytest.fixture
def native(tmp_path):
    write_native(tmp_path / "data/episode_0000000.hdf5", vector(8))
    return tmp_path


def test_both_producers_are_recognised_and_found_in_order(tmp_path):
    for folder, write in ((tmp_path / "a", write_native), (tmp_path / "b", write_converted)):
        for index, frames in ((11, 5), (2, 9), (0, 7)):
            write(folder / f"data/episode_{index:07d}.hdf5", vector(frames, index))
        assert detect(folder).name == "xpolicylab"
        found = FORMAT.find(folder)
        assert list(found) == [0, 2, 11]
        assert [FORMAT.read(location, CAMERAS).length for location in found.values()] == [6, 8, 4]


@pytest.mark.parametrize("write", [write_native, write_converted])
def test_action_of_a_step_is_the_joints_of_the_next_frame(write, tmp_path):
    joints = vector(8)
    write(tmp_path / "data/episode_0000000.hdf5", joints)
    episode = read(tmp_path)
    np.testing.assert_array_equal(episode.state, joints[:-1])
    np.testing.assert_array_equal(episode.action, joints[1:])
    assert episode.extras["action_alignment"] == "next_state"


@pytest.mark.parametrize("meta", [True, False])
@pytest.mark.parametrize("keep_last", [True, False])
def test_actions_that_repeat_the_state_are_read_from_the_next_row(keep_last, meta, tmp_path):
    joints = vector(8)
    write_converted(tmp_path / "data/episode_0000000.hdf5", joints, same_index=True, keep_last=keep_last, meta=meta)
    episode = read(tmp_path)
    rows = 8 if keep_last else 7
    assert episode.length == rows - 1
    np.testing.assert_array_equal(episode.state, joints[: rows - 1])
    np.testing.assert_array_equal(episode.action, joints[1:rows])
    assert episode.extras["action_alignment"] == "same_index"


def test_without_actions_the_next_state_is_the_command(native):
    with h5py.File(native / "data/episode_0000000.hdf5", "r+") as file:
        del file["action"]
    episode = read(native)
    np.testing.assert_array_equal(episode.action, vector(8)[1:7])
    assert (episode.length, episode.extras["action_alignment"]) == (6, "without_actions")


def test_commands_of_their_own_are_taken_as_they_are(native):
    with h5py.File(native / "data/episode_0000000.hdf5", "r+") as file:
        file["action/left_arm_joint_states"][...] += 0.1
    episode = read(native)
    np.testing.assert_allclose(episode.action[:, :6], vector(8)[1:, :6] + 0.1, atol=1e-6)
    assert episode.extras["action_alignment"] == "commanded"


def test_metadata_that_contradict_the_rows_are_refused(tmp_path):
    write_converted(tmp_path / "data/episode_0000000.hdf5", vector(8))
    (tmp_path / "conversion_meta.json").write_text('{"action_alignment": "same_index"}')
    with pytest.raises(DataError, match=r"same_index.*next_state"):
        read(tmp_path)


def test_colours_are_right_with_and_without_the_marker_frame_by_frame(tmp_path):
    write_native(tmp_path / "data/episode_0000000.hdf5", vector(8), marked={1, 4})
    episode = read(tmp_path)
    for step in range(episode.length):
        for view, picture in zip(("cam_head", "cam_right_wrist", "cam_left_wrist"), episode.images(step), strict=True):
            assert np.abs(picture.astype(int) - colour(view, step)).max() <= 3, (view, step)


def test_plain_frames_are_read_as_rgb(native):
    with h5py.File(native / "data/episode_0000000.hdf5", "r+") as file:
        for view in VIEWS:
            del file[f"vision/{view}/colors"]
            pictures = [np.full((*SIZE, 3), colour(view, step), np.uint8) for step in range(7)]
            file[f"vision/{view}/colors"] = np.stack(pictures)
    assert tuple(read(native).images(3)[1, 0, 0]) == colour("cam_right_wrist", 3)


def test_instructions_are_read_in_both_spellings_and_frequency_is_no_rate_by_itself(tmp_path):
    write_native(tmp_path / "a/data/episode_0000000.hdf5", vector(4))
    write_converted(tmp_path / "b/data/episode_0000000.hdf5", vector(4))
    native, converted = read(tmp_path / "a").extras, read(tmp_path / "b").extras
    assert native["instructions"] == ("press it", "pousse l’horloge")
    assert native["instruction"] == converted["instruction"] == "press it"
    assert converted["instructions"] == ("press it", "press that")
    assert (native["frequency"], native.get("control_hz")) == (15, None)
    assert converted["control_hz"] == pytest.approx(16.667, abs=0.001)


def test_peek_names_cameras_and_joints(native):
    contents = FORMAT.peek(FORMAT.find(native)[0])
    assert set(contents.cameras) == {*CAMERAS, "cam_third_view"}
    assert contents.state[:7] == (*(f"left_joint_{i}" for i in range(1, 7)), "left_gripper")
    assert contents.state == contents.action


def test_a_single_arm_and_other_cameras_are_read_through_a_layout(native):
    with h5py.File(native / "data/episode_0000000.hdf5", "r+") as file:
        for group in ("state", "action"):
            rows = vector(8)[:-1] if group == "state" else vector(8)[1:]
            for part in (*PARTS, "left_ee_poses", "right_ee_poses"):
                del file[f"{group}/{part}"]
            file[f"{group}/arm_joint_states"], file[f"{group}/ee_joint_states"] = rows[:, :7], rows[:, 7:8]
        file.move("vision/cam_left_wrist", "vision/cam_wrist")
    assert detect(native).name == "xpolicylab"
    with pytest.raises(DataError, match=r"14.*8"):
        read(native, cameras=("cam_wrist",))
    layout = Layout(cameras={"wrist": "cam_wrist"}, state=("joint_7", Joint("gripper", closed=2, open=4)))
    episode = read(native, cameras=("wrist",), layout=layout)
    np.testing.assert_allclose(episode.action, np.stack([vector(8)[1:, 6], (vector(8)[1:, 7] - 2) / 2], 1), atol=1e-6)
    with pytest.raises(ConfigError, match="cam_wrist"):
        read(native, cameras=("cam_top",), layout=layout)


def no_rows(file):
    for part in PARTS:
        replace(f"state/{part}", data=np.zeros((0, 6), np.float32))(file)


VERSION, COLORS, FREQUENCY = "data_format_version", "vision/cam_head/colors", "additional_info/frequency"
ARM = "action/left_arm_joint_states"
SHORT = np.zeros((3, 6), np.float32)
HOSTILE = {
    "newer version": (replace(VERSION, data="v2.0", dtype=TEXT), "v1.0, got v2.0"),
    "version a number": (replace(VERSION, data=1), "texts"),
    "no such camera": (lambda file: file.pop("vision/cam_head"), "got cam_high"),
    "camera of another length": (replace(COLORS, data=np.array([b"x"] * 3)), r"cam_head/colors.*7 pictures.*\(3,\)"),
    "no JPEG": (poke(COLORS, 3, b"GIF89a"), r"colors\[3\].*JPEG"),
    "no joints": (lambda file: [file.pop(f"state/{part}") for part in PARTS], "state.*left_arm_joint_states"),
    "NaN": (poke("state/left_arm_joint_states", (2, 1), np.nan), r"left_arm.*nan at \[2, 1\]"),
    "action shorter": (replace(ARM, data=SHORT), r"action/left_arm.*\(7, D\).*\(3, 6\)"),
    "action without an arm": (lambda file: file.pop(ARM), r"action.*14 columns.*8 columns"),
    "no rows": (no_rows, "at least 1 row"),
    "frequency of zero": (poke(FREQUENCY, (), 0), r"frequency.*above 0"),
    "frequency a text": (replace(FREQUENCY, data="15", dtype=TEXT), r"frequency.*whole number"),
    "absurd joints": (replace(ARM, (7, 10**9), np.float32, chunks=(1, 100)), "at most 256 columns"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_damaged_content_is_one_clear_error(case, native):
    damage, message = HOSTILE[case]
    path = native / "data/episode_0000000.hdf5"
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises((DataError, ConfigError), match=message) as caught:
        FORMAT.read(FORMAT.find(native)[0], CAMERAS)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", ["", "[1, 2", "[1]", "[" * 100_000])
def test_damaged_metadata_are_a_clear_error(content, native):
    (native / "conversion_meta.json").write_text(content)
    with pytest.raises(DataError, match=r"conversion_meta\.json"):
        read(native)
