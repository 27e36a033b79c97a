"""A folder is recognised by what is in it, or the error says what is there and what was looked for."""

import inspect
import shutil

import h5py
import numpy as np
import pytest
from recordings import record

from ugr_lightning.data.formats import EpisodeFormat, detect, find_format, formats, recognise
from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.errors import ConfigError, DataError


def test_every_format_is_found_and_says_what_it_looks_for():
    assert {"robotwin", "act", "original-act"} <= {form.name for form in formats()}
    assert len({form.name for form in formats()}) == len(formats())
    for form in formats():
        assert len(form.marks) > 5
        assert not inspect.isabstract(type(form))
    with pytest.raises(ConfigError, match=r"one of act, .*got zarr"):
        find_format("zarr")


def test_nothing_recognises_nothing(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "episode0.hdf5").write_bytes(b"no HDF5")
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{")
    (tmp_path / "trajectory.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with h5py.File(tmp_path / "episode_0.hdf5", "w") as file:
        file["unknown"] = np.zeros(3)
    for folder in (tmp_path, tmp_path / "nowhere", tmp_path / "trajectory.h5", tmp_path / "data"):
        assert recognise(folder) == []


def test_the_name_of_a_folder_means_nothing(tmp_path):
    shutil.move(record(tmp_path, count=2), tmp_path / "act")
    assert detect(tmp_path / "act").name == "robotwin"
    assert detect(tmp_path / "act" / "data").name == "robotwin"
    single = tmp_path / "act" / "data" / "episode1.hdf5"
    assert detect(single).name == "robotwin"
    assert [location.path for location in detect(single).find(single).values()] == [single]


def test_one_damaged_file_does_not_hide_the_format(tmp_path):
    folder = record(tmp_path, count=3)
    first = folder / "data" / "episode0.hdf5"
    first.write_bytes(first.read_bytes()[:1000])
    form = detect(folder)
    assert form.name == "robotwin"
    with pytest.raises(DataError, match=r"episode0\.hdf5.*truncated"):
        form.read(form.find(folder)[0], ("cam_high",))


def test_a_mixed_folder_is_refused(tmp_path):
    folder = record(tmp_path, count=2)
    find_format("act").write(tmp_path / "act", [read_episode(folder / "data" / "episode0.hdf5")])
    shutil.copy(tmp_path / "act" / "episode_0.hdf5", folder / "data" / "episode_5.hdf5")
    with pytest.raises(DataError, match="one format, got marks of act and robotwin"):
        detect(folder)


def _empty(folder):
    pass


def _foreign(folder):
    with h5py.File(folder / "episode_0.hdf5", "w") as file:
        file["unknown"] = np.zeros(3)


def _damaged(folder):
    (folder / "episode_0.hdf5").write_bytes(b"zip")


def _twice(folder):
    (folder / "episode_0.hdf5").touch()
    (folder / "episode0.hdf5").touch()


def _other_files(folder):
    (folder / "notes.txt").touch()


UNKNOWN = {
    "empty": (_empty, "an empty folder"),
    "foreign": (_foreign, r"episode_0\.hdf5 with the keys unknown"),
    "damaged": (_damaged, r"episode_0\.hdf5, a truncated or foreign file"),
    "contradiction": (_twice, "one file for episode 0"),
    "other files": (_other_files, r"notes\.txt"),
}


@pytest.mark.parametrize("case", UNKNOWN)
def test_what_is_not_recognised_is_described(case, tmp_path):
    make, message = UNKNOWN[case]
    make(tmp_path)
    with pytest.raises(DataError, match=message):
        detect(tmp_path)


def test_a_folder_that_does_not_exist_says_so_and_nothing_of_formats(tmp_path):
    with pytest.raises(DataError, match="nowhere: expected demonstrations, got nothing there"):
        detect(tmp_path / "nowhere")


def test_a_format_that_is_only_read_refuses_to_write(tmp_path, episode_file):
    class ReadOnly(EpisodeFormat):
        name, marks = "read-only", "nothing"
        recognises = find = peek = read = None

    with pytest.raises(ConfigError, match="a format that can be written, got read-only"):
        ReadOnly().write(tmp_path, [read_episode(episode_file)])
