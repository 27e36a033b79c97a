import json
from pathlib import Path

import made_up
import pytest

from ugr_lightning.errors import DataError
from ugr_lightning.results.evaluations import Evaluation
from ugr_lightning.results.results import summarize
from ugr_lightning.results.summaries import read_evaluations, read_summary, write_summary


def episode(seed, execution, success, crash=None, sha="abc"):
    return made_up.episode(seed, success, execution=execution, crash=crash, checkpoint=sha)


@pytest.fixture
def evaluations():
    mixed = [episode(3, "25", True), episode(1, "aggregate", False, "killed"), episode(2, "25", False)]
    named = Evaluation("DP", None, Path("b"), [episode(3, "6", True)], {"6": "as published"})
    return [Evaluation("ACT", 0, Path("a"), mixed), Evaluation("ACT", 1, Path("c"), [episode(3, "25", True)]), named]


@pytest.fixture
def path(evaluations, tmp_path):
    """The summary of these evaluations."""
    write_summary(evaluations, tmp_path / "summary.jsonl")
    return tmp_path / "summary.jsonl"


def facts(found):
    kept = ("task", "setting", "policy", "checkpoint", "seeds_hash", "seed", "success", "steps")
    return {
        (
            item.policy,
            item.training_seed,
            item.modes.get(r.execution, r.execution),
            r.crash is None,
            *(getattr(r, name) for name in kept),
        )
        for item in found
        for r in item.results
    }


def test_what_comparisons_need_survives_the_file(evaluations, path):
    again = read_evaluations(path.parent)
    assert facts(again) == facts(evaluations)
    assert [summarize(item.results) for item in again] == [summarize(item.results) for item in evaluations]


def test_executions_keep_their_order_and_seeds_are_sorted(tmp_path):
    mixed = [episode(3, "aggregate", True), episode(1, "25", True), episode(2, "aggregate", True)]
    write_summary([Evaluation("ACT", 0, Path("a"), mixed)], tmp_path / "summary.jsonl")
    again = [(r.execution, r.seed) for item in read_evaluations(tmp_path) for r in item.results]
    assert again == [("aggregate", 2), ("aggregate", 3), ("25", 1)]


def test_an_episode_of_the_table_takes_a_few_bytes(tmp_path):
    found = [episode(100_000 + seed, "25", seed % 3 > 0) for seed in range(100)]
    write_summary([Evaluation("ACT", 0, Path("a"), found)], tmp_path / "summary.jsonl")
    assert (tmp_path / "summary.jsonl").stat().st_size < 2500


@pytest.mark.parametrize(
    "change",
    [
        {"policy": 3},
        {"seeds": None},
        {"seeds": [1, 1]},
        {"steps": []},
        {"steps": [1.5, 2.5]},
        {"succeeded": [77]},
        {"crashed": [True]},
        {"training_seed": "0"},
        {"checkpoint": 7},
    ],
)
def test_a_line_that_is_no_summary_is_named(change, path):
    first, second, *others = path.read_text().splitlines()
    path.write_text("\n".join([first, json.dumps(json.loads(second) | change), *others]))
    with pytest.raises(DataError, match=r"summary.jsonl, line 2"):
        read_summary(path)


def test_a_broken_line_is_named(path):
    path.write_text(path.read_text()[:-40])
    with pytest.raises(DataError, match="line 4"):
        read_summary(path)


def test_files_of_unknown_training_seeds_stay_apart(tmp_path):
    found = [Evaluation("ACT", None, Path(name), [episode(1, "25", True, sha=name)]) for name in ("a", "b")]
    write_summary(found, tmp_path / "summary.jsonl")
    assert [len(item.results) for item in read_summary(tmp_path / "summary.jsonl")] == [1, 1]


def test_nothing_counts_twice(path):
    path.write_text(path.read_text() + path.read_text().splitlines()[0])
    with pytest.raises(DataError, match="line 5"):
        read_summary(path)
