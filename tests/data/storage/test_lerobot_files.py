import json
from pathlib import Path

import numpy as np
import pytest
from folders import files_of

from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats import detect
from ugr_lightning.data.formats.lerobot import LeRobot
from ugr_lightning.data.storage.frames import FrameSource
from ugr_lightning.data.storage.lerobot_files import pool, summarise, write_dataset
from ugr_lightning.data.storage.video import write_videos
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, DataError

pytest.importorskip("av", reason="the extra `lerobot` is not installed")
pq = pytest.importorskip("pyarrow.parquet", reason="the extra `lerobot` is not installed")


FORMAT = LeRobot()
SIZE = (32, 48)


class Plain(FrameSource):
    """Smooth pictures in which the three colours differ, computed when they are asked for."""

    keys = CAMERAS
    files = ()

    def __init__(self, seed, size=SIZE):
        self.seed, self.image_size, self.closed = seed, size, False

    def read(self, step, out):
        height, width = self.image_size
        ramp = np.linspace(0, 60, width)[None] + np.linspace(0, 40, height)[:, None]
        for view in range(3):
            for channel, base in enumerate((20 + 8 * step, 30 + 40 * view, 100 + 10 * self.seed)):
                out[view, ..., channel] = base + ramp if channel != 1 else base + ramp[:, ::-1]

    def close(self):
        self.closed = True


def make(seed, steps=None, size=SIZE, width=14, **extras):
    rng = np.random.default_rng(seed)
    steps = steps or 6 + 2 * seed
    state, action = (rng.normal(size=(steps, width)).astype(np.float32) for _ in range(2))
    extras = {"control_hz": 25.0, "task": "click_alarmclock"} | extras
    return Episode(Path("demos/episode.hdf5"), CAMERAS, state, action, Plain(seed, size), extras=extras)


def make_all(count=3, **changes):
    return [make(seed, **changes) for seed in range(count)]


