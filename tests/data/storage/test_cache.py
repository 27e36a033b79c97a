"""Every cache delivers the same pictures, and a cache file never outlives what it was made from."""

import os
import pickle
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from foreign_files import ACT_CAMERAS, write_act
from PIL import Image
from recordings import arrays, record

from ugr_lightning.data.folder import episode_path, find_episodes
from ugr_lightning.data.formats import detect
from ugr_lightning.data.formats.robotwin import read_episode, write_episode
from ugr_lightning.data.storage import cache as cache_module
from ugr_lightning.data.storage.cache import open_frames
from ugr_lightning.errors import ConfigError, DataError


def _episodes(folder, cameras=("cam_high", "cam_left_wrist")):
    return [read_episode(path, cameras) for path in find_episodes(folder).values()]


def _folder(root):
    return root / "click_alarmclock" / "demo_clean"


@pytest.fixture
def folder(tmp_path):
    """Two episodes."""
    return record(tmp_path, count=2)


@pytest.mark.parametrize("image_size", [None, (12, 16), (7, 32)])
def test_ram_memmap_and_no_cache_give_the_same_pictures(image_size, tmp_path):
    episodes = _episodes(record(tmp_path, count=3))
    total = sum(episode.length for episode in episodes)
    frames = np.array([total - 1, 0, 8, 7, 6, 0])
    taken = [open_frames(episodes, cache, image_size).take(frames) for cache in ("ram", "memmap", "none")]
    assert taken[0].shape == (6, 2, *(image_size or (24, 32)), 3)
    assert taken[0].flags.c_contiguous
    assert not np.array_equal(taken[0][0], taken[0][1])
    np.testing.assert_array_equal(taken[0], taken[1])
    np.testing.assert_array_equal(taken[0], taken[2])
    if image_size is None:
        np.testing.assert_array_equal(taken[0][3], episodes[1].images(0))  # episode 0 has 7 steps
        np.testing.assert_array_equal(taken[0][0], episodes[2].images(12))


def test_reading_without_a_cache_keeps_few_files_open(tmp_path, monkeypatch):
    monkeypatch.setattr(cache_module, "OPEN_EPISODES", 3)
    episodes = _episodes(record(tmp_path, count=8))
    store = open_frames(episodes, "none")
    starts = np.cumsum([0] + [episode.length for episode in episodes[:-1]])
    kept = [row.copy() for row in store.take(starts)]
    opened = {os.readlink(path) for path in Path("/proc/self/fd").iterdir() if path.exists()}
    assert sum(path.startswith(str(tmp_path)) for path in opened) <= 3
    for row, again in zip(kept, store.take(starts), strict=True):
        np.testing.assert_array_equal(row, again)


def test_shrinking_averages_areas(recording_root):
    episodes = _episodes(_folder(recording_root))[:1]
    small = open_frames(episodes, "ram", (12, 16)).take(np.array([3]))[0, 0].astype(float)
    blocks = episodes[0].images(3)[0].reshape(12, 2, 16, 2, 3).mean((1, 3))
    assert np.abs(small - blocks).max() <= 1  # rounded once per direction


def test_a_memmap_is_decoded_once_and_again_when_an_episode_changes(folder, monkeypatch):
    decoded = []
    original = cache_module._decode_all
    monkeypatch.setattr(cache_module, "_decode_all", lambda *a: (decoded.append(1), original(*a)))
    open_frames(_episodes(folder), "memmap")
    open_frames(_episodes(folder), "memmap")
    assert len(decoded) == 1
    write_episode(episode_path(folder, 1), **arrays(steps=10, seed=77))
    store = open_frames(_episodes(folder), "memmap")
    assert len(decoded) == 2
    np.testing.assert_array_equal(store.take(np.array([7]))[0], _episodes(folder)[1].images(0))
    assert len(list((folder / ".cache").glob("frames-*-*"))) == 1
    open_frames(_episodes(folder, ("cam_high",)), "memmap")
    assert len(decoded) == 3


def _open_slowly(folder, log):
    decode = cache_module._decode_all

    def slowly(*arguments):
        with open(log, "a") as file:
            file.write("decoded\n")
        time.sleep(0.5)
        decode(*arguments)

    cache_module._decode_all = slowly
    store = open_frames(_episodes(folder), "memmap")
    for step in range(6):
        np.testing.assert_array_equal(store.take(np.array([step]))[0], _episodes(folder)[0].images(step))


