import fcntl
import json
from threading import Thread

import numpy as np
import pytest
from made_up import episode as result
from scipy.stats import binomtest

from ugr_lightning.errors import DataError
from ugr_lightning.results.results import (
    append_result,
    drop_cut_off_line,
    read_results,
    success_table,
    summarize,
    wilson_interval,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "r.jsonl"


def test_wilson_interval_equals_scipy():
    for n in (1, 2, 10, 37, 100):
        for successes in range(n + 1):
            expected = binomtest(successes, n).proportion_ci(method="wilson")
            assert np.allclose(wilson_interval(successes, n), (expected.low, expected.high), atol=1e-12, rtol=0)


def test_wilson_interval_of_nothing_is_everything():
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_a_crashed_episode_counts_as_a_failure_and_is_flagged():
    summary = summarize([result(), result(1, success=False), result(2, success=False, crash="lost")])
    assert (summary.n, summary.successes, summary.crashed) == (3, 1, 1)
    assert "1 crashed" in str(summary)


def test_results_survive_the_file(tmp_path):
    written = [result(), result(1, log_variance={"mean": -1.5}, crash="x", success=False)]
    for entry in written:
        append_result(tmp_path / "deep" / "r.jsonl", entry)
    assert read_results(tmp_path / "deep" / "r.jsonl") == written


NEW = {"budgets": {"refine_ratio": 0.5}, "an alarm": {"disagreement": 0.5, "alarm": 3, "alarm_rate": 0.1}}


@pytest.mark.parametrize("new", NEW.values(), ids=NEW)
def test_files_from_before_there_was_something_are_still_read(path, new):
    path.write_text(json.dumps({name: value for name, value in result().to_dict().items() if name not in new}) + "\n")
    append_result(path, result(1, **new))
    assert read_results(path) == [result(), result(1, **new)]


def test_a_line_cut_off_by_a_crash_goes_with_the_next_one_of_whoever_shares_the_file(path):
    append_result(path, result(0))
    path.write_bytes(path.read_bytes() + b'{"task": "t", "se')
    append_result(path, result(1))
    assert [item.seed for item in read_results(path)] == [0, 1]


@pytest.mark.parametrize("change", [drop_cut_off_line, lambda path: append_result(path, result(2))])
def test_a_whole_line_that_lacks_only_its_end_is_kept(path, change):
    append_result(path, result(0))
    path.write_text(path.read_text() + json.dumps(result(1).to_dict()))
    change(path)
    assert [item.seed for item in read_results(path)][:2] == [0, 1]
    assert path.read_text().endswith("\n")


@pytest.mark.parametrize("change", [drop_cut_off_line, lambda path: append_result(path, result(1))])
def test_two_that_write_one_file_take_turns(path, change):
    append_result(path, result(0))
    with path.open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        other.write(b'{"task": "click_alarmclock", ')
        other.flush()
        waiting = Thread(target=change, args=(path,))
        waiting.start()
        waiting.join(0.2)
        assert waiting.is_alive()
        other.write(json.dumps(result(2).to_dict())[1:].replace('"task": "click_alarmclock", ', "").encode() + b"\n")
    waiting.join(10)
    assert {item.seed for item in read_results(path)} >= {0, 2}


@pytest.mark.parametrize("line", ["[1]", '{"task": "t"}', '{"tusk": "t"}', "{"])
def test_a_broken_line_is_named(path, line):
    append_result(path, result())
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(DataError, match="line 2"):
        read_results(path)


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("success", "yes", "true or false"),
        ("success", 1, "true or false"),
        ("seed", 1.5, "a whole number"),
        ("steps", True, "a whole number"),
        ("steps", 10**30, "a whole number"),
        ("first_success_step", "7", "a whole number or null"),
        ("seconds", 3, "an object with values that are a number"),
        ("seconds", {"query": "long"}, "an object with values that are a number"),
    ],
)
def test_a_value_of_another_kind_is_named_and_not_counted(path, key, value, wanted):
    path.write_text(json.dumps(result().to_dict() | {"refine_ratio": 1}) + "\n")
    assert len(read_results(path)) == 1
    path.write_text(json.dumps(result().to_dict() | {key: value}) + "\n")
    with pytest.raises(DataError) as raised:
        read_results(path)
    assert f"line 1, {key}: expected {wanted}, got {value!r}" in str(raised.value)


def test_a_missing_file_is_an_error_of_ours(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_results(tmp_path / "none.jsonl")


def test_table_has_a_row_per_policy_with_n_and_interval():
    table = success_table([result(), result(1, success=False), result(policy="zero", success=False)]).splitlines()
    assert len(table) == 4
    assert "1/2 = 50.0%" in table[2]
    assert "[9.5%, 90.5%]" in table[2]
    assert "zero" in table[3]
    assert "0/1" in table[3]


def test_a_policy_is_called_by_its_selector_and_by_its_checkpoint_only_where_names_are_alike():
    def column(*items):
        return [line.split("  ")[2].strip() for line in success_table(items).splitlines()[2:]]

    uncert = result(policy="ACT", checkpoint=64 * "a", refine="Uncertainty")
    block = result(policy="ACT", checkpoint=64 * "d", refine="Block")
    plain, other = (result(policy="ACT", checkpoint=64 * letter) for letter in "bc")
    assert column(uncert, block, plain) == ["ACT Uncertainty", "ACT Block", "ACT"]
    assert column(plain, other, uncert) == ["ACT bbbbbbbb", "ACT cccccccc", "ACT Uncertainty"], "never put together"
    before = result(policy="ACT", checkpoint=64 * "a")
    assert column(before, uncert) == column(uncert, before) == ["ACT Uncertainty"], "lines of before do not say it"
