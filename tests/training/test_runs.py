import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.training.runs import claim_version, home_of, resolve_checkpoint, run_folder


@pytest.fixture
def root(tmp_path):
    for version, files in ((0, ["last.ckpt", "policy_best.ckpt"]), (2, ["last.ckpt"]), (10, [])):
        folder = tmp_path / "runs" / "uncert" / f"version_{version}"
        folder.mkdir(parents=True)
        for name in files:
            (folder / name).touch()
    return tmp_path / "runs"


def test_last_and_best_are_those_of_the_newest_version_that_has_them(root):
    assert resolve_checkpoint("last", "uncert", root) == root / "uncert" / "version_2" / "last.ckpt"
    assert resolve_checkpoint("best", "uncert", root) == root / "uncert" / "version_0" / "policy_best.ckpt"


def test_where_no_run_is_named_it_is_the_newest_also_in_a_group(root):
    assert resolve_checkpoint("last", None, root) == root / "uncert" / "version_2" / "last.ckpt"
    newest = root / "group" / "base" / "version_0" / "last.ckpt"
    newest.parent.mkdir(parents=True)
    newest.touch()
    os.utime(newest, (2**31, 2**31))
    assert resolve_checkpoint("last", None, root) == newest


def test_a_run_may_be_named_by_its_folder(root):
    folder = root / "uncert" / "version_0"
    assert resolve_checkpoint("last", str(folder), root) == folder / "last.ckpt"
    assert resolve_checkpoint(str(folder / "last.ckpt"), "anything", root) == folder / "last.ckpt"


@pytest.mark.parametrize(("which", "run"), [("last", "uncart"), ("best_loss", "uncert"), ("no/such.ckpt", "uncert")])
def test_a_missing_checkpoint_is_an_error_and_never_a_fresh_start(root, which, run):
    with pytest.raises(CheckpointError) as caught:
        resolve_checkpoint(which, run, root)
    if run == "uncart":
        assert "uncert" in caught.value.fix


def test_no_runs_at_all_is_explained(tmp_path):
    with pytest.raises(CheckpointError, match="ugr fit"):
        resolve_checkpoint("last", "uncert", tmp_path / "runs")


def test_only_another_checkpoint_than_the_wanted_one_is_said(root):
    with pytest.raises(CheckpointError, match="Use --checkpoint last"):
        resolve_checkpoint("best", str(root / "uncert" / "version_2"), root)


def test_versions_count_on_from_the_highest(root, tmp_path):
    os.makedirs(root / "uncert" / "version_x")
    assert claim_version(root / "uncert").name == "version_11"
    assert claim_version(tmp_path / "new") == tmp_path / "new" / "version_0"


def test_each_of_many_that_ask_at_once_gets_a_folder_of_its_own(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        claimed = list(pool.map(lambda _: claim_version(tmp_path / "run"), range(40)))
    assert len(set(claimed)) == 40


def test_a_file_where_the_folder_of_a_run_should_be_is_said(tmp_path):
    (tmp_path / "run").touch()
    with pytest.raises(ConfigError, match="in the way"):
        claim_version(tmp_path / "run")


@pytest.mark.parametrize(
    ("run", "folder"),
    [
        ("a", "runs/a"),
        ("here", "runs/here"),  # a folder of that name in the working folder is not meant
        ("group/a", "runs/group/a"),
        ("runs/a", "runs/a"),
        ("runs/a/version_0", "runs/a/version_0"),
        ("./here", "here"),
        ("../b", "../b"),
        ("here/a", "here/a"),
        ("/tmp/c", "/tmp/c"),
        ("~/c", "/home/me/c"),
    ],
)
def test_the_folder_of_a_run_may_be_given_in_place_of_its_name(tmp_path, monkeypatch, run, folder):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    Path("here/a").mkdir(parents=True)
    assert run_folder(run, Path("runs")) == Path(folder)


def test_a_version_belongs_to_its_run():
    assert home_of(Path("runs/a/version_3")) == home_of(Path("runs/a")) == Path("runs/a")


def test_a_run_that_saved_nothing_is_trained_anew_and_one_of_a_group_is_chosen(tmp_path):
    (tmp_path / "short" / "version_0").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="train it anew"):
        resolve_checkpoint("last", "short", tmp_path)
    (tmp_path / "group" / "one" / "version_0").mkdir(parents=True)
    (tmp_path / "group" / "one" / "version_0" / "last.ckpt").touch()
    with pytest.raises(CheckpointError, match="choose one with --run"):
        resolve_checkpoint("last", "group", tmp_path)
