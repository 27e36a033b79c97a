"""The lists beside the episodes, and how episode files are found."""

import json

import numpy as np
import pytest

from ugr_lightning.data.folder import (
    find_episodes,
    read_scene_info,
    read_seeds,
    write_instructions,
    write_scene_info,
    write_seeds,
)
from ugr_lightning.errors import DataError


def _touch(folder, *names):
    (folder / "data").mkdir(exist_ok=True)
    for name in names:
        (folder / "data" / name).touch()


def test_all_three_spellings_of_episode_files_are_found_in_numerical_order(tmp_path):
    _touch(tmp_path, "episode10.hdf5", "episode_2.hdf5", "episode_0000001.hdf5", "episode3.hdf5.partial", "notes.txt")
    _touch(tmp_path, "episode_x.hdf5")
    assert list(find_episodes(tmp_path)) == [1, 2, 10]
    assert find_episodes(tmp_path / "nowhere") == {}


def test_a_file_without_a_number_does_not_change_those_of_others(tmp_path):
    _touch(tmp_path, "b.hdf5", "a.h5")
    assert {index: path.name for index, path in find_episodes(tmp_path).items()} == {0: "a.h5", 1: "b.hdf5"}
    _touch(tmp_path, *(f"demo_{number}.hdf5" for number in (0, 1, 2, 3, 10, 11)), "calibration_7.hdf5")
    found = {index: path.name for index, path in find_episodes(tmp_path).items()}
    assert found == {n: f"demo_{n}.hdf5" for n in (0, 1, 2, 3, 10, 11)}


def test_files_of_several_names_none_of_which_most_have_count_in_the_order_of_their_names(tmp_path):
    _touch(tmp_path, "pick_0.hdf5", "pick_1.hdf5", "place_0.hdf5", "place_1.hdf5")
    assert [path.stem for path in find_episodes(tmp_path).values()] == ["pick_0", "pick_1", "place_0", "place_1"]
    assert list(find_episodes(tmp_path)) == [0, 1, 2, 3]


def test_two_files_for_one_episode_are_an_error(tmp_path):
    _touch(tmp_path, "episode1.hdf5", "episode_0000001.hdf5")
    with pytest.raises(DataError, match="one file for episode 1"):
        find_episodes(tmp_path)


def test_seeds_are_separated_by_spaces_and_come_back(tmp_path):
    write_seeds(tmp_path, [0, 2, np.int64(5)])
    assert (tmp_path / "seed.txt").read_text().split(" ") == ["0", "2", "5\n"]
    assert read_seeds(tmp_path) == [0, 2, 5]
    assert read_seeds(tmp_path / "nowhere") == []


def test_scene_info_has_robotwins_keys_and_comes_back(tmp_path):
    write_scene_info(tmp_path, {1: {"pose": np.arange(3.0)}, 0: {"side": "left", "n": np.float32(2)}})
    assert list(json.loads((tmp_path / "scene_info.json").read_text())) == ["episode_0", "episode_1"]
    assert read_scene_info(tmp_path) == {0: {"side": "left", "n": 2.0}, 1: {"pose": [0.0, 1.0, 2.0]}}
    assert read_scene_info(tmp_path / "nowhere") == {}


def test_instructions_are_lists_of_seen_and_unseen(tmp_path):
    write_instructions(tmp_path, 7, ["press the button"])
    written = json.loads((tmp_path / "instructions" / "episode7.json").read_text())
    assert written == {"seen": ["press the button"], "unseen": []}


@pytest.mark.parametrize(
    ("name", "content", "read"),
    [
        ("seed.txt", "1 2 three", read_seeds),
        ("seed.txt", "1" * 5000, read_seeds),
        ("scene_info.json", "{", read_scene_info),
        ("scene_info.json", "[1]", read_scene_info),
        ("scene_info.json", '{"scene": {}}', read_scene_info),
        ("scene_info.json", '{"episode_0": 3}', read_scene_info),
    ],
)
def test_damaged_lists_are_one_clear_error(tmp_path, name, content, read):
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match=name):
        read(tmp_path)
