import sys

import pytest

from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim import tasks
from ugr_lightning.sim.outside_simulator import OutsideSimulator
from ugr_lightning.sim.registry import robot_of, simulator_of
from ugr_lightning.sim.sapien_simulator import SapienSimulator
from ugr_lightning.sim.task_files import outside_names

CUBE = "aloha_transfer_cube"


@pytest.mark.parametrize("task", outside_names())
def test_an_outside_task_says_what_the_runner_asks_of_a_task(task):
    simulator = simulator_of(task)
    assert issubclass(simulator, OutsideSimulator)
    assert tasks.task_version(task) == simulator.version >= 1
    assert simulator.horizon > 0
    assert simulator.control_hz > 0
    assert robot_of(task).cameras == simulator.cameras != ()
    assert tasks.task_summaries()[task].endswith(".")
    tasks.check_task(task)


def test_all_means_our_own_tasks_and_every_other_name_is_ours():
    assert not set(outside_names()) & set(tasks.task_names())
    assert tasks.named_tasks("all") == tasks.task_names()
    assert tasks.all_task_names() == (*tasks.task_names(), *outside_names())
    assert simulator_of("click_alarmclock") is SapienSimulator
    assert robot_of("click_alarmclock").cameras == CAMERAS


def test_an_outside_task_is_none_of_our_environments():
    with pytest.raises(ConfigError, match="one on our table"):
        tasks.load_task(CUBE)


@pytest.mark.parametrize("module", ["gym_aloha", "gymnasium"])
def test_a_missing_package_is_an_error_that_says_what_to_install(module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SimulationError, match=r"Install `ugr-lightning\[aloha\]`"):
        simulator_of(CUBE)(CUBE)


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [({"setting": "demo_randomized"}, "setting"), ({"image_size": (0, 4)}, "image_size"), ({"speed": 0.0}, "speed")],
)
def test_wrong_arguments_are_refused_before_anything_is_opened(wrong, complaint):
    with pytest.raises(ConfigError, match=complaint):
        simulator_of(CUBE)(CUBE, **wrong)
