import shutil
from functools import partial

import h5py
import numpy as np
import pytest
from fake_simulator import STEPS, FakeSimulator

from ugr_lightning.data.folder import episode_path
from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.demos.collect import collect
from ugr_lightning.demos.executed import read_executed
from ugr_lightning.demos.replay import Replayer, replay
from ugr_lightning.errors import DataError
from ugr_lightning.sim.registry import open_simulator

pytestmark = pytest.mark.usefixtures("fake_tasks")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, fake_tasks):
    folder = tmp_path_factory.mktemp("recorded")
    collect("reach", folder, episodes=3, workers=1, image_size=(24, 32), progress=False)
    return folder


@pytest.fixture
def episodes(recorded, tmp_path):
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    return [episode_path(tmp_path, index) for index in range(3)]


def again(paths, **more):
    return replay(paths, workers=1, **more)


def alone(path):
    """Replay one recording without a process."""
    return Replayer(partial(open_simulator, "reach", render=False)).replay(read_executed(path))


def change(path, key, edit):
    with h5py.File(path, "r+") as file:
        file[key][...] = edit(file[key][...])


def set_attributes(path, **values):
    with h5py.File(path, "r+") as file:
        for name, value in values.items():
            if value is None:
                del file.attrs[name]
            else:
                file.attrs[name] = value


def test_what_was_executed_is_executed_again_to_the_same_end(episodes):
    results = again(episodes)
    assert [result.path for result in results] == episodes
    assert [result.seed for result in results] == [0, 1, 2]
    assert all(result.success and result.identical and result.steps == STEPS for result in results)
    assert "bit for bit" in str(results[0])


def test_the_last_command_and_the_noise_are_part_of_what_was_executed(episodes):
    executed, episode = read_executed(episodes[0]), read_episode(episodes[0])
    assert executed.actions.shape == (STEPS, 14)
    assert executed.measured.shape == (STEPS + 1, 14)
    np.testing.assert_array_equal(executed.actions[:-1], episode.state[1:])
    assert np.abs(executed.actions - episode.action).max() > 1e-3
    assert executed.task_version == episode.extras["task_version"] == FakeSimulator.version


def test_other_commands_are_noticed(episodes):
    change(episodes[1], "joint_action/vector", lambda vector: vector * 0.0)
    assert alone(episodes[0]).success
    bad = alone(episodes[1])
    assert not bad.success
    assert bad.deviation > 0.3
    assert "NO SUCCESS" in str(bad)


def test_joints_that_differ_in_the_last_bit_are_not_identical(episodes):
    change(episodes[0], "ugr/measured", lambda joints: np.nextafter(joints, np.float32(9)))
    result = alone(episodes[0])
    assert result.success
    assert not result.identical
    assert 0 < result.deviation < 1e-6


def test_a_simulator_that_dies_is_a_failure_of_that_episode_only(episodes):
    for path in episodes:
        set_attributes(path, task=np.bytes_("deadly"))
    results = again([episodes[2], *episodes[:2]])
    assert [result.success for result in results] == [False, True, True]
    assert "SIGKILL" in str(results[0])


@pytest.mark.parametrize("name", ["seed", "task", "setting"])
def test_a_recording_that_does_not_say_what_it_is_of_is_refused(episodes, name):
    set_attributes(episodes[0], **{name: None})
    with pytest.raises(DataError, match=f"got no {name}.*ugr collect"):
        again(episodes)


def test_a_recording_without_measured_joints_is_refused(episodes):
    with h5py.File(episodes[0], "r+") as file:
        del file["ugr/measured"]
    with pytest.raises(DataError, match="measured joints"):
        again(episodes)


def test_a_recording_of_another_task_version_or_task_is_refused_before_a_simulator_starts(episodes, monkeypatch):
    set_attributes(episodes[0], task=np.bytes_("click_alarmclock"), task_version=99)
    with pytest.raises(DataError, match="got one of version 99"):
        again(episodes[:1])
    monkeypatch.delenv("UGR_TASKS")
    with pytest.raises(DataError, match="a task that is here, got reach"):
        again(episodes[1:])


def test_a_file_that_does_not_say_its_version_can_be_read(episodes):
    set_attributes(episodes[0], task_version=None)
    assert read_executed(episodes[0]).task_version is None
    assert "task_version" not in read_episode(episodes[0]).extras
    assert alone(episodes[0]).success
