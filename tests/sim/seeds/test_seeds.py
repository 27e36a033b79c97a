import hashlib
import json

import pytest

from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim import seeds
from ugr_lightning.sim.tasks import all_task_names, load_task, seeds_file, task_names


@pytest.mark.parametrize("task", all_task_names())
def test_every_task_ships_a_hundred_seeds_apart_from_demonstrations_and_selection(task):
    found = seeds.evaluation_seeds(task)
    assert len(found) == len(set(found)) == 100
    assert found == sorted(found)
    assert found[0] >= seeds.EVALUATION_START
    assert found[-1] < seeds.SELECTION_START


@pytest.mark.parametrize("task", task_names())
def test_the_seeds_belong_to_the_version_of_the_task_that_is_here(task):
    content = json.loads(seeds_file(task).read_text())
    assert content["version"] == load_task(task).version
    assert content["task"] == task


def test_the_hash_is_that_of_the_comma_joined_list():
    assert seeds.seeds_hash([1, 20]) == hashlib.sha256(b"1,20").hexdigest()
    assert seeds.seeds_hash([20, 1]) != seeds.seeds_hash([1, 20])


def test_unknown_tasks_and_missing_lists_are_clear_errors(monkeypatch, tmp_path):
    with pytest.raises(ConfigError, match="handover_block"):
        seeds.evaluation_seeds("handover")
    monkeypatch.setattr(seeds, "seeds_file", lambda task: tmp_path / "none.json")
    with pytest.raises(SimulationError, match=r"ugr tasks seeds click_alarmclock"):
        seeds.evaluation_seeds("click_alarmclock")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"version": 99}, "got a seed list of click_alarmclock, version 99"),
        ({"task": "handover_block"}, "got a seed list of handover_block"),
        ({"seeds": [100001, 100000]}, "rising order"),
        ({"seeds": [7]}, "from 100000"),
        ({"seeds": None}, "TypeError"),
    ],
)
def test_a_list_of_another_version_or_with_other_seeds_is_refused(change, complaint, monkeypatch, tmp_path):
    content = json.loads(seeds_file("click_alarmclock").read_text())
    (tmp_path / "list.json").write_text(json.dumps(content | change))
    monkeypatch.setattr(seeds, "seeds_file", lambda task: tmp_path / "list.json")
    with pytest.raises(SimulationError, match=complaint) as raised:
        seeds.evaluation_seeds("click_alarmclock")
    assert "`ugr tasks seeds click_alarmclock`" in str(raised.value)
