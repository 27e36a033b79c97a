import json

import pytest
from made_up import episode

from ugr_lightning.cli.main import main
from ugr_lightning.results.results import append_result


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for policy, successes in (("base", 10), ("uncert", 18)):
        for seed in range(20):
            append_result(f"{policy}.jsonl", episode(seed, seed < successes, checkpoint=policy, execution="25"))
    return ["--runs", "base=base.jsonl", "uncert=uncert.jsonl"]


def test_a_report_is_printed_or_written(files, tmp_path, capsys):
    assert main(["report", *files]) == 0
    said = capsys.readouterr().out
    assert "`uncert` succeeds more often than `base`" in said
    assert "18/20 = 90.0%" in said
    assert main(["report", *files, "--out", "new", "--title", "Ours"]) == 0
    assert {path.name for path in (tmp_path / "new").iterdir()} == {
        "report.md",
        "rates.csv",
        "comparisons.csv",
        "summary.jsonl",
    }
    assert "Ours" in (tmp_path / "new" / "report.md").read_text()


def test_a_report_can_be_made_again_of_the_summary_beside_it(files, tmp_path):
    assert main(["report", *files, "--out", "first"]) == 0
    assert main(["report", "first", "--out", "second"]) == 0
    for path in (tmp_path / "first").iterdir():
        assert path.read_text() == (tmp_path / "second" / path.name).read_text(), path.name


def test_results_count_and_not_an_earlier_report_of_them(tmp_path, capsys):
    run = tmp_path / "bench" / "results" / "base-reach-seed0"
    run.mkdir(parents=True)
    about = {"policy": "base", "task": "reach", "training_seed": 0, "config_sha256": "c", "checkpoint_sha256": "base"}
    (run / "run.json").write_text(json.dumps(about))
    assert main(["report", str(tmp_path / "bench")]) == 2
    assert "expected episodes, got none" in " ".join(capsys.readouterr().err.split())
    for seed in range(20):
        append_result(run / "results.jsonl", episode(seed, seed < 7, checkpoint="base"))
        if seed == 9:
            assert main(["report", str(tmp_path / "bench"), "--out", str(tmp_path / "bench")]) == 0
    capsys.readouterr()
    assert main(["report", str(tmp_path / "bench")]) == 0
    assert "7/20" in capsys.readouterr().out


def test_results_at_home_are_found_and_a_damaged_config_beside_them_is_named(files, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    for content in ("seed_everything: [1", "- 1\n", "x"):
        (tmp_path / "config.yaml").write_text(content)
        assert main(["report", "--runs", "a=~/base.jsonl"]) == 2
        assert f"{tmp_path / 'config.yaml'}: expected the config of a run" in capsys.readouterr().err
    (tmp_path / "config.yaml").write_text("")
    assert main(["report", "--runs", "a=~/base.jsonl"]) == 0


def test_the_power_calculator_knows_paired_and_unpaired(capsys):
    assert main(["report", "--power", "0.90", "0.95"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split()[-1] == "435"
    assert len(lines) == 6
    assert main(["report", "--power", "0.90", "0.95", "--discordance", "0.05"]) == 0
    few = capsys.readouterr().out.splitlines()
    assert few[3].split()[-1] == lines[5].split()[-1]


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "results"),
        (["--runs", "base.jsonl"], "NAME=FILE"),
        (["nowhere"], "nowhere"),
        (["--power", "0.9"], "two success rates"),
        (["--power", "0.9", "high"], "power"),
        (["--bseline", "x"], "`baseline`"),
    ],
)
def test_what_is_wrong_is_explained(argv, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["report", *argv]) == 2
    assert said in capsys.readouterr().err
