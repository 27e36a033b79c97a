"""Cameras and joints are found by name, and units become ours."""

import numpy as np
import pytest
from jsonargparse import ArgumentParser

from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Joint, Layout, policy_cameras
from ugr_lightning.errors import ConfigError, DataError

ROWS = np.arange(12, dtype=np.float32).reshape(3, 4)  # (T, D)
NAMES = ("waist", "elbow", "wrist", "finger")


def test_the_default_takes_14_columns_as_they_are():
    rows = np.random.default_rng(0).normal(size=(5, 14)).astype(np.float32)
    assert (DEFAULT_LAYOUT.state_dim, DEFAULT_LAYOUT.action_dim) == (14, 14)
    assert np.array_equal(DEFAULT_LAYOUT.take(rows, "state", (), "file"), rows)


def test_joints_are_picked_by_name_and_by_position_in_the_order_asked_for():
    layout = Layout(state=("finger", 0, Joint("elbow")), action=2)
    assert (layout.state_dim, layout.action_dim) == (3, 2)
    assert layout.take(ROWS, "state", NAMES, "file").tolist() == [[3, 0, 1], [7, 4, 5], [11, 8, 9]]


def test_scale_and_offset_change_units():
    layout = Layout(state=(Joint("waist", scale=np.pi / 180, offset=0.5), "waist"))
    taken = layout.take(ROWS, "state", NAMES, "file")
    assert taken.dtype == np.float32
    assert taken[1].tolist() == pytest.approx([np.radians(4) + 0.5, 4])


@pytest.mark.parametrize(("closed", "opened"), [(3.0, 11.0), (11.0, 3.0)])
def test_a_gripper_goes_from_0_closed_to_1_open_whichever_is_larger(closed, opened):
    taken = Layout(state=(Joint("finger", closed=closed, open=opened),)).take(ROWS, "state", NAMES, "file")
    assert taken[:, 0].tolist() == ([0, 0.5, 1] if closed < opened else [1, 0.5, 0])


def test_actions_may_have_other_joints_than_states():
    layout = Layout(state=4, action=("waist",))
    assert layout.take(ROWS, "action", NAMES, "file").tolist() == [[0], [4], [8]]
    assert layout.take(ROWS, "state", NAMES, "file").shape == (3, 4)
    assert Layout(state=("elbow",)).take(ROWS, "action", NAMES, "file").tolist() == [[1], [5], [9]]


def test_another_number_of_joints_shows_both_numbers_and_the_setting():
    with pytest.raises(
        DataError, match=r"demo\.hdf5:qpos: expected shape \(T, 14\), got \(3, 4\).*data\.layout\.state"
    ):
        DEFAULT_LAYOUT.take(ROWS, "state", (), "demo.hdf5:qpos")


@pytest.mark.parametrize(
    ("joint", "names", "message"),
    [
        ("knee", NAMES, "knee.*4 columns: waist, elbow, wrist, finger"),
        ("knee", (), "knee.*4 columns without names"),
        (4, NAMES, r"joints \[4\] of `data.layout.state`, got 4 columns"),
    ],
)
def test_a_joint_that_is_not_there_is_named_beside_those_that_are(joint, names, message):
    with pytest.raises(DataError, match=message):
        Layout(state=(0, joint)).take(ROWS, "state", names, "file")


@pytest.mark.parametrize(
    "wrong",
    [
        {"source": -1},
        {"source": 0, "closed": 1.0},
        {"source": 0, "closed": 1.0, "open": 1.0},
        {"source": 0, "closed": 1.0, "open": 2.0, "scale": 3.0},
        {"source": 0, "scale": 0.0},
    ],
)
def test_impossible_joints_are_refused(wrong):
    with pytest.raises(ConfigError, match=r"data\.layout, joint"):
        Joint(**wrong)


@pytest.mark.parametrize("joint", [Joint(0, scale=np.inf), Joint(0, scale=1e38), Joint("waist", offset=np.nan)])
def test_units_in_which_a_joint_is_no_number_are_refused(joint):
    with pytest.raises(ConfigError, match=r"joint .*: expected finite numbers, got others in file\. Correct"):
        Layout(state=(1, joint)).take(ROWS, "state", NAMES, "file")


@pytest.mark.parametrize("nothing", [0, ()])
def test_a_vector_has_at_least_one_joint(nothing):
    with pytest.raises(ConfigError, match=r"data\.layout\.state"):
        Layout(state=nothing)


def test_cameras_are_known_by_the_layout_then_by_names_of_other_projects_then_by_the_files_own(tmp_path):
    available = ("head_camera", "left", "front")
    assert policy_cameras(available) == ("cam_high", "left", "front")
    layout = Layout(cameras={"cam_wrist": "left", "cam_high": "front"})
    assert layout.find_cameras(("cam_wrist", "cam_high", "front"), available, tmp_path) == (
        "left",
        "front",
        "front",
    )
    assert DEFAULT_LAYOUT.find_cameras(("cam_high",), available, tmp_path) == ("head_camera",)
    for unknown in (("cam_wrist",), (), ("head_camera",)):  # one name per camera: `head_camera` is `cam_high`
        with pytest.raises(
            ConfigError, match=r"data\.cameras.*names among left, front, cam_high.*data\.layout\.cameras"
        ):
            DEFAULT_LAYOUT.find_cameras(unknown, available, tmp_path)


def test_a_layout_can_be_given_on_the_command_line():
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(ChunkDataModule, "data")
    words = ["--data.layout.state=[0, elbow, {source: grip, closed: 0, open: 0.04}]", "--data.layout.action=3"]
    parsed = parser.parse_args([*words, "--data.layout.cameras={cam_high: top}", "--data.folder=elsewhere"])
    layout = parser.instantiate(parsed).data.layout
    assert layout == Layout({"cam_high": "top"}, (0, "elbow", Joint("grip", closed=0.0, open=0.04)), 3)


def test_names_follow_what_is_picked():
    names = ("a", "b", "c")
    assert Layout(state=3).names(names, "state") == names
    assert Layout(state=3).names((), "state") == ("0", "1", "2")
    assert Layout(state=(2, "b", Joint(0))).names(names, "action") == ("c", "b", "a")


def test_columns_in_their_order_are_not_picked():
    assert Layout(cameras={"cam_high": "front"}, state=7, action=(0, 1)).picked == []
    assert Layout(state=(1, 0)).picked == ["state"]
    assert Layout(state=(Joint(0, scale=2.0), 1), action=("waist",)).picked == ["state", "action"]
