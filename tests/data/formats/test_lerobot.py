"""Samples are written here as lerobot's writer leaves them: several episodes in a table and in a video, lossless."""

import io
import json
import pickle

import numpy as np
import pytest
from PIL import Image
from recordings import prepared

from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.formats import detect
from ugr_lightning.data.formats.lerobot import LeRobot
from ugr_lightning.data.layout import DEFAULT_LAYOUT, Layout
from ugr_lightning.data.storage import video
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, DataError

av = pytest.importorskip("av", reason="the extra `lerobot` is not installed")
pyarrow = pytest.importorskip("pyarrow", reason="the extra `lerobot` is not installed")
pq = pytest.importorskip("pyarrow.parquet")

FORMAT = LeRobot()
SIZE, FPS = (32, 48), 30
LENGTHS = (9, 14, 5, 11)
FILES = ((0, 1, 2), (3,))  # episodes in each file
JOINTS = [f"joint {number}" for number in range(14)]


def colour(episode, camera, step):
    return 20 + 15 * step, 40 + 50 * episode, 30 + 70 * camera


def joints(episode, what=0):
    return np.random.default_rng([episode, what]).normal(size=(LENGTHS[episode], 14)).astype(np.float32)


def picture(episode, camera, step):
    frame = np.empty((*SIZE, 3), np.uint8)
    frame[:] = colour(episode, camera, step)
    frame[:8, :8] = 255 - frame[:8, :8]  # so that up, down, left and right are told apart
    return frame


def png(array):
    out = io.BytesIO()
    Image.fromarray(array).save(out, "PNG")
    return out.getvalue()


def write_video(path, frames, keyframes=12):
    """Lossless RGB, most frames predicted from others, and not stored in the order they are shown in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", FPS, options={"qp": "0", "g": str(keyframes), "bf": "3"})
        stream.height, stream.width, stream.pix_fmt = *SIZE, "rgb24"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def features(kind="video"):
    found = {
        "observation.state": {"dtype": "float32", "shape": [14], "names": {"motors": JOINTS}},
        "action": {"dtype": "float32", "shape": [14], "names": JOINTS},
    }
    for camera in CAMERAS:
        names = ["height", "width", "channels"]
        found[f"observation.images.{camera}"] = {"dtype": kind, "shape": [*SIZE, 3], "names": names}
    counters = ("frame_index", "episode_index", "index", "task_index")
    found["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    return found | {name: {"dtype": "int64", "shape": [1], "names": None} for name in counters}


def write_dataset(root, kind="video", keyframes=12, **info):
    """Two tables and two videos per camera, of three episodes and of one; the order of rows is lerobot's."""
    starts = np.cumsum([0, *LENGTHS])
    rows = []
    for number, episodes in enumerate(FILES):
        tables, start = [], 0.0
        for episode in episodes:
            length = LENGTHS[episode]
            columns = {
                "observation.state": pyarrow.array(list(joints(episode)), pyarrow.list_(pyarrow.float32(), 14)),
                "action": pyarrow.array(list(joints(episode, 1)), pyarrow.list_(pyarrow.float32(), 14)),
            }
            for view, camera in enumerate(CAMERAS if kind == "image" else ()):
                data = [{"bytes": png(picture(episode, view, t)), "path": f"{t}.png"} for t in range(length)]
                columns[f"observation.images.{camera}"] = pyarrow.array(data)
            columns["timestamp"] = pyarrow.array((np.arange(length) / FPS).astype(np.float32))
            columns["frame_index"] = pyarrow.array(np.arange(length))
            columns["episode_index"] = pyarrow.array(np.full(length, episode))
            columns["index"] = pyarrow.array(np.arange(starts[episode], starts[episode + 1]))
            columns["task_index"] = pyarrow.array(np.full(length, episode % 2))
            tables.append(pyarrow.table(columns))
            row = {"episode_index": episode, "tasks": [f"task {episode % 2}"], "length": length}
            row |= {"data/chunk_index": 0, "data/file_index": number}
            row |= {"dataset_from_index": int(starts[episode]), "dataset_to_index": int(starts[episode + 1])}
            for camera in CAMERAS if kind == "video" else ():
                key = f"videos/observation.images.{camera}"
                row |= {f"{key}/chunk_index": 0, f"{key}/file_index": number}
                row |= {f"{key}/from_timestamp": start, f"{key}/to_timestamp": start + length / FPS}
            start += length / FPS
            rows.append(row)
        path = root / f"data/chunk-000/file-{number:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, tables[0].schema, compression="snappy") as writer:
            for table in tables:
                writer.write_table(table)
        for view, camera in enumerate(CAMERAS if kind == "video" else ()):
            frames = [picture(episode, view, t) for episode in episodes for t in range(LENGTHS[episode])]
            write_video(root / f"videos/observation.images.{camera}/chunk-000/file-{number:03d}.mp4", frames, keyframes)
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pyarrow.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
    content = {
        "codebase_version": "v3.0",
        "robot_type": "aloha",
        "total_episodes": len(LENGTHS),
        "total_frames": sum(LENGTHS),
        "fps": FPS,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features(kind),
    }
    (root / "meta/info.json").write_text(json.dumps(content | info, indent=4))
    return root


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """A dataset with videos; not to be changed."""
    return write_dataset(tmp_path_factory.mktemp("videos"))


