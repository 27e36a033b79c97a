"""What is said about demonstrations is true of them: measured on files in which the oddity was put."""

import re
import shutil

import h5py
import numpy as np
import pytest
from foreign_files import marked_jpeg
from recordings import arrays

from ugr_lightning.data.folder import episode_path, write_seeds
from ugr_lightning.data.formats.robotwin import read_episode, write_episode
from ugr_lightning.data.inspection import inspect_demonstrations, measure_alignment
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.data.oddities import find_oddities, gripper_columns
from ugr_lightning.data.storage.jpeg import encode_frame
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, DataError

STEPS = 20


def smooth(seed, steps=STEPS):
    """Joints on slow waves, grippers between 0 and 1; (steps + 1, 14)."""
    phase = np.random.default_rng(seed).uniform(0, 6, 14)
    return 0.4 + 0.35 * np.sin(np.arange(steps + 1)[:, None] * 0.15 + phase)


def scene(frames):
    """A red box on a blue ground that moves by a pixel a frame; (frames, 3, 24, 32, 3) uint8."""
    found = np.zeros((frames, 3, 24, 32, 3), np.uint8)
    found[...] = (30, 60, 190)
    for frame in range(frames):
        found[frame, :, 4:12, frame % 20 : frame % 20 + 8] = (220, 40, 30)
    return found


@pytest.fixture
def make(tmp_path):
    """Writes one episode of a folder whose episodes have nothing odd; changes replace arrays."""

    def make(index=0, seed=None, **changes):
        joints = changes.pop("joints", smooth(index))
        given = {"commanded": joints, "measured": joints, "expert_action": joints[1:], "images": scene(len(joints))}
        path = episode_path(tmp_path, index)
        write_episode(path, **arrays(steps=len(joints) - 1, seed=index if seed is None else seed, **given | changes))
        return tmp_path

    return make


def oddities(folder, chunk_length=10, **options):
    return find_oddities(inspect_demonstrations(folder, **options), chunk_length)


def test_nothing_is_odd_about_good_demonstrations(make):
    make(1)
    assert oddities(make(0)) == []


def test_pictures_show_the_next_keyframes_and_what_is_not_in_them(make):
    poses = np.zeros((STEPS + 1, 2, 7))
    poses[..., 3] = 1
    poses[..., :3] = [[-0.2, 0, 0], [0.2, 0, -2]]  # the right tool is behind the camera
    parameters = arrays()["camera_parameters"]
    upwards = np.eye(3, 4) + np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]])  # from 1 m below the table
    known = {"intrinsic_cv": np.array([[16.0, 0, 16], [0, 16, 12], [0, 0, 1]]), "extrinsic_cv": upwards}
    parameters |= {"cam_high": {**parameters["cam_high"], **known}}
    found = inspect_demonstrations(make(endpose=poses, camera_parameters=parameters), pictured=1)
    view = found.seen[0].views["cam_high"]
    plain = read_episode(next(iter(found.present.values())).path, ("cam_high",)).images(0)[0]
    changed = np.abs(view.shown[0].astype(int) - plain).max(-1) > 60
    assert view.lacks == ()
    assert changed[12, 12:14].any()
    assert changed[-4:, -4:].any()
    assert not changed[-4:, :4].any()


def test_what_keyframes_lack_is_said_camera_by_camera(make, tmp_path):
    with h5py.File(episode_path(make(), 0), "a") as file:
        del file["observation/left_camera/intrinsic_cv"]
    views = inspect_demonstrations(tmp_path).seen[0].views
    assert views["cam_left_wrist"].lacks == ("calibrated cameras (`intrinsic_cv`, `extrinsic_cv`)",)
    assert views["cam_high"].lacks == ()


