import json
import math
import warnings
from dataclasses import asdict, replace

import numpy as np
import pytest
from fake_policy import Reacher
from made_up import episode

from ugr_lightning.errors import CheckpointError, ConfigError, DataError
from ugr_lightning.rollout.actors import PolicyActor
from ugr_lightning.rollout.alarm import (
    Alarm,
    alarm_report,
    alarms_path,
    conformal_threshold,
    read_alarms,
    set_alarm,
    write_alarms,
)
from ugr_lightning.rollout.evaluate import run_episodes
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.rollout.traces import read_traces
from ugr_lightning.uncertainty.failure import overlap_score

SEEDS = [0, 1, 5, 6]


class Waverer(Reacher):
    """Says something else whenever the hand has moved."""

    def predict(self, observation):
        chunk = super().predict(observation)
        return chunk._replace(actions=chunk.actions + 0.01 * (1000 * observation.state[:, None]).sin())


class Poisoned(Waverer):
    """Cannot say where a chunk ends, which is not executed."""

    def predict(self, observation):
        chunk = super().predict(observation)
        chunk.actions[:, -1] = float("inf")
        return chunk


def alarm(execution="2", **more):
    about = Alarm("abc", execution, "reach", "demo_clean", "hash", 40, 0.1, 0.5, 90)
    return replace(about, **more)


def roll(policy, execution="2", task="reach", alarms=(), slots=2, refine_ratio=None, **more):
    actor = PolicyActor(policy, alarms={item.execution: item for item in alarms}, refine_ratio=refine_ratio)
    small = {"image_size": (4, 6), "progress": False, "workers": 1, "slots_per_worker": slots}
    return run_episodes(actor, RolloutSpec(task, SEEDS, execution=execution, **small, **more))


@pytest.mark.usefixtures("fake_tasks")
@pytest.mark.parametrize("execution", ["aggregate", "2"])
def test_what_is_seen_while_an_episode_runs_is_what_its_trace_says(tmp_path, execution):
    results = roll(Waverer(), execution, traces=tmp_path)
    for trace, result in zip(read_traces(tmp_path.glob("*.npz")), results, strict=True):
        scores = overlap_score(np.ones(14))(trace)
        assert np.isnan(scores).tolist() == [True] + [False] * (len(scores) - 1)
        assert result.disagreement == pytest.approx(np.nanmax(scores), rel=0.05)  # traces have half the digits
        assert result.disagreement > 0.005
    assert roll(Waverer(), execution, slots=1)[2].disagreement == results[2].disagreement


@pytest.mark.usefixtures("fake_tasks")
def test_an_alarm_is_raised_with_the_first_chunk_that_disagrees_too_much_or_comes_too_late(tmp_path):
    free = roll(Waverer(), traces=tmp_path)
    assert {(result.alarm, result.alarm_rate) for result in free} == {(None, None)}
    trace = read_traces(tmp_path.glob("*.npz"))[0]
    scores = overlap_score(np.ones(14))(trace)
    threshold = np.sort(scores[1:])[-2] * 1.01
    first = int(trace.query[np.nanargmax(scores)])
    assert roll(Waverer(), alarms=[alarm(threshold=threshold)])[0].alarm == first
    late = roll(Waverer(), alarms=[alarm(threshold=9.0, steps=4)])
    assert [(result.alarm, result.alarm_rate) for result in late] == [(4, 0.1)] * 4
    assert [result.alarm for result in roll(Waverer(), alarms=[alarm(threshold=9.0)])] == [None] * 4
    assert [result.motion_hash for result in late] == [result.motion_hash for result in free]


@pytest.mark.usefixtures("fake_tasks")
@pytest.mark.parametrize(("execution", "refine_ratio"), [("3", None), ("2", 0.5)])
def test_an_alarm_for_another_execution_or_refinement_is_not_raised_and_that_is_said(execution, refine_ratio):
    with pytest.warns(UserWarning, match=f"No alarm with execution {execution}: it was set for .* execution 2"):
        results = roll(Waverer(), execution, alarms=[alarm(threshold=0.0, steps=0)], refine_ratio=refine_ratio)
    assert {(result.alarm, result.alarm_rate) for result in results} == {(None, None)}


@pytest.mark.usefixtures("fake_tasks")
def test_numbers_that_are_not_finite_far_ahead_in_a_chunk_are_not_compared():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(0 < result.disagreement < 1 for result in roll(Poisoned()))


def drawn(count, seed=0, **more):
    """Successful episodes that last and disagree as it happens."""
    rng = np.random.default_rng(seed)
    about = [{"disagreement": float(rng.exponential()), "steps": int(rng.integers(50, 5000))} for _ in range(count)]
    return [episode(index, **one, **more) for index, one in enumerate(about)]


