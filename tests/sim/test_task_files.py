import json
import os
import re
from functools import partial

import pytest

from ugr_lightning.cli.main import main
from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim import tasks
from ugr_lightning.sim.registry import open_simulator, robot_of, simulator_of
from ugr_lightning.sim.seeds import evaluation_seeds
from ugr_lightning.sim.task_files import outside_names
from ugr_lightning.system.workers import Worker

TASK = '''"""Close the hand."""
from ugr_lightning.sim.scene import TwoArmEnv

class CloseHand(TwoArmEnv):
    horizon = 5
    version = 3

    def build(self, rng):
        pass

    def condition(self):
        return self.opening("left") < 0.5

    def expert(self, arms):
        yield from arms.grip({"left": 0.0}, steps=4, phase="close")
'''
WRAPPER = '''"""Another world."""
from ugr_lightning.sim import outside_simulator

class World(outside_simulator.OutsideSimulator):
    cameras = ("front",)
    horizon, control_hz = 10, 10.0
    version = 2
'''


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A user's folder of tasks, named by the environment beside one that is empty."""
    mine, other = tmp_path / "mine", tmp_path / "other"
    mine.mkdir()
    other.mkdir()
    monkeypatch.setenv("UGR_TASKS", os.pathsep.join([str(other), str(mine)]))
    return mine


def test_a_task_of_a_user_is_one_like_ours(folder, capsys):
    (folder / "close_hand.py").write_text(TASK)
    (folder / "_shared.py").write_text("no task")
    ours = set(tasks.task_names()) - {"close_hand"}
    assert tasks.task_names() == tuple(sorted([*ours, "close_hand"]))
    assert tasks.named_tasks("all") == tasks.task_names()
    assert tasks.task_version("close_hand") == 3
    assert tasks.environment_id("close_hand") == "UGR-CloseHand-v1"
    assert main(["tasks", "list", "close_hand"]) == 0
    assert capsys.readouterr().out == "close_hand          Close the hand.\n"
    with simulator_of("close_hand")("close_hand", render=False) as simulator:
        simulator.reset(7)
        succeeded = [simulator.step(step.action).success for step in simulator.expert()]
        assert (succeeded[0], succeeded[-1]) == (False, True)
        assert simulator.scene_info()["seed"] == 7


def test_its_evaluation_seeds_are_beside_its_file(folder):
    (folder / "close_it.py").write_text(TASK)
    with pytest.raises(SimulationError, match=r"close_it\.json.*ugr tasks seeds close_it"):
        evaluation_seeds("close_it")
    content = {"task": "close_it", "version": 3, "skipped": [], "seeds": [100000, 100001]}
    (folder / "close_it.json").write_text(json.dumps(content))
    assert evaluation_seeds("close_it") == [100000, 100001]


def test_a_wrapper_of_a_user_is_an_outside_task(folder):
    (folder / "other_world.py").write_text(WRAPPER)
    assert "other_world" in outside_names()
    assert "other_world" not in tasks.task_names()
    assert "other_world" in tasks.all_task_names()
    assert tasks.task_version("other_world") == 2
    assert robot_of("other_world").cameras == ("front",)
    with pytest.raises(ConfigError, match="one on our table"):
        tasks.load_task("other_world")


def test_a_folder_that_does_not_exist_is_named(monkeypatch, capsys):
    monkeypatch.setenv("UGR_TASKS", "/no/such/folder")
    assert main(["tasks"]) == 2
    assert "UGR_TASKS: expected existing folders, got /no/such/folder" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("name", "complaint"), [("handover_block", "there is .*handover_block.py already"), ("two-cubes", "no identifier")]
)
def test_a_name_that_is_taken_or_impossible_is_refused(folder, name, complaint):
    (folder / f"{name}.py").write_text(TASK)
    with pytest.raises(ConfigError, match=complaint):
        tasks.task_names()


def test_a_fault_while_a_task_runs_is_told_with_the_line_of_its_file(folder):
    (folder / "fails_later.py").write_text(TASK.replace("        pass", "        self.cube = undefined"))
    opened = Worker(partial(open_simulator, "fails_later", render=False))
    with opened, pytest.raises(SimulationError, match=r"fails_later\.py, line 9\)\. Correct the file\."):
        opened.receive()


@pytest.mark.parametrize(
    ("name", "source", "complaint"),
    [
        ("broken_text", "class CloseHand(", r"broken_text\.py.*was never closed"),
        (
            "broken_import",
            f"import no_such_module\n{TASK}",
            r"broken_import\.py.*ModuleNotFoundError in line 1",
        ),
        ("broken_line", f"{TASK}\n1 / 0", r"broken_line\.py.*ZeroDivisionError in line 17: "),
        ("two_classes", f"{TASK}\nclass Again(CloseHand):\n    pass\n", "one subclass of TwoArmEnv, got 2"),
        ("no_class", '"""Nothing."""', "one subclass of TwoArmEnv, got 0"),
        ("no_expert", TASK.partition("    def expert")[0], r"no_expert\.py.*got no expert"),
        ("no_horizon", TASK.replace("    horizon = 5\n", ""), r"no_horizon\.py.*got no horizon"),
    ],
)
def test_a_file_that_is_no_task_is_an_error_that_names_it(folder, name, source, complaint):
    (folder / f"{name}.py").write_text(source)
    with pytest.raises(SimulationError) as raised:
        tasks.load_task(name)
    (folder / f"{name}.py").unlink()
    assert re.search(complaint, " ".join(str(raised.value).split()))
