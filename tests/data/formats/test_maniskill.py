"""Samples are written here with the keys, types and compression of ManiSkill's wrapper; one test uses the wrapper."""

import h5py
import numpy as np
import pytest
from foreign_files import pictures, poke, replace, waves, write_maniskill

from ugr_lightning.data.formats import detect
from ugr_lightning.data.formats.maniskill import ManiSkill
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import DataError

FORMAT = ManiSkill()
SIZE = (24, 32)


def write(folder, name="trajectory", lengths=(5, 3, 7), **more):
    """Trajectories of a robot like ours."""
    return write_maniskill(folder, name, lengths, **{"width": 14, "qpos": 14, "cameras": CAMERAS} | more)


@pytest.fixture
def recording(tmp_path):
    return write(tmp_path)


def read(folder, index=0, cameras=CAMERAS, **layout):
    return FORMAT.read(FORMAT.find(folder)[index], cameras, Layout(**layout))


def test_trajectories_of_a_file_keep_their_numbers_and_seeds(tmp_path):
    write(tmp_path, "20261122_101500", (2,) * 12, skip={1, 5})
    for place in (tmp_path, tmp_path / "20261122_101500.h5"):
        assert detect(place).name == "maniskill"
        found = FORMAT.find(place)
        assert list(found) == [0, 2, 3, 4, 6, 7, 8, 9, 10, 11]
        assert found[10].seed == 50
    assert FORMAT.read(found[10], CAMERAS).name == "20261122_101500-traj_10"


def test_trajectories_of_several_files_are_counted_through(tmp_path):
    write(tmp_path, "b", (4, 5))
    write(tmp_path, "a", (2, 3))
    found = FORMAT.find(tmp_path)
    assert [FORMAT.read(found[index], CAMERAS).length for index in range(4)] == [2, 3, 4, 5]


def test_files_without_trajectories_are_known(recording):
    (recording / "damaged.h5").write_bytes(b"nothing")
    assert list(FORMAT.find(recording)) == [0, 1, 2]
    assert [path.name for path in FORMAT.strays(recording)] == ["damaged.h5"]


def test_action_of_a_step_follows_its_observation_and_the_last_observation_is_dropped(recording):
    episode = read(recording, 2)
    np.testing.assert_array_equal(episode.state, waves(8, 14, 2)[:7])
    np.testing.assert_array_equal(episode.action, waves(7, 14, 102))
    np.testing.assert_array_equal(episode.proprioception("measured"), episode.state)
    assert (episode.length, episode.seed) == (7, 42)
    assert (episode.extras["control_mode"], episode.extras["environment"]) == ("pd_joint_pos", "Press-v1")
    assert episode.extras["success"].tolist() == [False] * 6 + [True]


def test_colours_are_right_to_the_bit_in_the_order_asked_for(recording):
    cameras = ("cam_left_wrist", "cam_high")
    episode = read(recording, 2, cameras)
    for step in range(7):
        shown = [pictures(8, seed=10 + CAMERAS.index(camera))[step] for camera in cameras]
        np.testing.assert_array_equal(episode.images(step), shown)


def test_another_robot_is_read_through_a_layout(tmp_path):
    write(tmp_path, width=8, qpos=9)
    with pytest.raises(DataError, match=r"qpos.*14.*\(5, 9\).*--data.layout.state 9"):
        read(tmp_path)
    contents = FORMAT.peek(FORMAT.find(tmp_path)[0])
    assert (set(contents.cameras), len(contents.state), len(contents.action)) == (set(CAMERAS), 9, 8)
    layout = Layout(cameras={"top": "cam_high"}, state=9, action=(0, Joint(7, closed=-1, open=1)))
    episode = FORMAT.read(FORMAT.find(tmp_path)[0], ("top",), layout)
    np.testing.assert_allclose(episode.action[:, 1], (waves(5, 8, 100)[:, 7] + 1) / 2, atol=1e-6)


@pytest.mark.parametrize("mode", ["pd_ee_delta_pose", "pd_joint_delta_pos", None])
def test_actions_that_are_no_absolute_joint_targets_are_refused(mode, tmp_path):
    write(tmp_path, mode=mode)
    with pytest.raises(DataError, match=rf"pd_joint_pos.*got {mode!r}.*replay_trajectory.*-c pd_joint_pos"):
        read(tmp_path)


def test_trajectories_without_pictures_say_how_to_get_them(tmp_path):
    path = write(tmp_path, cameras=()) / "trajectory.h5"
    for case in ("joints only", "a flat state", "nothing"):
        with h5py.File(path, "r+") as file:
            if case != "joints only":
                del file["traj_0/obs"]
            if case == "a flat state":
                file["traj_0/obs"] = np.zeros((6, 30), np.float32)
        for use in (read, lambda folder: FORMAT.peek(FORMAT.find(folder)[0])):
            with pytest.raises(DataError, match=r"traj_0.*rgb.*replay_trajectory.*-o rgb"):
                use(tmp_path)


