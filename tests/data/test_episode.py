"""An episode is opened late, in each process for itself, and travels between processes."""

import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import h5py
import numpy as np
import pytest

from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.errors import DataError


def test_reading_an_episode_keeps_no_file_open(episode_file):
    episode = read_episode(episode_file)
    assert episode.frames._opened is None
    episode.images(0)
    assert episode.frames._opened is not None
    episode.frames.close()
    assert episode.frames._opened is None
    assert episode.images(0).shape == (3, 24, 32, 3)


def test_a_pickled_episode_opens_its_own_file(episode_file):
    episode = read_episode(episode_file)
    expected = episode.images(4)
    copy = pickle.loads(pickle.dumps(episode))
    assert copy.frames._opened is None
    np.testing.assert_array_equal(copy.images(4), expected)


def _opened_by_child(episode):
    before = episode.frames._opened
    episode.images(2)
    return before is None or before[1] is not episode.frames._opened[1]


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_forked_process_does_not_use_the_parents_handle(episode_file):
    episode = read_episode(episode_file)
    episode.images(2)
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as pool:
        assert pool.submit(_opened_by_child, episode).result()


def test_a_frame_damaged_after_the_check_names_file_key_and_step(episode_file):
    episode = read_episode(episode_file)
    with h5py.File(episode_file, "r+") as file:
        jpeg = bytes(file["observation/right_camera/rgb"][6])
        file["observation/right_camera/rgb"][6] = jpeg[: len(jpeg) // 2] + b"\xff\xd9"
    with pytest.raises(DataError, match=r"episode0.hdf5:observation/right_camera/rgb\[6\].*JPEG of 24x32"):
        episode.images(6)


def test_a_file_that_vanished_is_a_data_error(episode_file):
    episode = read_episode(episode_file)
    episode_file.unlink()
    with pytest.raises(DataError, match=r"episode0.hdf5\[0\]"):
        episode.images(0)


def test_asking_beyond_the_last_frame_is_a_data_error(episode_file):
    with pytest.raises(DataError, match=r"\[99\]"):
        read_episode(episode_file).images(99)
