import re

import pytest
from made_up import drawn, evaluation

from ugr_lightning.results.conclusions import conclude, described_execution
from ugr_lightning.results.report import build_report


def words(*runs):
    conclusion = conclude(build_report(runs))
    return " ".join(conclusion.may), " ".join(conclusion.may_not)


def test_a_clear_winner_of_one_training_seed_is_one_between_checkpoints():
    may, may_not = words(drawn("base", 0.5, seed=1), drawn("uncert", 0.9, seed=2))
    assert "`uncert` succeeds more often than `base` in click_alarmclock" in may
    assert "of these checkpoints" in may
    assert "one training seed shows one checkpoint each" in may_not


def test_the_winner_is_named_whichever_comes_first():
    a, b = drawn("uncert", 0.9, seed=2), drawn("base", 0.5, seed=1)
    assert words(a, b) == words(b, a)
    assert re.search(r"`uncert` succeeds .* `base` .*: [89]\d\.\d% against [45]\d\.\d%, difference \+", words(a, b)[0])


def test_a_clear_winner_over_training_seeds_is_one_between_trainings():
    runs = [drawn("base", 0.5, seed=t, training_seed=t) for t in range(4)]
    runs += [drawn("uncert", 0.9, seed=9 + t, training_seed=t) for t in range(4)]
    may, may_not = words(*runs)
    assert "It holds over the 4 training seeds" in may
    assert "training" not in may_not


def test_two_training_seeds_are_called_too_few():
    runs = [drawn(p, r, seed=t, training_seed=t) for p, r in (("base", 0.3), ("uncert", 0.9)) for t in range(2)]
    may, may_not = words(*runs)
    assert "2 training seeds are too few to know how much training again would vary" in may
    assert "2 training seeds underestimate it" in may_not


def test_training_seeds_that_disagree_do_not_make_a_winner_of_the_training():
    solved = [[1] * n + [0] * (100 - n) for n in (100, 40, 100, 40)]
    runs = [evaluation("uncert", outcomes, training_seed=t) for t, outcomes in enumerate(solved)]
    runs += [evaluation("base", [1] * 50 + [0] * 50, training_seed=t) for t in range(4)]
    may, _ = words(*runs)
    assert "another training could show none" in may


def test_no_difference_on_many_seeds_bounds_the_difference():
    may, may_not = words(drawn("base", 0.9, n=800, seed=1), drawn("uncert", 0.9, n=800, seed=1))
    assert "differ by less than" in may
    assert "more often" not in may
    assert "too few" not in may_not


def test_too_few_episodes_say_nothing_and_how_many_would():
    may, may_not = words(evaluation("base", [1] * 7 + [0] * 3), evaluation("uncert", [0] * 2 + [1] * 7 + [0]))
    assert may == ""
    assert "Whether `uncert` or `base` is better" in may_not
    assert "are too few" in may_not
    fewer = words(evaluation("base", [1] * 5 + [0] * 5), evaluation("uncert", [1] * 8 + [0] * 2))[1]
    assert "shared seeds to be found with 80 % power" in fewer


@pytest.mark.parametrize("rate", [1.0, 0.0, 0.6])
@pytest.mark.parametrize(("n", "bound"), [(30, None), (100, "4%"), (400, "1%")])
def test_policies_that_agree_on_every_episode_are_not_called_closer_than_their_number_allows(rate, n, bound):
    solved = [1] * round(rate * n) + [0] * (n - round(rate * n))
    report = build_report([evaluation(p, solved, training_seed=t) for p in ("base", "uncert") for t in (0, 1)])
    (contest,) = report.contests
    assert contest.interval == "Wilson"
    assert contest.high == -contest.low == pytest.approx(1.96**2 / (n + 1.96**2), rel=1e-3)
    conclusion = conclude(report)
    if bound is None:
        assert conclusion.may == []
        assert "too few" in conclusion.may_not[0]
    else:
        assert f"differ by less than {bound} in click_alarmclock" in conclusion.may[0]


def test_a_single_differing_episode_does_not_make_the_bound_tighter_than_none_does():
    solved = [1] * 100
    runs = [evaluation(p, solved, training_seed=t) for p in ("base", "uncert") for t in (0, 1)]
    runs[0] = evaluation("base", [0, *solved[1:]], training_seed=0)
    report = build_report(runs)
    assert report.contests[0].high < 0.03  # of the bootstrap
    assert "differ by less than 4% in" in conclude(report).may[0]


def test_many_comparisons_that_show_nothing_share_a_sentence_and_one_that_shows_something_has_its_own():
    rates = {"a": 0.9, "b": 0.9, "c": 0.9, "d": 0.9, "worse": 0.5}
    conclusion = conclude(build_report([drawn(name, rate, n=400, seed=1) for name, rate in rates.items()]))
    assert sum("succeeds more often than `worse`" in sentence for sentence in conclusion.may) == 4
    (shared,) = [sentence for sentence in conclusion.may if "show no difference" in sentence]
    assert shared.startswith("6 pairs differ by less than 1% each in click_alarmclock")
    assert all(pair in shared for pair in ("`b` - `a` +0.0%", "`d` - `c` +0.0%"))
    few = conclude(build_report([drawn(name, 0.9, n=20, seed=i) for i, name in enumerate("abcd")]))
    (shared, _, _) = few.may_not
    assert shared.startswith("Which is better in click_alarmclock")
    assert "6 pairs that may differ by 10% or more" in shared
    assert "n = 20 seeds, no p below" in shared


def test_every_execution_is_put_into_words():
    runs = [evaluation(p, [1, 0] * 50, execution="aggregate-variance") for p in ("base", "uncert")]
    assert "chunks aggregated with inverse variance" in words(*runs)[0]
    assert [described_execution(name) for name in ("aggregate", "25", "own")] == [
        "aggregated chunks",
        "25 steps of each chunk",
        "own",
    ]


def test_with_several_tasks_the_pooled_comparison_decides_and_single_tasks_are_mentioned():
    runs = []
    for number, task in enumerate(("click_alarmclock", "handover_block")):
        runs += [drawn("base", 0.4, seed=number, task=task), drawn("uncert", 0.9, seed=9 + number, task=task)]
    may, may_not = words(*runs)
    assert "over 2 tasks" in may
    assert "By themselves these tasks show a difference" in may
    assert "not as a sample" in may_not


@pytest.mark.parametrize(
    ("runs", "said"),
    [([], "there are no episodes"), ([evaluation("base", [1])], "no two policies were evaluated in the same task")],
)
def test_without_a_comparison_it_says_so(runs, said):
    assert said in words(*runs)[1]