@pytest.fixture
def dataset(tmp_path):
    """A dataset with pictures in its tables, to be damaged."""
    return write_dataset(tmp_path / "dataset", "image")


def read(folder, index=0, cameras=CAMERAS, layout=DEFAULT_LAYOUT):
    return FORMAT.read(FORMAT.find(folder)[index], cameras, layout)


def edit_info(root, **changes):
    content = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(content | changes))


def edit_table(path, change):
    rows = pq.read_table(path).to_pylist()
    pq.write_table(pyarrow.Table.from_pylist(change(rows)), path)


EPISODES, DATA = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"


def test_episodes_of_several_files_are_found_in_order_with_their_lengths(videos):
    assert detect(videos).name == "lerobot"
    found = FORMAT.find(videos)
    assert list(found) == [0, 1, 2, 3]
    episodes = [FORMAT.read(location, CAMERAS) for location in found.values()]
    assert [episode.length for episode in episodes] == list(LENGTHS)
    assert [episode.name for episode in episodes] == ["episode0", "episode1", "episode2", "episode3"]
    assert [episode.extras["instruction"] for episode in episodes] == ["task 0", "task 1"] * 2
    assert episodes[0].extras["control_hz"] == FPS


@pytest.mark.parametrize("kind", ["video", "image"])
def test_an_action_is_the_command_of_its_own_row(kind, videos, tmp_path):
    folder = videos if kind == "video" else write_dataset(tmp_path, kind)
    for index in range(len(LENGTHS)):
        episode = read(folder, index)
        np.testing.assert_array_equal(episode.state, joints(index))
        np.testing.assert_array_equal(episode.action, joints(index, 1))


def check_pictures(episode, index, steps, cameras=(0, 1, 2)):
    for step in steps:
        for view, found in zip(cameras, episode.images(step), strict=True):
            np.testing.assert_array_equal(found, picture(index, view, step), err_msg=f"{index} {view} {step}")


@pytest.mark.parametrize("index", range(4))
def test_every_picture_is_exact_in_order_and_in_any_order(index, videos):
    episode, rng = read(videos, index), np.random.default_rng(index)
    check_pictures(episode, index, range(episode.length))
    check_pictures(episode, index, rng.integers(episode.length, size=25))
    copy = pickle.loads(pickle.dumps(episode.frames))
    out = np.empty((3, *SIZE, 3), np.uint8)
    copy.read(3, out)
    np.testing.assert_array_equal(out[2], picture(index, 2, 3))


def test_pictures_are_exact_where_only_the_first_frame_can_be_jumped_to(tmp_path):
    folder = write_dataset(tmp_path, keyframes=250)
    check_pictures(read(folder, 2), 2, (4, 0, 3, 1, 2))
    check_pictures(read(folder, 1, CAMERAS[1:]), 1, (13, 12, 0, 5), (1, 2))