def test_every_episode_camera_and_column_is_described(make):
    make(3)
    found = inspect_demonstrations(make(0, joints=smooth(0, 12)))
    assert found.form.name == "robotwin"
    assert [(one.index, one.episode.length) for one in found.seen] == [(0, 12), (3, STEPS)]
    assert list(found.seen[0].views) == list(CAMERAS)
    assert {view.size for view in found.seen[0].views.values()} == {(24, 32)}
    assert found.names("state")[6:8] == ("left_gripper", "right_joint_1")
    assert [rows.shape for rows in found.rows("action")] == [(12, 14), (STEPS, 14)]
    assert found.unreadable == {}


def test_a_layout_and_chosen_cameras_are_what_is_looked_at(make):
    layout = Layout(state=("right_joint_2", Joint("right_gripper", closed=1, open=0)))
    found = inspect_demonstrations(make(0), cameras=("cam_left_wrist",), layout=layout)
    assert (list(found.seen[0].views), found.names("action")) == (
        ["cam_left_wrist"],
        ("right_joint_2", "right_gripper"),
    )
    assert found.rows("state")[0] == pytest.approx(np.stack([smooth(0)[:-1, 8], 1 - smooth(0)[:-1, 13]], 1), abs=1e-6)
    with pytest.raises(ConfigError, match="cam_top"):
        inspect_demonstrations(make(0), cameras=("cam_top",))


def test_unreadable_episodes_are_told_beside_the_readable_ones(make):
    make(0)
    folder = make(1)
    (folder / "data" / "episode0.hdf5").write_bytes(b"nothing")
    found = inspect_demonstrations(folder)
    assert [one.index for one in found.seen] == [1]
    assert "episode0.hdf5" in str(found.unreadable[0])
    (folder / "data" / "episode1.hdf5").write_bytes(b"nothing")
    with pytest.raises(DataError):
        inspect_demonstrations(folder)


def test_pictures_are_kept_of_a_few_episodes_only(make):
    for index in range(5):
        make(index)
    found = inspect_demonstrations(make(5), pictured=2)
    kept = {one.index: [len(view.shown) for view in one.views.values()] for one in found.seen}
    assert kept == {0: [3] * 3, 5: [3] * 3, 1: [0] * 3, 2: [0] * 3, 3: [0] * 3, 4: [0] * 3}
    path = episode_path(make(0), 0)
    with h5py.File(path, "a") as file:
        del file["endpose"]  # without tool poses nothing is drawn
    one = inspect_demonstrations(path).seen[0]
    assert one.steps == (0, 2, 5, 8, 10, 13, 16, 19)
    expected = read_episode(path).images(5)[1]
    assert np.array_equal(one.views[CAMERAS[1]].shown[2], expected)


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_alignment_is_measured_from_the_numbers(lag):
    states = [smooth(seed).astype(np.float32) for seed in range(3)]
    actions = [np.concatenate([state[lag:], np.repeat(state[-1:], lag, axis=0)]) for state in states]
    found = measure_alignment(states, actions)
    assert (found.moving, found.is_state == 60, found.is_next_state == 60) == (60, lag == 0, lag == 1)
    assert int(np.argmin(found.distances)) == lag
    assert found.distances[lag] == pytest.approx(0, abs=1e-7)


def test_alignment_says_nothing_of_joints_that_do_not_move_or_compare():
    still = [np.ones((9, 3), np.float32)]
    assert measure_alignment(still, still).moving == 0
    assert measure_alignment(still, [np.ones((9, 2), np.float32)]) is None


def test_grippers_are_known_by_name_or_by_place():
    assert gripper_columns(("left_joint_1", "left_gripper", "Gripper.pos")) == [1, 2]
    assert gripper_columns(tuple(map(str, range(14)))) == [6, 13]
    assert gripper_columns(tuple(map(str, range(7)))) == []


def _changed(column, rows, value):
    joints = smooth(0)
    joints[rows, column] = value
    return {"joints": joints}


def _frozen():
    images = scene(STEPS + 1)
    images[5:9, 1] = images[5, 1]
    return {"images": images}


