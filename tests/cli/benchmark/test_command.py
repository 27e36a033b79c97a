import fcntl
import json
import multiprocessing
import os
import re
import signal
import sys
from pathlib import Path

import pytest
import torch
import yaml

from ugr_lightning.cli.benchmark import command as benchmark
from ugr_lightning.cli.main import main
from ugr_lightning.results.evaluations import RunInfo
from ugr_lightning.results.results import read_results

HERE = Path(__file__).parent
WORLD = (sys.executable, str(HERE / "benchmark_world.py"))
NAME = "base-click_alarmclock-seed0"


def write_grid(policies=("base",), seeds=(0,), episodes=3, **more):
    """A grid beside the tiny config."""
    Path("task.yaml").write_text("data: {task: click_alarmclock}\n")
    content = {
        "policies": dict.fromkeys(policies, "tiny.yaml"),
        "tasks": {"click_alarmclock": "task.yaml"},
        "training_seeds": list(seeds),
        "executions": [2],
        "episodes": episodes,
        **more,
    }
    Path("grid.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def go(*options):
    return main(["benchmark", "grid.yaml", "--out", "out", *options])


@pytest.fixture
def environment(tiny_config, monkeypatch):
    """What the jobs' processes see."""
    path = os.pathsep.join([str(HERE.parents[1] / "stand_ins"), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("CALLS", str(Path("calls.jsonl").resolve()))


@pytest.fixture
def calls(environment, monkeypatch):
    """Jobs that pretend to train and to evaluate; returns what they were asked for, and forgets it."""
    monkeypatch.setattr(benchmark, "PROGRAM", (sys.executable, str(HERE / "pretend_ugr.py")))
    monkeypatch.setattr(benchmark, "resolved_config", lambda job: yaml.safe_load(job.configs[0].read_text()))

    def read():
        path = Path("calls.jsonl")
        lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        path.unlink(missing_ok=True)
        return lines

    return read


def test_a_grid_is_killed_twice_and_goes_on_as_if_it_never_had_been(environment, monkeypatch, capsys, tiny_config):
    """The real thing: trained, evaluated and killed in processes of its own; only the simulator has no physics."""
    monkeypatch.setattr(benchmark, "PROGRAM", WORLD)
    write_grid(workers=1)
    monkeypatch.setenv("KILL", "fit:5")  # an epoch, and with it a checkpoint, is three steps
    assert go() == 1
    assert "SIGKILL" in capsys.readouterr().out
    assert torch.load(f"out/runs/{NAME}/version_0/last.ckpt", weights_only=True)["global_step"] == 3
    monkeypatch.setenv("KILL", "test:2")
    assert go() == 1
    results = Path(f"out/results/{NAME}/results.jsonl")
    assert len(results.read_text().splitlines()) == 2
    monkeypatch.delenv("KILL")
    assert go() == 0
    assert [item.seed for item in read_results(results)] == [100_000, 100_001, 100_002]
    assert not Path(f"out/runs/{NAME}/version_1").exists()
    assert main(["fit", "--config", tiny_config, "--run", "straight"]) == 0
    straight, resumed = (
        torch.load(folder / "last.ckpt", weights_only=True)["state_dict"]
        for folder in (Path("runs/straight/version_0"), Path(f"out/runs/{NAME}/version_0"))
    )
    assert all(torch.equal(straight[name], resumed[name]) for name in straight)
    info = RunInfo.read(results.parent)
    assert {item.checkpoint for item in read_results(results)} == {info.checkpoint_sha256}
    assert main(["report", "out"]) == 0
    assert "/3" in capsys.readouterr().out


def test_a_benchmark_that_was_killed_leaves_a_lock_only_as_long_as_its_job_lives(calls, monkeypatch, capsys):
    write_grid()
    os.mkfifo("fifo")
    monkeypatch.setenv("SIGKILL", "fifo")
    killed = multiprocessing.get_context("fork").Process(target=go)
    killed.start()
    killed.join()
    assert killed.exitcode == -signal.SIGKILL
    monkeypatch.delenv("SIGKILL")
    orphan = json.loads(Path("out/benchmark.lock").read_text())["child"]
    capsys.readouterr()
    assert go() == 2
    assert f"kill {orphan}" in capsys.readouterr().err
    assert go("--job", "0") == 2
    os.kill(orphan, signal.SIGKILL)
    with open("out/benchmark.lock") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # until it is gone
    assert go() == 0, "a lock whose holder died is taken over"


def test_ending_a_benchmark_ends_its_job(calls, monkeypatch, capsys):
    write_grid()
    os.mkfifo("fifo")
    monkeypatch.setenv("SIGTERM", "fifo")
    assert go() == 128 + signal.SIGTERM
    child = json.loads(Path("out/benchmark.lock").read_text())["child"]
    assert not Path(f"/proc/{child}").exists()
    monkeypatch.delenv("SIGTERM")
    assert go() == 0


def test_what_is_done_is_skipped_and_more_episodes_are_added(calls, capsys):
    write_grid(policies=("base", "uncert"), seeds=(0, 1))
    assert go() == 0
    asked = calls()
    assert [words[0] for words in asked] == ["fit", "test"] * 4
    assert go() == 0
    assert calls() == []
    assert capsys.readouterr().out.count("done before") == 4
    write_grid(policies=("base", "uncert", "full"), seeds=(0, 1), episodes=5)
    assert go() == 0
    assert [words[0] for words in calls()].count("fit") == 2, "only the new policy is trained"
    for policy in ("base", "full"):
        assert len(read_results(f"out/results/{policy}-click_alarmclock-seed1/results.jsonl")) == 5


def test_a_training_goes_on_from_its_last_checkpoint(calls):
    write_grid()
    folder = Path(f"out/runs/{NAME}/version_0")
    folder.mkdir(parents=True)
    (folder / "last.ckpt").write_text("")
    assert go() == 0
    fit, _ = calls()
    assert fit[-2:] == ["--checkpoint", "last"]


def test_a_job_that_fails_costs_only_itself_and_is_reported(calls, monkeypatch, capsys):
    write_grid(policies=("base", "uncert"))
    monkeypatch.setenv("FAIL", "--run base")
    assert go() == 1
    captured = capsys.readouterr()
    assert "it went wrong in this way" in captured.out
    assert "ended with 3" in captured.err
    assert NAME in captured.err
    assert "1 of 2 jobs are done. Compare them:" in captured.out
    monkeypatch.delenv("FAIL")
    calls()
    assert go() == 0
    assert [words[0] for words in calls()] == ["fit", "test"]


def test_a_dry_run_says_what_is_done_and_touches_nothing(calls, monkeypatch, capsys):
    write_grid(policies=("base", "uncert"))
    assert go("--dry_run") == 0
    assert capsys.readouterr().out.count("to do") == 2
    assert not Path("out").exists()
    monkeypatch.setenv("FAIL", "test")
    go("--job", "1")
    capsys.readouterr()
    assert go("--dry_run") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["0", NAME]
    assert lines[1].endswith("trained, 0 of 3 episodes")


def test_results_say_what_they_are_of(calls):
    write_grid(policies={"base": 0}, executions={"as published": 2})
    assert go() == 0
    folder = Path(f"out/results/{NAME}")
    info = RunInfo.read(folder)
    assert (info.policy, info.task, info.training_seed) == ("base", "click_alarmclock", 0)
    assert info.checkpoint == f"runs/{NAME}/version_0/policy_best.ckpt"
    assert info.modes == {"2": "as published"}
    assert info.job == 0
    assert set(info.seconds) == {"fit", "test"}
    assert yaml.safe_load((folder / "config.yaml").read_text())["trainer"]["max_steps"] == 6
    assert Path("out/results/grid.yaml").read_text() == Path("grid.yaml").read_text()


def test_a_job_does_not_go_on_with_another_config(calls, tiny_config, capsys):
    write_grid()
    assert go() == 0
    path = Path(tiny_config)
    path.write_text(path.read_text().replace("max_steps: 6", "max_steps: 7"))
    assert go() == 1
    assert "trainer.max_steps: 6 before, 7 now" in capsys.readouterr().out
    assert len(calls()) == 2, "of the first benchmark"


def test_a_broken_line_of_results_is_named_and_a_cut_off_one_is_run_again(calls, capsys):
    write_grid()
    assert go() == 0
    path = Path(f"out/results/{NAME}/results.jsonl")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:2]) + lines[2][:20])
    assert go() == 0
    assert path.read_text() == "".join(lines)
    path.write_text(lines[0] + "{broken\n" + lines[2])
    assert go() == 1
    assert "results.jsonl, line 2" in capsys.readouterr().out