def test_pictures_in_order_are_decoded_without_jumping(videos, monkeypatch):
    jumps = []
    monkeypatch.setattr(
        video._Decoder, "_jump", lambda self, *a, jump=video._Decoder._jump: (jumps.append(a), jump(self, *a))
    )
    check_pictures(read(videos, 1), 1, range(14))
    assert len(jumps) == len(CAMERAS)


def test_pictures_in_the_table_are_exact(dataset):
    episode = read(dataset, 1, CAMERAS[::-1])
    check_pictures(episode, 1, (0, 13, 5, 6), (2, 1, 0))
    episode.frames.close()
    check_pictures(pickle.loads(pickle.dumps(episode)), 1, [7], (2, 1, 0))


def test_cameras_and_joints_are_known_by_their_names(videos):
    contents = FORMAT.peek(FORMAT.find(videos)[0])
    assert (contents.cameras, contents.state, contents.action) == (CAMERAS, tuple(JOINTS), tuple(JOINTS))
    layout = Layout({"top": "observation.images.cam_high"}, state=("joint 13", 0), action=("joint 2",))
    episode = read(videos, 0, ("cam_left_wrist", "top"), layout)
    np.testing.assert_array_equal(episode.state, joints(0)[:, [13, 0]])
    np.testing.assert_array_equal(episode.action, joints(0, 1)[:, [2]])
    check_pictures(episode, 0, [4], (2, 0))
    with pytest.raises(ConfigError, match=r"cam_high.*got cam_top"):
        read(videos, 0, ("cam_top",))
    with pytest.raises(DataError, match=r"\(T, 7\).*\(9, 14\)"):
        read(videos, layout=Layout(state=7))


def test_a_data_module_gives_the_rows_of_the_dataset_with_every_cache(tmp_path):
    folder = write_dataset(tmp_path)
    batches = []
    for cache in ("none", "ram", "memmap"):
        data = ChunkDataModule(folder=str(folder), episodes=4, batch_size=5, cache=cache, chunk_length=6)
        batches.append(next(iter(prepared(data).train_dataloader())))
    for batch in batches:
        for row in range(5):
            index, step = int(batch.episode[row]), int(batch.step[row])
            np.testing.assert_array_equal(batch.state[row], joints(index)[step])
            np.testing.assert_array_equal(batch.actions[row, 0], joints(index, 1)[step])
            shown = batch.images[row].numpy().transpose(0, 2, 3, 1)
            np.testing.assert_array_equal(shown, [picture(index, view, step) for view in range(3)])


@pytest.mark.parametrize(("version", "message"), [("v2.1", "convert_dataset_v21_to_v30"), ("v4.0", "Update")])
def test_other_versions_say_what_to_do(version, message, dataset):
    edit_info(dataset, codebase_version=version)
    assert detect(dataset).name == "lerobot"
    with pytest.raises(DataError, match=rf"v3\.0, got {version}.*{message}"):
        FORMAT.find(dataset)


INFO = {
    "no rate": {"fps": 0},
    "rate of another kind": {"fps": "30"},
    "features a list": {"features": ["action"]},
    "features without shape": {"features": {"action": {"dtype": "float32"}}},
    "no action": {"features": {"observation.state": {"dtype": "float32", "shape": [14]}}},
    "no data path": {"data_path": None},
    "another data path": {"data_path": "data/{episode}.parquet"},
    "a path outside": {"data_path": "../../other/file-{file_index}.parquet"},
    "a path from the root": {"data_path": "/etc/passwd"},
    "a path that reads attributes": {"data_path": "{chunk_index.real.nothing}"},
    "a path of absurd width": {"data_path": "{chunk_index:99999999999}"},
    "another number of episodes": {"total_episodes": 5},
}


@pytest.mark.parametrize("case", INFO)
def test_damaged_metadata_are_one_clear_error(case, dataset):
    edit_info(dataset, **INFO[case])
    with pytest.raises(DataError, match=r"info\.json"):
        read(dataset)