def read_all(folder):
    return [FORMAT.read(location, CAMERAS) for location in FORMAT.find(folder).values()]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A dataset of three episodes; not to be changed."""
    folder = tmp_path_factory.mktemp("written")
    write_dataset(folder, [make(0), make(1, instruction="press it"), make(2)])
    return folder


def test_what_was_written_is_read_back_exactly_but_for_the_codec(written):
    assert detect(written).name == "lerobot"
    found = read_all(written)
    assert [episode.extras["instruction"] for episode in found] == ["click alarmclock", "press it", "click alarmclock"]
    for index, (before, after) in enumerate(zip(make_all(), found, strict=True)):
        np.testing.assert_array_equal(after.state, before.state)
        np.testing.assert_array_equal(after.action, before.action)
        assert (after.extras["control_hz"], after.name) == (25.0, f"episode{index}")
        for step in (0, 1, before.length - 1, 2):
            difference = np.abs(after.images(step).astype(int) - before.images(step))
            assert (difference.mean() < 2, difference.max() < 20) == (True, True), (index, step)


def test_files_have_what_lerobot_looks_for(written):
    info = json.loads((written / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["splits"]) == ("v3.0", 25, {"train": "0:3"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 24, 2)
    assert info["features"]["observation.images.cam_high"]["shape"] == [*SIZE, 3]
    assert info["features"]["observation.images.cam_high"]["dtype"] == "video"
    tasks = pq.read_table(written / "meta/tasks.parquet").to_pandas()
    assert (list(tasks.index), list(tasks["task_index"])) == (["click alarmclock", "press it"], [0, 1])
    rows = pq.read_table(written / "data/chunk-000/file-001.parquet")
    types = {name: str(rows.schema.field(name).type) for name in rows.column_names}
    assert types == {
        "observation.state": "fixed_size_list<element: float>[14]",
        "action": "fixed_size_list<element: float>[14]",
        "timestamp": "float",
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64"),
    }
    assert rows["index"].to_pylist() == list(range(6, 14))
    assert rows["frame_index"].to_pylist() == list(range(8))
    assert set(rows["task_index"].to_pylist()) == {1}
    about = pq.read_table(written / "meta/episodes/chunk-000/file-002.parquet").to_pylist()[0]
    assert (about["dataset_from_index"], about["dataset_to_index"], about["length"]) == (14, 24, 10)
    key = "videos/observation.images.cam_left_wrist"
    assert (about[f"{key}/from_timestamp"], about[f"{key}/to_timestamp"]) == (0.0, 0.4)
    assert (written / key / "chunk-000/file-002.mp4").stat().st_size > 0
    assert not list(written.rglob("*.partial"))


def test_statistics_are_those_of_all_rows_and_pictures(written):
    found, episodes = json.loads((written / "meta/stats.json").read_text()), make_all()
    rows = np.concatenate([episode.action for episode in episodes]).astype(np.float64)
    for name, value in (("min", rows.min(0)), ("max", rows.max(0)), ("mean", rows.mean(0)), ("std", rows.std(0))):
        np.testing.assert_allclose(found["action"][name], value, rtol=1e-9)
    assert found["action"]["count"] == [24]
    pixels = np.stack([e.images(t)[2] for e in episodes for t in range(e.length)]) / 255  # (N, H, W, 3)
    wrist = found["observation.images.cam_left_wrist"]
    np.testing.assert_allclose(wrist["mean"], pixels.mean((0, 1, 2)).reshape(3, 1, 1), rtol=1e-9)
    np.testing.assert_allclose(wrist["std"], pixels.std((0, 1, 2)).reshape(3, 1, 1), rtol=1e-9)
    assert (wrist["count"], np.shape(wrist["q50"])) == ([24], (3, 1, 1))


def test_quantiles_of_an_episode_are_those_of_its_rows():
    found = summarise(np.arange(101.0).reshape(-1, 1))
    assert [float(found[name][0]) for name in ("q01", "q10", "q50", "q90", "q99")] == [1, 10, 50, 90, 99]
    assert pool([found, found])["q90"].tolist() == [90]


def test_stopped_in_the_middle_of_a_video_the_next_call_goes_on(tmp_path, monkeypatch):
    write_dataset(tmp_path / "complete", make_all())
    folder, broken = tmp_path / "stopped", make_all()
    monkeypatch.setattr(broken[2].frames, "read", lambda step, out: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_dataset(folder, broken)
    assert not FORMAT.recognises(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("file-00[01].*")}
    write_dataset(folder, make_all())
    assert len(before) == 10
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert files_of(folder) == files_of(tmp_path / "complete")


def test_a_finished_dataset_stays_as_it_is(tmp_path):
    write_dataset(tmp_path, make_all())
    before = files_of(tmp_path)
    indices = []
    write_dataset(tmp_path, make_all(), indices.append)
    assert indices == [0, 1, 2]
    with pytest.raises(DataError, match=r"info\.json.*Choose an empty folder"):
        write_dataset(tmp_path, make_all(2))
    assert before == files_of(tmp_path)


@pytest.mark.parametrize("size", [(31, 47), (32, 33)])
def test_odd_sizes_are_kept(size, tmp_path):
    write_dataset(tmp_path, make_all(2, size=size))
    assert [episode.image_size for episode in read_all(tmp_path)] == [size, size]


def test_a_single_joint_is_written_as_numbers_and_read_as_a_vector(tmp_path):
    write_dataset(tmp_path, make_all(2, width=1))
    assert str(pq.read_schema(tmp_path / "data/chunk-000/file-000.parquet").field("action").type) == "float"
    location = FORMAT.find(tmp_path)[1]
    episode = FORMAT.read(location, CAMERAS, FORMAT.peek(location).layout)
    np.testing.assert_array_equal(episode.action, make(1, width=1).action)


def test_pictures_are_closed_after_an_episode(tmp_path):
    episodes = make_all(2)
    write_dataset(tmp_path, episodes)
    assert [episode.frames.closed for episode in episodes] == [True, True]


REFUSED = {
    "no rate": ([make(0, control_hz=None)], r"one rate.*got None"),
    "a rate that is not whole": ([make(0, control_hz=16.67)], r"whole steps per second.*16\.67"),
    "different rates": ([make(0), make(1, control_hz=30.0)], r"one rate.*25\.0.*30\.0"),
    "other joints": ([make(0), make(1, width=7)], r"\(14, 14\) joints.*\(7, 7\)"),
    "another size": ([make(0), make(1, size=(16, 16))], r"cameras.*\(32, 48\).*\(16, 16\)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_episodes_that_do_not_go_together_are_refused_before_anything_is_written(case, tmp_path):
    episodes, message = REFUSED[case]
    with pytest.raises(DataError, match=message):
        write_dataset(tmp_path, episodes)
    assert not list(tmp_path.iterdir())


def test_a_dataset_has_at_least_one_episode(tmp_path):
    with pytest.raises(ConfigError, match="at least one"):
        write_dataset(tmp_path / "none", [])


def test_the_same_pictures_give_the_same_videos_every_time(tmp_path):
    rng, paths, seen = np.random.default_rng(0), [tmp_path / f"{camera}.mp4" for camera in CAMERAS], set()
    coarse = rng.integers(0, 256, (11, 3, 6, 8, 3), dtype=np.uint8)
    pictures = np.repeat(np.repeat(coarse, 4, axis=2), 4, axis=3)
    for _ in range(200):  # it once went wrong for 1 in 20 to 1 in 100
        write_videos(paths, iter(pictures), 25)
        seen.add(tuple(path.read_bytes() for path in paths))
    assert len(seen) == 1