def _swap_one():
    frames = [list(encode_frame(frame)) for frame in scene(STEPS + 1)]
    frames[7][2] = encode_frame(scene(STEPS + 1)[7][..., ::-1])[2]
    return {"images": frames}


ODD = {
    "a constant joint": (_changed(3, slice(None), 0.2), "state never moves in left_joint_4"),
    "a gripper in metres beyond 1": (_changed(6, slice(4, 6), 1.5), r"left_gripper is outside 0.*0\.\d+ to 1\.5"),
    "a gripper below 0": (_changed(13, 3, -0.25), r"right_gripper is outside 0.*in 5%.*-0\.25"),
    "a jump": (
        {"joints": np.concatenate([smooth(0, 40)[:30], smooth(0, 40)[30:] + np.eye(14)[8] * 4])},
        r"state jumps: episode 0 step 30 right_joint_2 by [34]\.\d+$",
    ),
    "a camera that stands still": (_frozen(), r"cam_right_wrist repeats its picture in 3 of 20.*3 of them while"),
    "one picture with swapped colours": (_swap_one(), r"cam_left_wrist swaps red and blue.*episode 0 step 7"),
    "an episode shorter than a chunk": ({"joints": smooth(0, 9)}, r"1 episodes shorter than a chunk of 10 steps: 0$"),
}


@pytest.mark.parametrize("case", ODD)
def test_what_is_odd_is_found_and_nothing_else(case, make):
    changes, message = ODD[case]
    found = [line for line in oddities(make(0, **changes)) if not line.startswith("action")]
    assert len(found) == 1
    assert re.search(message, found[0]), found


def test_an_episode_in_other_colours_than_the_first_contradicts_its_mark(make):
    make(0)
    marked = [list(map(marked_jpeg, encode_frame(frame))) for frame in scene(STEPS + 1)]  # swapped, and said not to be
    (line, *more) = oddities(make(1, images=marked))
    assert line.startswith("cam_high shows red and blue swapped, compared with episode 0, in the episodes 1")
    assert len(more) == 2


def test_right_marks_of_both_kinds_are_only_mentioned(make):
    make(0)
    marked = [list(map(marked_jpeg, encode_frame(frame[..., ::-1]))) for frame in scene(STEPS + 1)]
    found = oddities(make(1, images=marked))
    assert len(found) == 3
    assert all("with and without the mark" in line for line in found)


def test_pictures_of_a_later_episode_in_another_size_are_told_with_what_to_do(make):
    make(0)
    small = np.ascontiguousarray(scene(STEPS + 1)[:, :, :20])
    found = oddities(make(1, images=small))
    assert [line for line in found if "size" in line] == [
        *(f"{camera} has different sizes: 20x32, 24x32" for camera in CAMERAS),
        "pictures differ in size: give them one with `data.image_size` to train on them",
    ]


def test_files_that_are_no_episodes_are_named(make):
    make(0)
    folder = make(1)
    for name in ("data/backup.hdf5", "data/episode1 (copy).hdf5", "data/demo_1.h5", "other.hdf5"):
        shutil.copy(episode_path(folder, 1), folder / name)
    names = "backup.hdf5, demo_1.h5, episode1 (copy).hdf5, other.hdf5"
    assert oddities(folder) == [f"files that are taken for no demonstrations: {names}"]
    assert oddities(episode_path(folder, 1)) == []


def test_duplicates_gaps_and_leftovers_are_found(make):
    make(0)
    make(1, joints=smooth(0))
    folder = make(4, seed=0)
    write_seeds(folder, [0, 1, 2, 3, 0])
    (folder / "data" / "episode5.hdf5.partial").touch()
    found = oddities(folder)
    assert any("numbers without an episode: 2 to 3" in line for line in found)
    assert any("episode5.hdf5.partial" in line for line in found)
    assert any("seeds used more than once: 0" in line for line in found)
    assert any("same states and actions: 1 is 0" in line for line in found)
    assert len(found) == 4
