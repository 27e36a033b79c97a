import json

import pytest
from made_up import episode

from ugr_lightning.cli.main import main
from ugr_lightning.models.checkpoint import sha256
from ugr_lightning.results.results import append_result


@pytest.fixture
def rolled_out(tiny_act, untrained, tmp_path):
    """A checkpoint, and a results file with 24 successes and 6 failures of it in each of two executions."""
    checkpoint = untrained(tiny_act(chunk_length=50), tmp_path)
    out = tmp_path / "selection.jsonl"
    for execution in ("25", "aggregate"):
        for seed in range(30):
            about = {"steps": 50 + seed, "disagreement": seed / 10, "execution": execution}
            append_result(out, episode(seed, seed < 24, checkpoint=sha256(checkpoint), **about))
    append_result(out, episode(0, checkpoint="another", disagreement=50.0))
    return checkpoint, out


def test_an_alarm_is_set_on_the_successes_of_each_execution_and_leaves_the_checkpoint_as_it_was(rolled_out, capsys):
    checkpoint, results = rolled_out
    before = checkpoint.read_bytes()
    assert main(["alarm", str(checkpoint), str(results), "--rate", "0.2"]) == 0
    said = capsys.readouterr().out
    assert "execution 25: where chunks disagree by more than 2.2, or from step 72 on" in said
    assert "Chunks disagree as much in 6 of the 6 failures" in said
    assert checkpoint.read_bytes() == before
    kept = json.loads((checkpoint.parent / "policy_best.alarm.json").read_text())
    assert [(one["execution"], one["rate"], one["successes"]) for one in kept] == [
        ("25", 0.2, 24),
        ("aggregate", 0.2, 24),
    ]
    assert main(["inspect", str(checkpoint)]) == 0
    assert "alarm         execution aggregate: where chunks disagree by more than 2.2" in capsys.readouterr().out


def test_setting_it_for_one_execution_keeps_that_of_another_and_replaces_that_of_another_checkpoint(
    rolled_out, tmp_path, capsys
):
    checkpoint, results = rolled_out
    assert main(["alarm", str(checkpoint), str(results), "--rate", "0.2"]) == 0
    one = tmp_path / "one.jsonl"
    for seed in range(24):
        append_result(one, episode(seed, checkpoint=sha256(checkpoint), execution="25", disagreement=9.0))
    assert main(["alarm", str(checkpoint), str(one)]) == 0
    place = checkpoint.parent / "policy_best.alarm.json"
    kept = {entry["execution"]: entry for entry in json.loads(place.read_text())}
    assert {name: entry["threshold"] for name, entry in kept.items()} == {"25": 9.0, "aggregate": 2.2}
    place.write_text(place.read_text().replace(sha256(checkpoint), "stale"))
    assert main(["rollout", str(checkpoint), "--episodes", "1"]) == 2
    assert f"(`rm {place}`): then it can be rolled out" in " ".join(capsys.readouterr().err.split())
    assert main(["inspect", str(checkpoint)]) == 0
    assert "got stale" in " ".join(capsys.readouterr().out.split())
    assert main(["alarm", str(checkpoint), str(one)]) == 0
    assert [entry["execution"] for entry in json.loads(place.read_text())] == ["25"]


def test_too_few_successes_and_results_of_another_checkpoint_are_explained_and_set_nothing(
    rolled_out, tmp_path, capsys
):
    checkpoint, results = rolled_out
    assert main(["alarm", str(checkpoint), str(results), "--rate", "0.05"]) == 2
    assert "at least 39 successes" in " ".join(capsys.readouterr().err.split())
    append_result(tmp_path / "other.jsonl", episode(0, checkpoint="another", disagreement=50.0))
    assert main(["alarm", str(checkpoint), str(tmp_path / "other.jsonl")]) == 2
    assert "--seeds selection --out FILE" in " ".join(capsys.readouterr().err.split())
    assert not (checkpoint.parent / "policy_best.alarm.json").exists()


def test_a_test_tells_what_came_of_the_alarm(world, rolled_out, tmp_path, capsys):
    checkpoint, results = rolled_out
    assert main(["alarm", str(checkpoint), str(results), "--rate", "0.2"]) == 0
    out = tmp_path / "evaluation.jsonl"
    assert main(["test", str(checkpoint), "--episodes", "4", "--executions", "[25]"]) == 0
    assert "Alarm" not in capsys.readouterr().out, "these rollouts had none"
    lines = [json.loads(line) | {"alarm_rate": 0.2, "alarm": None} for line in out.read_text().splitlines()]
    lines[1] |= {"success": False, "alarm": 4}
    out.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert main(["test", str(checkpoint), "--episodes", "4", "--executions", "[25]", "--resume"]) == 0
    assert "Alarm, execution 25: in 0 of" in capsys.readouterr().out