@pytest.mark.parametrize("content", ["", "[1]", "{", "[" * 100_000, '{"fps": 1}', "\0\xff"])
def test_what_is_no_description_is_not_recognised(content, dataset):
    (dataset / "meta/info.json").write_text(content)
    assert not FORMAT.recognises(dataset)
    with pytest.raises(DataError, match=r"info\.json"):
        FORMAT.find(dataset)


def changed(name, value, row=0):
    def change(rows):
        rows[row][name] = value
        return rows

    return change


TABLES = {
    "an episode twice": (EPISODES, changed("episode_index", 1), r"one row for episode 1"),
    "a length that is not there": (EPISODES, changed("length", 8), r"8 rows of episode 0, got 9 rows"),
    "no length": (EPISODES, changed("length", None), "length.*None"),
    "a file that is not there": (EPISODES, changed("data/file_index", 7), r"file-007\.parquet.*no such file"),
    "a negative file": (EPISODES, changed("data/file_index", -1), "data/file_index.*-1"),
    "no column of lengths": (EPISODES, lambda rows: [{"episode_index": r["episode_index"]} for r in rows], "length"),
    "rows between others": (DATA, lambda rows: [rows[9], *rows[:9], *rows[10:]][::-1], r"0 to 8"),
    "episodes mixed": (DATA, lambda rows: [rows[9 - 1], *rows[9:], *rows[:8]], r"with others between"),
    "rows missing": (DATA, lambda rows: rows[1:], r"9 rows of episode 0, got 8 rows"),
    "rows out of order": (DATA, lambda rows: [rows[1], rows[0], *rows[2:]], "frame_index"),
    "times of another rate": (DATA, changed("timestamp", 0.5, 4), r"timestamp.*1/30 s apart.*0\.5"),
    "times that are no numbers": (DATA, changed("timestamp", float("nan"), 4), "timestamp.*nan"),
    "no action": (DATA, lambda rows: [{k: v for k, v in row.items() if k != "action"} for row in rows], "no action"),
    "actions of texts": (DATA, lambda rows: [row | {"action": "left"} for row in rows], "action.*numbers"),
    "an action missing": (DATA, changed("action", None), "action.*1 rows without"),
    "a joint missing": (DATA, changed("action", [None] * 14), "action.*missing"),
    "an action too short": (DATA, changed("action", [0.0] * 3), r"action.*one length.*3, 14"),
    "NaN": (DATA, changed("action", [float("nan")] * 14, 2), r"action.*nan at \[2, 0\]"),
    "beyond float32": (DATA, changed("observation.state", [1e300] * 14), r"state.*inf at \[0, 0\]"),
    "a picture missing": (DATA, changed("observation.images.cam_high", None), "pictures in the file itself"),
    "a picture elsewhere": (
        DATA,
        changed("observation.images.cam_high", {"bytes": None, "path": "/etc/passwd"}),
        "pictures in the file itself",
    ),
    "no picture": (DATA, changed("observation.images.cam_high", {"bytes": b"GIF89a"}), r"cam_high\[0\].*PNG"),
    "a picture of another size": (
        DATA,
        changed("observation.images.cam_high", {"bytes": png(np.zeros((8, 8, 3), np.uint8))}),
        "pictures of one size",
    ),
}


@pytest.mark.parametrize("case", TABLES)
def test_damaged_tables_are_one_clear_error(case, dataset):
    name, change, message = TABLES[case]
    edit_table(dataset / name, change)
    with pytest.raises(DataError, match=message) as caught:
        read(dataset)
    assert str(dataset) in str(caught.value)