def several_robots(file):
    del file["traj_0/actions"]
    file["traj_0/actions/left"] = waves(5, 14)


RGB = "traj_0/obs/sensor_data/cam_high/rgb"
HOSTILE = {
    "actions of several robots": (several_robots, "an array, got a group"),
    "fewer actions than the JSON says": (replace("traj_0/actions", data=waves(4, 14)), r"5 rows.*got 4"),
    "no actions": (replace("traj_0/actions", data=waves(0, 14)), r"5 rows.*got 0"),
    "as many joints as actions": (replace("traj_0/obs/agent/qpos", data=waves(5, 14)), r"qpos.*\(6, D\).*\(5, 14\)"),
    "NaN": (poke("traj_0/actions", (1, 2), np.nan), r"actions.*nan at \[1, 2\]"),
    "fewer pictures": (replace(RGB, data=np.zeros((5, *SIZE, 3), np.uint8)), r"cam_high/rgb.*6 pictures"),
    "depth for colour": (replace(RGB, data=np.zeros((6, *SIZE, 1), np.uint16)), r"cam_high/rgb.*colour.*choose"),
    "success as numbers": (replace("traj_0/success", data=np.zeros(5)), r"success.*booleans"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_damaged_content_is_one_clear_error(case, recording):
    damage, message = HOSTILE[case]
    path = recording / "trajectory.h5"
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(DataError, match=message) as caught:
        read(recording)
    assert str(path) in str(caught.value)


METADATA = {
    "cut off": '{"episodes": [',
    "a list": "[]",
    "no episodes": '{"env_info": null}',
    "episodes of another kind": '{"episodes": [1]}',
    "episodes without numbers": '{"episodes": [{"episode_id": "one"}]}',
    "numbers that cannot be": '{"episodes": [{"episode_id": []}]}',
    "another episode": '{"episodes": [{"episode_id": 7}]}',
    "deep": '{"episodes": ' + "[" * 100_000,
}


@pytest.mark.parametrize("case", METADATA)
def test_damaged_metadata_are_a_clear_error(case, recording):
    (recording / "trajectory.json").write_text(METADATA[case])
    with pytest.raises(DataError, match=r"trajectory\.json"):
        read(recording)


def test_missing_metadata_are_a_clear_error(recording):
    (recording / "trajectory.json").unlink()
    assert FORMAT.recognises(recording)
    with pytest.raises(DataError, match=r"trajectory\.json.*no such file"):
        FORMAT.find(recording)


def test_foreign_and_damaged_files_are_not_recognised(tmp_path):
    assert not FORMAT.recognises(tmp_path / "nowhere")
    good = (write(tmp_path / "good") / "trajectory.h5").read_bytes()
    (tmp_path / "a.h5").write_bytes(good[:2000])
    (tmp_path / "b.h5").write_bytes(b"text")
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["traj_x/actions"], file["traj_0/other"] = 1, 2
    assert not FORMAT.recognises(tmp_path)


@pytest.mark.renders
def test_what_the_wrapper_records_from_an_environment_of_ours_is_read(tmp_path):
    gymnasium = pytest.importorskip("gymnasium")
    from mani_skill.utils.wrappers import RecordEpisode

    import ugr_lightning.sim.environments  # noqa: F401
    from ugr_lightning.sim.robot import HOME_ACTION

    options = {"obs_mode": "rgb", "render_backend": "cpu", "image_size": (30, 40), "max_episode_steps": 6}
    environment = gymnasium.make("UGR-ClickAlarmclock-v1", **options)
    recorder = RecordEpisode(environment, str(tmp_path), trajectory_name="trajectory", save_video=False)
    seen, told = [recorder.reset(seed=5)[0]], []
    for step in range(4):
        told.append(np.float32(HOME_ACTION) + np.float32(0.02 * step))
        seen.append(recorder.step(told[-1])[0])
    recorder.close()
    episode = read(tmp_path)
    np.testing.assert_array_equal(episode.action, told)
    assert (episode.length, episode.seed, episode.image_size) == (4, 5, (30, 40))
    for step, observation in enumerate(seen[:-1]):
        np.testing.assert_allclose(episode.state[step], np.ravel(observation["agent"]["qpos"]), atol=1e-6)
        for camera, picture in zip(CAMERAS, episode.images(step), strict=True):
            np.testing.assert_array_equal(picture, observation["sensor_data"][camera]["rgb"][0].numpy())
