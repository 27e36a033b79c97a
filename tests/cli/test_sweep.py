"""`ugr sweep` from a checkpoint to its tables, without a simulator."""

import json

import deployed
import numpy as np
import pytest
from deployed import looking_act, save
from PIL import Image

from ugr_lightning.cli.main import main
from ugr_lightning.cli.parsing.data import open_own
from ugr_lightning.data.split import Split
from ugr_lightning.models.refine.head import Head
from ugr_lightning.results.results import read_results
from ugr_lightning.system.lock import locked


@pytest.fixture
def command(world, checkpoint, ten_demonstrations):
    """The command line for an ACT of ten steps that learned nothing, on ten seeds."""
    return f"sweep {checkpoint} --data {ten_demonstrations} --episodes 10 --ratios [0.5,1]".split()


def test_a_sweep_tries_budgets_and_executions_on_the_same_selection_seeds(command, world, capsys, tmp_path):
    world.succeeds = lambda seed, actor, execution: actor.refine_ratio != 1
    assert main(command) == 0
    asked = [(call["actor"], call["execution"]) for call in world]
    assert asked == [
        ("ACT", "aggregate"),
        ("ACT", "aggregate-variance"),
        ("ACT", 10),
        ("ACT(refine_ratio=0)", "aggregate"),
        ("ACT(refine_ratio=0.5)", "aggregate"),
        ("ACT(refine_ratio=1)", "aggregate"),
    ], "the budget of the training has been tried among the executions"
    assert all(call["seeds"] == list(range(200000, 200010)) for call in world)
    said, folder = capsys.readouterr().out, tmp_path / "sweep-policy_best"
    page = (folder / "sweep.md").read_text()
    for text in (
        "| 0%, coarse policy | 0 |",
        "| 30%, as trained | 3 |",
        "10/10 = 100.0% | [72.2%, 100.0%] | 0 | +0.0% [-27.8%, +27.8%] | 0 / 0 |",
        "| 100% | 10 |",
        "| 0 / 10 | 0.00195 | 0.00586 |",
        "| `aggregate-variance`: chunks aggregated with inverse variance |",
        "Success differs from that with 0%, coarse policy (10/10",
        "No execution can be told apart from `aggregate` (10/10",
    ):
        assert text in page or text in said, text
    found = json.loads((folder / "sweep.json").read_text())
    assert found["budgets"]["ratios"] == [0, 0.3, 0.5, 1]
    assert [use["successes"] for use in found["budgets"]["uses"]] == [10, 10, 10, 0]
    assert found["budgets"]["offline"][0]["against_coarse"]["value"] == 0
    assert found["budgets"]["offline"][3]["against_coarse"]["value"] != 0
    assert len(read_results(folder / "episodes.jsonl")) == 60
    assert np.asarray(Image.open(folder / "budgets.png")).std() > 0


def test_a_sweep_that_was_stopped_runs_only_what_is_missing(command, world, tmp_path, capsys):
    assert main([*command, "--data", "null"]) == 0
    whole = capsys.readouterr().out
    file = tmp_path / "sweep-policy_best" / "episodes.jsonl"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:43]) + lines[43][:20])
    world.clear()
    assert main([*command, "--data", "null"]) == 0
    assert [(call["actor"], len(call["seeds"])) for call in world] == [
        ("ACT(refine_ratio=0.5)", 7),
        ("ACT(refine_ratio=1)", 10),
    ]
    assert capsys.readouterr().out == whole
    assert "offline error" not in whole


def test_shards_of_a_sweep_run_side_by_side_and_the_whole_writes_the_tables(command, world, tmp_path, capsys):
    assert main([*command, "--out", str(tmp_path / "whole")]) == 0
    folder = tmp_path / "parts"
    with locked(folder / "sweep.lock", "another shard", shared=True):
        for shard in ("2/2", "1/2", "99/99"):
            assert main([*command, "--out", str(folder), "--shard", shard]) == 0
        assert main([*command, "--out", str(folder), "--shard", "1/1"]) == 2, "not while others run theirs"
    assert not (folder / "sweep.md").exists()
    world.clear()
    assert main([*command, "--out", str(folder), "--shard", "1/1"]) == 0
    assert world == []
    for page in ("sweep.md", "sweep.json"):
        assert (folder / page).read_text() == (tmp_path / "whole" / page).read_text()


