import pytest
from made_up import drawn, evaluation

from ugr_lightning.errors import DataError
from ugr_lightning.results.report import ALL_TASKS, build_report
from ugr_lightning.results.stats import compare, mcnemar


def contest(report, task=None):
    return next(c for c in report.contests if task is None or c.task == task)


def test_rates_carry_every_training_seed_and_their_sum():
    runs = [evaluation("uncert", [1, 1, 0, 1]), evaluation("uncert", [0, 1, 0, 1], training_seed=1)]
    (rate,) = build_report(runs).rates
    assert (rate.total.successes, rate.total.n) == (5, 8)
    assert {seed: part.successes for seed, part in rate.by_training_seed.items()} == {0: 3, 1: 2}


def test_with_one_training_seed_a_contest_is_the_paired_comparison():
    a, b = drawn("base", 0.6, seed=1), drawn("uncert", 0.8, seed=2)
    c, expected = contest(build_report([a, b])), compare(b.results, a.results)
    assert (c.a, c.b, c.interval) == ("uncert", "base", "Newcombe")
    assert (c.difference, c.low, c.high) == pytest.approx((expected.difference, expected.low, expected.high))
    assert (c.only_a, c.only_b) == (expected.table.only_a, expected.table.only_b)
    assert c.p_value == pytest.approx(expected.p_value)
    assert c.p_holm == c.p_value


def test_p_values_are_corrected_within_their_mode():
    runs = [evaluation(name, [1] * n + [0] * (40 - n)) for name, n in (("base", 10), ("full", 18), ("uncert", 20))]
    report = build_report(runs)
    assert [(c.a, c.b) for c in report.contests] == [("full", "base"), ("uncert", "base"), ("uncert", "full")]
    assert report.contests[0].p_holm == pytest.approx(2 * mcnemar(8, 0))
    assert report.contests[1].p_holm == pytest.approx(3 * mcnemar(10, 0))
    assert [c.b for c in build_report(runs, baseline="base").contests] == ["base", "base"]


def test_a_seed_of_several_training_seeds_counts_once():
    runs = [evaluation("base", [0] * 6 + [1] * 6, training_seed=t) for t in range(3)]
    runs += [evaluation("uncert", [1] * 12, training_seed=t) for t in range(3)]
    c = contest(build_report(runs))
    assert (c.only_a, c.seeds, c.training_seeds, c.interval) == (18, 12, 3, "bootstrap")
    assert c.p_value == mcnemar(6, 0) > mcnemar(18, 0)


def test_tasks_are_pooled_and_weigh_the_same():
    runs = []
    for task, n in (("click_alarmclock", 7), ("handover_block", 12), ("hanging_mug", 9)):
        runs += [evaluation("base", [0] * 4 + [1] * (n - 4), task=task), evaluation("uncert", [1] * n, task=task)]
    report = build_report(runs)
    c = contest(report, ALL_TASKS)
    assert c.p_value == mcnemar(12, 0)
    assert c.difference == pytest.approx((4 / 7 + 4 / 12 + 4 / 9) / 3)
    assert c.tasks == 3
    assert all(c.p_value > 0.05 for c in report.contests if c.task != ALL_TASKS)


def test_execution_modes_are_never_mixed():
    runs = [
        evaluation(p, [1, 0], execution=e, training_seed=0) for p in ("base", "uncert") for e in ("aggregate", "25")
    ]
    report = build_report(runs)
    assert [c.mode.execution for c in report.contests] == ["aggregate", "25"]
    assert all(c.seeds == 2 for c in report.contests)


def test_what_has_no_counterpart_is_left_out_and_said():
    runs = [evaluation("base", [1, 0, 1, 1]), evaluation("uncert", [1, 0]), evaluation("uncert", [1], training_seed=1)]
    report = build_report(runs)
    assert contest(report).seeds == 2
    assert contest(report).left_out == 3
    assert any("3 episodes have no counterpart" in remark for remark in report.remarks)


def test_policies_without_common_training_seeds_are_not_compared():
    assert build_report([evaluation("base", [1]), evaluation("uncert", [1], training_seed=1)]).contests == []


def test_unknown_training_seeds_are_numbered_and_said():
    runs = [evaluation("base", [1, 0], training_seed=None, checkpoint=sha) for sha in ("abc", "def")]
    report = build_report(runs)
    assert list(report.rates[0].by_training_seed) == [0, 1]
    assert "`base`" in report.remarks[0]


def test_files_of_other_tasks_are_no_other_training_seeds():
    tasks = ("mug", "handover_block", "mug")
    parts = [drawn("a", 0.5, task=t, training_seed=None, checkpoint=f"{n}") for n, t in enumerate(tasks)]
    found = build_report([*parts, drawn("b", 0.5, task="handover_block")])
    assert [(rate.task, list(rate.by_training_seed)) for rate in found.rates if rate.policy == "a"] == [
        ("mug", [0, 1]),
        ("handover_block", [0]),
    ]
    assert [contest.task for contest in found.contests] == ["handover_block"]


def test_files_of_one_checkpoint_are_of_one_training_seed():
    parts = {
        execution: evaluation("a", [1, 0], training_seed=None, checkpoint="abc", execution=execution)
        for execution in ("25", "aggregate")
    }
    rates = build_report(list(parts.values())).rates
    assert [list(rate.by_training_seed) for rate in rates] == [[0], [0]]
    again = evaluation("a", [1, 0], training_seed=None, checkpoint="abc", execution="25")
    with pytest.raises(DataError, match="one results file"):  # not a second training
        build_report([*parts.values(), again])


def test_crashed_episodes_are_failures_and_said():
    run = evaluation("base", [1, 1])
    run.results[0].crash = "signal 11"
    report = build_report([run])
    assert report.rates[0].total.successes == 1
    assert report.remarks == ["1 episodes crashed; each counts as a failure."]


def test_two_files_of_one_run_and_two_seed_lists_are_refused():
    with pytest.raises(DataError, match="one results file"):
        build_report([evaluation("base", [1]), evaluation("base", [1])])
    other = evaluation("uncert", [1])
    other.results[0].seeds_hash = "another"
    with pytest.raises(DataError, match="one list of seeds"):
        build_report([evaluation("base", [1]), other])
    with pytest.raises(DataError, match="baseline"):
        build_report([evaluation("base", [1])], baseline="bse")
