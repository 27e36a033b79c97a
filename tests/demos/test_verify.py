import json
from functools import partial
from itertools import count

import pytest
from fake_simulator import STEPS, FakeSimulator

from ugr_lightning.demos import verify
from ugr_lightning.demos.verify import (
    Performer,
    find_evaluation_seeds,
    perform,
    verify_determinism,
    verify_evaluation_seeds,
)
from ugr_lightning.errors import SimulationError
from ugr_lightning.sim import seeds
from ugr_lightning.sim.registry import open_simulator

pytestmark = pytest.mark.usefixtures("fake_tasks")

QUICK = {"workers": 1}


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
