import json

import pytest
from made_up import episodes

from ugr_lightning.errors import DataError
from ugr_lightning.results.evaluations import RunInfo, read_benchmark, read_labelled
from ugr_lightning.results.results import append_result


def write(path, outcomes, **about):
    for result in episodes(outcomes, **about):
        append_result(path, result)


@pytest.fixture
def benchmark(tmp_path):
    for policy in ("base", "uncert"):
        folder = tmp_path / "results" / policy
        RunInfo(policy, "click_alarmclock", 3, "c0ffee", checkpoint_sha256="abc", seconds={"fit": 1.5}).write(folder)
        write(folder / "results.jsonl", [1, 0])
    return tmp_path


def test_a_benchmark_is_read_from_its_folder_or_from_a_copy_of_its_results(benchmark):
    found = read_benchmark(benchmark)
    assert [(item.policy, item.training_seed, len(item.results)) for item in found] == [
        ("base", 3, 2),
        ("uncert", 3, 2),
    ]
    assert read_benchmark(benchmark / "results") == found


def test_evaluations_come_in_the_order_of_the_grid_and_those_that_do_not_say_it_last(benchmark):
    for place, (policy, job) in enumerate((("zebra", 0), ("ant", 12), ("bee", 2))):
        RunInfo(policy, "click_alarmclock", 0, "c0ffee", job=job).write(benchmark / "results" / str(place))
    assert [item.policy for item in read_benchmark(benchmark)] == ["zebra", "bee", "ant", "base", "uncert"]


def test_a_run_without_episodes_yet_is_there_and_empty(benchmark):
    (benchmark / "results" / "base" / "results.jsonl").unlink()
    assert read_benchmark(benchmark)[0].results == []


def test_episodes_of_another_checkpoint_are_not_mixed_in(benchmark):
    write(benchmark / "results" / "base" / "results.jsonl", [1], checkpoint="other", execution="25")
    with pytest.raises(DataError, match="other"):
        read_benchmark(benchmark)


@pytest.mark.parametrize("content", ["{", "[]", '{"policy": "base"}', json.dumps({"unknown": 1})])
def test_a_damaged_run_file_is_named(benchmark, content):
    (benchmark / "results" / "base" / "run.json").write_text(content)
    with pytest.raises(DataError, match=r"run\.json"):
        read_benchmark(benchmark)


def test_a_folder_without_results_is_explained(tmp_path):
    with pytest.raises(DataError, match="--runs"):
        read_benchmark(tmp_path)


def test_a_single_file_gets_its_training_seed_from_the_config_beside_it(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    write(path, [1, 0])
    assert read_labelled("base", path).training_seed is None
    (tmp_path / "config.yaml").write_text("seed_everything: 7\n")
    assert read_labelled("base", path).training_seed == 7


@pytest.mark.parametrize("content", ["", "\n"])
def test_a_file_without_episodes_is_said_to_be_one(tmp_path, content):
    (tmp_path / "empty.jsonl").write_text(content)
    with pytest.raises(DataError, match=r"expected episodes, got none. .*ugr rollout"):
        read_labelled("base", tmp_path / "empty.jsonl")


def test_dummies_in_the_file_of_a_demo_are_left_out_and_repetitions_count_once(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    write(path, [0, 0], checkpoint=None, policy="zero")
    assert len(read_labelled("zero", path).results) == 2
    write(path, [1, 0])
    write(path, [1, 0])
    assert [item.policy for item in read_labelled("base", path).results] == ["ACT", "ACT"]


def test_a_seed_that_went_two_ways_and_two_checkpoints_in_a_file_are_refused(tmp_path):
    write(tmp_path / "a.jsonl", [1])
    write(tmp_path / "a.jsonl", [0])
    with pytest.raises(DataError, match="seed 100000"):
        read_labelled("base", tmp_path / "a.jsonl")
    write(tmp_path / "b.jsonl", [1])
    write(tmp_path / "b.jsonl", [1], checkpoint="def")
    with pytest.raises(DataError, match="one policy"):
        read_labelled("base", tmp_path / "b.jsonl")


def test_of_several_policies_in_a_file_one_can_be_chosen(tmp_path):
    path = tmp_path / "a.jsonl"
    for checkpoint, policy in (("abc", "ACT"), ("def", "ACT"), ("def", "ACT(refine_ratio=0)"), (None, "zero")):
        write(path, [1], checkpoint=checkpoint, policy=policy)
    for which, checkpoint in (("ab", "abc"), ("ACT(refine_ratio=0)", "def"), ("zero", None)):
        assert [item.checkpoint for item in read_labelled("x", f"{path}@{which}").results] == [checkpoint]
    for which, got in (("", "3 of ACT abc, ACT def, ACT"), ("@ACT", "2 of ACT abc, ACT def"), ("@12", "0 of ACT abc")):
        with pytest.raises(DataError, match=got):
            read_labelled("x", f"{path}{which}")
    path.rename(tmp_path / "a@b.jsonl")
    assert len(read_labelled("x", f"{tmp_path}/a@b.jsonl@ab").results) == 1
