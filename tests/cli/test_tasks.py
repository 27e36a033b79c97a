from pathlib import Path

import pytest

from ugr_lightning.cli.main import main
from ugr_lightning.demos.verify import Verification
from ugr_lightning.sim.tasks import all_task_names


@pytest.fixture
def calls(monkeypatch):
    """What is asked for, in place of doing it."""
    asked = []

    def note(name, value):
        def function(*args, **options):
            asked.append((name, args, options))
            return value

        return function

    where = "ugr_lightning.demos.verify"
    monkeypatch.setattr(f"{where}.verify_determinism", note("determinism", Verification("motion", 50, ())))
    monkeypatch.setattr(f"{where}.verify_evaluation_seeds", note("seeds", Verification("list", 101, (100007,))))
    monkeypatch.setattr(f"{where}.find_evaluation_seeds", note("find", Path("list.json")))
    return asked


def test_tasks_are_listed_all_or_one(capsys):
    assert main(["tasks"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(all_task_names())
    assert main(["tasks", "list", "handover_block"]) == 0
    assert capsys.readouterr().out.startswith("handover_block ")


def test_verifying_prints_every_comparison_and_a_difference_is_exit_code_2(calls, capsys):
    assert main(["tasks", "verify", "click_alarmclock", "--workers", "1"]) == 2
    assert [name for name, _, _ in calls] == ["determinism", "determinism", "seeds"]
    assert calls[0][2] == {"setting": "demo_clean", "episodes": 50, "workers": 1}
    out = capsys.readouterr().out
    assert "motion: 50 of 50 agree" in out
    assert "list: 100 of 101 agree, not 100007" in out


def test_evaluation_seeds_are_found_for_the_task_that_is_asked_for(calls, capsys):
    assert main(["tasks", "seeds", "handover_block", "--count", "20", "--workers", "1"]) == 0
    assert calls == [("find", ("handover_block",), {"count": 20, "workers": 1})]
    assert capsys.readouterr().out == "list.json\n"


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["list", "handover"], "Did you mean handover_block"),
        (["verify", "--setting", "clean"], "demo_clean or demo_randomized"),
        (["verify", "--episodes", "0"], "episodes: "),
        (["--verify"], "Did you mean `ugr tasks verify`"),
    ],
)
def test_wrong_values_are_explained_before_anything_runs(options, complaint, calls, capsys):
    assert main(["tasks", *options]) == 2
    assert complaint in capsys.readouterr().err
    assert calls == []
