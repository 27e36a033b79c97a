import json
from functools import partial
from itertools import count

import pytest
from fake_simulator import STEPS, FakeSimulator

from ugr_lightning.demos import verify
from ugr_lightning.demos.survey import Performer, perform, read_surveys, survey, write_survey
from ugr_lightning.demos.verify import find_evaluation_seeds, verify_determinism, verify_evaluation_seeds
from ugr_lightning.errors import DataError, SimulationError
from ugr_lightning.results.results import wilson_interval
from ugr_lightning.sim import seeds
from ugr_lightning.sim.registry import open_simulator

pytestmark = pytest.mark.usefixtures("fake_tasks")

QUICK = {"workers": 1}
SMALL = QUICK | {"image_sizes": ((12, 16), (24, 32)), "episodes": 10, "dummy_episodes": 2, "recordings": 2}


@pytest.fixture(scope="module")
def row(fake_tasks):
    return survey("reach", first_seed=0, **SMALL)


def perform_here(task, seeds, *, opened=open_simulator, **_):
    """`perform` without a process."""
    performer = Performer(partial(opened, task, render=False))
    return [performer.perform(seed) for seed in seeds]


def test_the_expert_performs_to_the_end_of_its_script():
    first, third = perform_here("reach", [0, 3])
    assert (first.seed, first.success, first.steps) == (0, True, STEPS)
    assert (third.success, third.steps) == (False, 0)
    assert first.motion_hash != third.motion_hash


def test_a_simulator_that_dies_is_a_failure(capsys):
    results = perform("deadly", [1, 2], **QUICK)
    assert [item.success for item in results] == [True, False]
    assert "Seed 2 counts as a failure" in capsys.readouterr().err


def test_a_pose_out_of_reach_is_told_with_its_seed(capsys):
    results = perform("out_of_reach", [2, 3], **QUICK)
    assert [item.success for item in results] == [True, False]
    assert "Seed 3: left arm, phase `reach`: expected a tool pose within its reach, got" in capsys.readouterr().err


def test_a_row_counts_successes_lengths_and_costs(row):
    assert (row.expert.successes, row.expert.n) == (8, 10)  # the expert gives up on 3 and 8
    assert (row.expert.low, row.expert.high) == wilson_interval(8, 10)
    assert row.failures == (3, 8)
    assert row.steps == (STEPS, STEPS, STEPS)
    assert (row.zero.successes, row.zero.n) == (0, 2)
    assert row.random.n == 2
    assert [cost.image_size for cost in row.recordings] == [(12, 16), (24, 32)]
    assert all(cost.episodes == 2 and cost.seconds > 0 for cost in row.recordings)
    assert 0 < row.recordings[0].megabytes < row.recordings[1].megabytes


def test_dummies_and_recordings_can_be_left_out():
    row = survey("reach", first_seed=0, **SMALL | {"dummy_episodes": 0, "recordings": 0, "episodes": 1})
    assert (row.zero.n, row.random.n, row.recordings) == (0, 0, ())
    assert row.expert.n == 1


def test_rows_are_added_and_replaced_in_both_files(row, tmp_path):
    stem = tmp_path / "table"
    write_survey(stem, row)
    write_survey(stem, row.__class__(**{**row.__dict__, "setting": "demo_randomized", "recordings": ()}))
    table = write_survey(stem, row)
    assert (tmp_path / "table.md").read_text() == table
    rows = read_surveys(tmp_path / "table.json")
    assert [found["setting"] for found in rows] == ["demo_clean", "demo_randomized"]
    assert rows[0]["failures"] == [3, 8]
    assert "| reach | demo_clean | 8/10 [49.0, 94.3] | 12 (12 to 12) | 0/2 [0.0, 65.8] |" in table
    assert "s at 16x12 | MB at 16x12 | s at 32x24" in table
    assert len({line.count("|") for line in table.splitlines() if line.startswith("|")}) == 1


def test_a_file_of_something_else_is_not_overwritten(row, tmp_path):
    (tmp_path / "table.json").write_text(json.dumps([{"task": "reach"}]))
    with pytest.raises(DataError, match="Move it away"):
        write_survey(tmp_path / "table", row)
    assert json.loads((tmp_path / "table.json").read_text()) == [{"task": "reach"}]


class Remembering(FakeSimulator):
    """What ran before shows in the joints."""

    resets = count()

    def _start(self, seed):
        super()._start(seed)
        self.measured = self.measured.copy()
        self.measured[5] = 1e-6 * next(self.resets)


def test_equal_episodes_agree_and_a_simulator_with_a_memory_is_caught(monkeypatch):
    settings = QUICK | {"episodes": 6, "first_seed": 4}
    result = verify_determinism("reach", **settings)
    assert (result.n, result.differing) == (6, (8,))  # 8 has no step: nothing was shown
    assert "5 of 6 agree, not 8" in str(result)
    monkeypatch.setattr(verify, "perform", partial(perform_here, opened=Remembering))
    assert len(verify_determinism("reach", **settings).differing) == 6


def test_the_shipped_seeds_are_exactly_those_that_the_expert_solves(monkeypatch):
    monkeypatch.setattr(verify, "perform", perform_here)
    monkeypatch.setattr(verify, "evaluation_seeds", lambda task: [100000, 100001, 100002, 100003])
    result = verify_evaluation_seeds("reach", **QUICK)
    assert result.differing == (100003,)
    monkeypatch.setattr(verify, "evaluation_seeds", lambda task: [100000, 100002, 100004])
    assert verify_evaluation_seeds("reach", **QUICK).differing == (100001,)


@pytest.fixture
def its_seeds(monkeypatch, tmp_path):
    """The list of the task `reach`, whose expert gives up on every fifth seed."""
    monkeypatch.setattr(verify, "perform", perform_here)
    for module in (verify, seeds):
        monkeypatch.setattr(module, "seeds_file", lambda task: tmp_path / "reach.json")
        monkeypatch.setattr(module, "task_version", lambda task: 4)
    return tmp_path / "reach.json"


def test_the_first_seeds_that_the_expert_solves_are_written_and_read_back(its_seeds):
    assert find_evaluation_seeds("reach", count=9, **QUICK) == its_seeds
    solved = [100000, 100001, 100002, 100004, 100005, 100006, 100007, 100009, 100010]
    assert json.loads(its_seeds.read_text()) == {
        "task": "reach",
        "version": 4,
        "skipped": [100003, 100008],
        "seeds": solved,
    }
    assert seeds.evaluation_seeds("reach") == solved
    assert [path.name for path in its_seeds.parent.iterdir()] == [its_seeds.name]


def test_an_expert_that_fails_leaves_the_list_as_it_was(its_seeds):
    its_seeds.write_text("before")
    with pytest.raises(SimulationError, match=r"got failures on 9 of 9: 100000, .* 100004 and 4 more\. Watch it"):
        find_evaluation_seeds("unsolvable", count=9, **QUICK)
    assert its_seeds.read_text() == "before"


def test_a_seed_list_of_another_version_is_refused_before_anything_runs(monkeypatch):
    monkeypatch.setattr(seeds, "task_version", lambda task: 99)
    with pytest.raises(SimulationError, match="got a seed list of click_alarmclock, version"):
        verify_evaluation_seeds("click_alarmclock")