@pytest.mark.parametrize("name", [EPISODES, DATA])
def test_cut_tables_are_one_clear_error(name, dataset):
    good = (dataset / name).read_bytes()
    for content in (good[: len(good) // 2], good[:-4], b"PAR1", b""):
        (dataset / name).write_bytes(content)
        with pytest.raises(DataError, match=r"file-000\.parquet"):
            read(dataset)


VIDEO = "videos/observation.images.cam_high/chunk-000/file-000.mp4"


def test_missing_short_and_foreign_videos_are_one_clear_error(tmp_path):
    folder = write_dataset(tmp_path)
    path, good = folder / VIDEO, (folder / VIDEO).read_bytes()
    write_video(path, [picture(0, 0, t % 9) for t in range(20)])
    assert read(folder, 0).length == 9
    with pytest.raises(DataError, match=r"cam_high.*longer than.*got 0\.667 s"):
        read(folder, 1)
    unknown = good.replace(b"avc1", b"xxxx")
    for content, message in (
        (b"text", "readable video"),
        (good[: len(good) // 2], "readable video"),
        (unknown, "codec"),
    ):
        path.write_bytes(content)
        with pytest.raises(DataError, match=message):
            read(folder)
    path.unlink()
    with pytest.raises(DataError, match="no such file"):
        read(folder)
    edit_info(folder, video_path="../{video_key}.mp4")
    with pytest.raises(DataError, match="inside the dataset"):
        read(folder)


def test_without_the_extra_an_error_says_what_to_install(dataset, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    assert FORMAT.recognises(dataset)
    with pytest.raises(ConfigError, match=r"pyarrow.*ugr-lightning\[lerobot\]"):
        FORMAT.find(dataset)


def _to_hub_cache(root, hub):
    """As the hub's client keeps a repository: links in a snapshot to files named by their content."""
    snapshot = hub / "snapshots" / "0123abc"
    (hub / "blobs").mkdir(parents=True)
    for number, path in enumerate(sorted(path for path in root.rglob("*") if path.is_file())):
        blob, place = hub / "blobs" / str(number), snapshot / path.relative_to(root)
        blob.write_bytes(path.read_bytes())
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(blob)
    return snapshot


def test_one_task_of_a_hub_cache_is_trained_on_from_its_folder_or_its_snapshot(tmp_path, capsys):
    write_dataset(tmp_path / "source")
    snapshot = _to_hub_cache(tmp_path / "source", tmp_path / "datasets--x")
    for folder in (snapshot, tmp_path / "datasets--x"):
        data = ChunkDataModule(folder=str(folder), episodes=2, tasks="*1", chunk_length=3, batch_size=2)
        assert [episode.name for episode in prepared(data).demonstrations] == ["episode1", "episode3"]
        assert np.array_equal(data.demonstrations[1].action, joints(3, 1))
        assert data.control_hz == FPS
        assert "2 of 4 demonstrations are used" in capsys.readouterr().err
    mixed = ChunkDataModule(folder=str(snapshot), episodes=(0, 1, 2), chunk_length=3)
    mixed.prepare_data()
    assert "2 tasks are mixed: task 0 (2), task 1 (1)" in capsys.readouterr().err
    assert (mixed.positions_of("*1"), mixed.positions_of(())) == ({1}, {0, 1, 2})
    with pytest.raises(ConfigError, match=r"task 0 \(2\), task 1 \(2\)"):
        ChunkDataModule(folder=str(snapshot), tasks="push").prepare_data()


def test_a_linked_folder_of_videos_and_robotwins_names_of_cameras_are_understood(tmp_path):
    write_dataset(tmp_path / "set")
    info = tmp_path / "set/meta/info.json"
    names = {"cam_high": "head_camera", "cam_right_wrist": "right_camera", "cam_left_wrist": "left_camera"}
    for ours, theirs in names.items():
        info.write_text(info.read_text().replace(ours, theirs))
        key = "set/videos/observation.images."
        (tmp_path / (key + ours)).rename(tmp_path / (key + theirs))
        edit_table(
            tmp_path / "set" / EPISODES,
            lambda rows, a=ours, b=theirs: [{k.replace(a, b): v for k, v in row.items()} for row in rows],
        )
    (tmp_path / "set/videos").rename(tmp_path / "elsewhere")
    (tmp_path / "set/videos").symlink_to(tmp_path / "elsewhere")
    location = FORMAT.find(tmp_path / "set")[1]
    assert FORMAT.peek(location).cameras == CAMERAS
    episode = FORMAT.read(location, ("cam_left_wrist", "cam_high"))
    assert [tuple(shown[20, 20]) for shown in episode.images(4)] == [colour(1, 2, 4), colour(1, 0, 4)]