def test_the_promise_holds_for_new_successes():
    share = []
    for seed in range(300):
        found = set_alarm(drawn(39, seed), 0.2)
        new = drawn(20, seed + 1000)
        share += [item.disagreement > found.threshold or item.steps > found.steps for item in new]
    assert 0.15 < np.mean(share) <= 0.2  # of both reasons together, 0.1 each
    assert (found.rate, found.successes, found.task, found.execution) == (0.2, 39, "click_alarmclock", "aggregate")


def test_failures_do_not_move_an_alarm():
    failures = [episode(1000 + seed, False, disagreement=99.0, steps=9999) for seed in range(30)]
    assert set_alarm(drawn(30) + failures, 0.1) == set_alarm(drawn(30), 0.1)


def unknown(results):
    return [replace(item, disagreement=None) for item in results]


@pytest.mark.parametrize(
    ("results", "rate", "said"),
    [
        (drawn(18), 0.1, r"at least 19 successes for a rate of 0.1.*18 of 18.*--rate"),
        (unknown(drawn(40)), 0.1, "from before there was an alarm"),
        (drawn(20) + drawn(20), 0.1, "each seed once"),
        ([*drawn(20), episode(99, task="reach", disagreement=1.0)], 0.1, "one task"),
    ],
)
def test_episodes_that_no_alarm_can_be_set_on_are_refused(results, rate, said):
    with pytest.raises(DataError, match=said):
        set_alarm(results, rate)


def test_a_rate_is_a_share():
    with pytest.raises(ConfigError, match="between 0 and 1"):
        set_alarm(drawn(20), 1.0)


def test_alarms_are_kept_beside_their_checkpoint_and_refused_beside_another(tmp_path):
    file, folder = tmp_path / "policy_best.ckpt", tmp_path / "v1.0"
    file.write_bytes(b"weights")
    folder.mkdir()
    for place in (file, folder):
        assert read_alarms(place, "abc") == {}
        written = write_alarms(place, [alarm("2"), alarm("aggregate", steps=7)])
        assert read_alarms(place, "abc") == {"2": alarm("2"), "aggregate": alarm("aggregate", steps=7)}
        with pytest.raises(CheckpointError, match=r"alarms of checkpoint other.*got abc.*`ugr alarm`"):
            read_alarms(place, "other")
        assert sorted(path.name for path in written.parent.glob("*.partial")) == []
    assert alarms_path(file).name == "policy_best.alarm.json"
    assert file.read_bytes() == b"weights"


EDITED = [("threshold", math.nan), ("execution", 2), ("execution", ["2"]), ("rate", "0.1"), ("steps", 10**400)]


@pytest.mark.parametrize(
    "content",
    ["", "{}", '[{"rate": 1}]', "[1]", "7", "[" * 100_000]
    + [json.dumps([asdict(alarm("2")) | {key: value}]) for key, value in EDITED],
)
def test_a_damaged_file_of_alarms_is_named(tmp_path, content):
    (tmp_path / "a.alarm.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"a\.alarm\.json"):
        read_alarms(tmp_path / "a.ckpt", "abc")


def watched(seed, success, raised=None, steps=200, **more):
    about = {"task": "reach", "execution": "2", "seeds_hash": "new", "alarm_rate": 0.1, "alarm": raised}
    return episode(seed, success, steps=steps, **about | more)


def test_promised_and_observed_alarms_stand_side_by_side():
    good = [watched(seed, True, 40 if seed == 0 else None, 60) for seed in range(10)]
    bad = [watched(20, False, 50), watched(21, False, 100), watched(22, False, 110), watched(23, False)]
    others = [watched(30, False, crash="lost"), watched(31, True, 9, execution="3"), watched(32, True, alarm_rate=None)]
    said = alarm_report(alarm(), good + bad + others)
    assert "in 1 of 10 [2%, 40%] successes (10% promised at most) and in 3 of 4 [30%, 95%] failures" in said
    assert "100 steps (median) before their end, 1 of them where chunks disagreed" in said
    assert "promise is for" not in said
    assert "set on" not in said
    assert "seeds that it was set on" in alarm_report(alarm(), [watched(0, True, seeds_hash="hash")])
    assert "promise is for reach (demo_clean)" in alarm_report(alarm(), [watched(0, True, setting="demo_randomized")])


def test_a_new_score_exceeds_the_conformal_threshold_as_rarely_as_asked():
    rng = np.random.default_rng(1)
    above = [rng.normal() > conformal_threshold(rng.normal(size=19), 0.1) for _ in range(4000)]
    assert 0.08 < np.mean(above) < 0.12  # exactly 0.1 for 19 scores
    assert conformal_threshold(np.arange(9.0), 0.1) == 8.0
    with pytest.raises(DataError, match="at least 9"):
        conformal_threshold(np.arange(8.0), 0.1)