def test_two_benchmarks_cannot_write_one_folder_and_single_jobs_can(calls, capsys):
    write_grid(policies=("base", "uncert"))
    with benchmark.locked(Path("out/benchmark.lock"), "out"):
        assert go() == 2
        assert f"process {os.getpid()}" in capsys.readouterr().err
        assert go("--job", "0") == 2
    with benchmark.locked(Path("out/benchmark.lock"), "out", shared=True):
        assert go("--job", "0") == 0
        assert go() == 2
    with benchmark.locked(Path(f"out/results/{NAME}/job.lock"), NAME):
        assert go("--job", "0") == 1, "somebody else is at this job"
    assert go() == 0


def test_the_time_left_is_told_once_a_job_has_shown_it(calls, capsys):
    write_grid(policies=("base", "uncert"))
    assert go() == 0
    out = capsys.readouterr().out.splitlines()
    assert "left for all" not in out[0]
    assert next(line for line in out if "[2/2]" in line).endswith("log out/logs/uncert-click_alarmclock-seed0.log")
    assert re.search(r"about \d+:\d\d left for all", next(line for line in out if "[2/2]" in line))


@pytest.mark.parametrize("arguments", [["--job", "9"], ["--launcher", "slurm"], ["--dry"]])
def test_options_that_do_not_fit_are_explained(calls, arguments, capsys):
    write_grid()
    assert go(*arguments) == 2
    assert arguments[0].lstrip("-") in capsys.readouterr().err
