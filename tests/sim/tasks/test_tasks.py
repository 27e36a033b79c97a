import importlib.abc
import sys

import pytest

from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim.sapien_simulator import SapienSimulator
from ugr_lightning.sim.tasks import environment_id, load_task, task_names, task_summaries, task_version


def test_every_task_has_a_summary_a_horizon_and_a_version():
    summaries = task_summaries()
    for name in task_names():
        assert summaries[name].endswith(".")
        task = load_task(name)
        assert task.horizon > 0
        assert task_version(name) == task.version >= 1
        assert environment_id(name).startswith("UGR-")


def test_an_unknown_task_names_the_closest_ones():
    with pytest.raises(ConfigError, match="Did you mean click_alarmclock"):
        load_task("click_alarm_clock")
    with pytest.raises(ConfigError, match="UGR_TASKS"):
        load_task("qqqq")


@pytest.mark.parametrize("task", task_names())
def test_the_expert_solves_seeds_without_and_with_noise_within_the_horizon(task):
    import numpy as np

    with SapienSimulator(task, render=False) as simulator:
        for seed, noise in ((0, 0.0), (1, 0.0), (2, 0.04)):
            rng, offset = np.random.default_rng(seed), np.zeros(14)
            frame, count = simulator.reset(seed), 0
            for step in simulator.expert():
                offset = 0.92 * offset + 0.39 * noise * rng.standard_normal(14)
                offset[[6, 13]] = 0.0
                frame, count = simulator.step(step.action + step.slack * offset), count + 1
                assert 0.0 <= step.slack <= 1.0
            assert frame.success, (task, seed, noise)
            assert 50 < count < simulator.horizon


@pytest.mark.parametrize("task", task_names())
def test_doing_nothing_and_the_zero_action_do_not_succeed(task):
    with SapienSimulator(task, render=False) as simulator:
        for seed in (0, 1):
            frame = simulator.reset(seed)
            for _ in range(40):
                frame = simulator.step(frame.commanded * 0.0)
            assert not frame.success
            home = simulator.reset(seed).commanded
            for _ in range(20):
                frame = simulator.step(home)
            assert not frame.success


@pytest.mark.parametrize(
    ("version", "cause", "advice"),
    [
        ((3, 12), "No module named 'sapien'", "pip install sapien mani-skill"),
        ((3, 13), "No module named 'sapien'", "Use Python 3.11 or 3.12"),
        ((3, 12), "libGL.so.1: cannot open shared object file", "apt-get install libgl1"),
    ],
)
def test_a_simulator_that_cannot_be_imported_says_what_to_do(version, cause, advice, monkeypatch):
    class Broken(importlib.abc.MetaPathFinder):
        def find_spec(self, name, *_):
            if name == "mani_skill.utils.registration":
                raise ImportError(cause)

    monkeypatch.delitem(sys.modules, "mani_skill.utils.registration", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    monkeypatch.setattr(sys, "version_info", version)
    with pytest.raises(SimulationError, match=advice) as raised:
        load_task("click_alarmclock")
    assert cause in str(raised.value)