def test_a_policy_that_ranks_no_steps_is_swept_over_executions_alone(world, tiny_act, untrained, tmp_path, capsys):
    checkpoint = untrained(tiny_act(None), tmp_path)
    command = ["sweep", str(checkpoint), "--episodes", "2"]
    assert main(command) == 2
    assert "ranking" in capsys.readouterr().err
    assert main([*command, "--ratios", "[]"]) == 0
    assert [call["execution"] for call in world] == ["aggregate", 10]
    assert main([*command, "--ratios", "[]", "--executions", "[aggregate-variance]"]) == 2
    assert "log-variance" in capsys.readouterr().err


def test_a_policy_with_keyframes_is_asked_with_a_calibration(world, tmp_path):
    checkpoint = save(looking_act(), tmp_path / "a.ckpt")
    assert main(["sweep", str(checkpoint), "--episodes", "2", "--ratios", "[]"]) == 0
    assert [call["execution"] for call in world] == ["aggregate", 10]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--ratios [1.5]", "from 0 to 1"),
        ("--executions [11]", "1 to 10"),
        ("--episodes 0", "episodes: expected"),
        ("--data nowhere", "nowhere"),
    ],
)
def test_what_is_impossible_is_said_before_any_episode(command, world, options, says, capsys):
    assert main([*command, *options.split()]) == 2
    assert says in capsys.readouterr().err
    assert world == []


def test_a_teacher_takes_over_steps_that_each_rule_chooses(command, world, tiny_act, untrained, tmp_path, capsys):
    teacher = untrained(tiny_act(), tmp_path / "teacher")
    world.succeeds = lambda seed, actor, execution: "first" in actor.name or "100%" in actor.name
    assert main([*command, "--teacher", str(teacher), "--executions", "[5]"]) == 0
    asked = [(call["actor"].partition(":")[0], call["execution"], len(call["seeds"])) for call in world]
    shares = [f"50%, {rule}" for rule in ("least certain", "scattered", "first")]
    assert asked == [("ACT(refine_ratio=0)", 5, 10), *((f"ACT({share}", 5, 10) for share in [*shares, "100%"])]
    folder = tmp_path / "ceiling-policy_best"
    assert "| 50%, first | 5 | 10/10 = 100.0%" in (folder / "sweep.md").read_text()
    found = json.loads((folder / "sweep.json").read_text())
    assert found["teacher"]["file"] == str(teacher)
    assert {item.refine_ratio for item in read_results(folder / "episodes.jsonl")} == {0, 0.5, 1}
    assert [use["successes"] for use in found["budgets"]["uses"]] == [0, 0, 0, 10, 10]
    assert "with 0%, coarse policy" in capsys.readouterr().out
    world.clear()
    assert main([*command, "--teacher", str(teacher), "--executions", "[5]"]) == 0
    assert world == [], "it goes on where it was stopped"


def test_a_teacher_of_another_kind_is_refused_before_any_episode(command, world, tiny_act, untrained, tmp_path, capsys):
    for teacher, says in (
        (untrained(tiny_act(chunk_length=5), tmp_path / "short"), "teacher.chunk_length: expected that of the student"),
        (save(tiny_act(), tmp_path / "fine.ckpt", image_size=(60, 80)), "--teacher, its image_size"),
        (tmp_path / "nowhere.ckpt", "nowhere.ckpt"),
    ):
        assert main([*command, "--teacher", str(teacher)]) == 2
        assert says in " ".join(capsys.readouterr().err.split())
    for ratios, says in (("[]", "--ratios: expected shares"), ("[0.01]", "at least one of 10 steps")):
        assert main([*command[:-2], "--ratios", ratios, "--teacher", str(teacher)]) == 2
        assert says in " ".join(capsys.readouterr().err.split())
    unsure = save(deployed.tiny_act(refine=Head()), tmp_path / "unsure.ckpt")
    assert main(["sweep", str(unsure), "--teacher", str(unsure)]) == 2
    assert "--teacher: expected a student with a log-variance" in " ".join(capsys.readouterr().err.split())
    assert world == []


def test_two_sweeps_cannot_write_one_folder(command, world, tmp_path, capsys):
    with locked(tmp_path / "sweep-policy_best" / "sweep.lock", "test"):
        assert main([*command, "--data", "null"]) == 2
    assert "a folder that nobody else writes" in capsys.readouterr().err
    assert world == []


def test_one_validation_episode_is_too_few_for_the_offline_error(command, world, monkeypatch, capsys):
    def opened(*given):
        data = open_own(*given)
        data.episode_split = Split((0, 1), (2,))
        return data

    monkeypatch.setattr("ugr_lightning.cli.sweep.open_own", opened)
    assert main(command) == 2
    assert "`--data null`" in capsys.readouterr().err
    assert world == []