def test_processes_that_want_the_same_memmap_at_once_wait_for_the_one_that_decodes(folder, tmp_path):
    log = tmp_path / "log"
    processes = [get_context("fork").Process(target=_open_slowly, args=(folder, log)) for _ in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]
    assert log.read_text() == "decoded\n"


def test_what_a_killed_process_left_of_a_memmap_is_removed(folder):
    open_frames(_episodes(folder), "memmap")
    (path,) = (folder / ".cache").glob("*.npy")
    path.rename(path.with_name(f"{path.name}.1.partial"))
    open_frames(_episodes(folder), "memmap")
    assert list((folder / ".cache").glob("frames-*-*")) == [path]


def test_an_interrupted_memmap_is_not_taken_for_a_whole_one(folder, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(cache_module, "_decode_all", interrupted)
        with pytest.raises(KeyboardInterrupt):
            open_frames(_episodes(folder), "memmap")
    store = open_frames(_episodes(folder), "memmap")
    np.testing.assert_array_equal(store.take(np.array([1]))[0], _episodes(folder)[0].images(1))


def test_a_damaged_memmap_names_the_file_and_says_what_to_do(folder):
    open_frames(_episodes(folder), "memmap")
    (path,) = (folder / ".cache").glob("*.npy")
    for content in (b"", b"junk" * 100, path.read_bytes()[:-1]):
        path.write_bytes(content)
        with pytest.raises(DataError, match="Remove the file"):
            open_frames(_episodes(folder), "memmap")


@pytest.mark.parametrize("cache", ["ram", "memmap", "none"])
def test_stores_travel_to_other_processes(cache, folder):
    store = open_frames(_episodes(folder), cache)
    packed = pickle.dumps(store)
    if cache == "memmap":
        assert len(packed) < 1000  # the path, not the pictures
    np.testing.assert_array_equal(pickle.loads(packed).take(np.array([9])), store.take(np.array([9])))


OF_THE_SECOND = {"all cameras": dict.fromkeys(ACT_CAMERAS, (20, 16)), "one camera": {"cam_left_wrist": (30, 40)}}


@pytest.mark.parametrize("cache", ["ram", "memmap", "none"])
@pytest.mark.parametrize("case", OF_THE_SECOND)
def test_pictures_of_different_sizes_need_one_whichever_episode_and_camera_they_are_of(case, cache, tmp_path):
    write_act(tmp_path, 1)
    write_act(tmp_path, 1, name="episode_1{}.hdf5", sizes=OF_THE_SECOND[case])
    form = detect(tmp_path)
    episodes = [form.read(location, ACT_CAMERAS) for location in form.find(tmp_path).values()]
    other, smallest = ("20x16", "20,16") if case == "all cameras" else ("30x40", "24,32")
    message = rf"24x32 in cam_high of episode_0 .*, {other} in .* of episode_10 .*image_size \[{smallest}\]"
    with pytest.raises(ConfigError, match=message):
        open_frames(episodes, cache)
    pictures = open_frames(episodes, cache, (12, 16)).take(np.array([0, 14]))
    assert pictures.shape == (2, 3, 12, 16, 3)
    larger = np.asarray(Image.fromarray(episodes[1].frames.pictures(0)[2]).resize((16, 12), Image.Resampling.BOX))
    np.testing.assert_array_equal(pictures[1, 2], larger)
    with pytest.raises(ConfigError, match="at most the stored size"):
        open_frames(episodes, cache, (25, 32))


@pytest.mark.parametrize("image_size", [(48, 64), (24, 33), (0, 5)])
def test_enlarging_is_refused(image_size, recording_root):
    with pytest.raises(ConfigError, match="image_size"):
        open_frames(_episodes(_folder(recording_root)), "none", image_size)


def test_too_little_memory_says_what_to_use_instead(recording_root, monkeypatch):
    monkeypatch.setattr(cache_module, "available_memory", lambda: 1000)
    with pytest.raises(ConfigError, match="memmap"):
        open_frames(_episodes(_folder(recording_root)), "ram")


def test_an_unknown_cache_is_refused(recording_root):
    with pytest.raises(ConfigError, match="gpu"):
        open_frames(_episodes(_folder(recording_root)), "gpu")
