import json
import threading
from pathlib import Path

import pytest
import torch
import yaml

from ugr_lightning.cli.main import main
from ugr_lightning.speed import measurements as benchmark
from ugr_lightning.speed.measurements import QUICK, Measurement, Pace, take_turns
from ugr_lightning.speed.table import cells_of, print_cells


def test_every_part_is_measured_and_written_to_json(tmp_path, capsys):
    path, parts = tmp_path / "speed.json", ["training", "compact", "query", "data"]
    assert main(["speed", *parts, "--quick", "--threads", "1", "--rounds", "1", "--json", str(path)]) == 0
    content, said = json.loads(path.read_text()), capsys.readouterr().out
    names = [item["name"] for item in content["measurements"]]
    lines = ["training step", "compact training step", "one query", "data path", "data path"]
    assert [name.split(",")[0] for name in names] == lines
    for item in content["measurements"]:
        assert item["value"] > 0
        assert item["name"] in said
        assert (item["arithmetic"] or 1) > 0
        if item["reference"] is not None:
            better = item["reference"] / item["value"]
            assert item["ratio"] == pytest.approx(better if item["unit"] == "ms" else 1 / better)
    assert [item["arithmetic"] is None for item in content["measurements"]] == 3 * [False] + 2 * [True]
    assert [item["reference"] is None for item in content["measurements"]] == [False, True, False, False, False]
    assert content["machine"]["threads"] == 1
    assert content["machine"]["CPU"] in said


def test_the_compact_step_is_that_of_the_config():
    config = yaml.safe_load((Path(__file__).parents[2] / "configs" / "compact.yaml").read_text())
    assert config["model"]["policy"]["init_args"] == benchmark.COMPACT
    assert (config["data"]["batch_size"], config["trainer"]["gradient_clip_val"]) == (2 * benchmark.PAPER.batch, 10)


@pytest.mark.renders
def test_the_simulator_is_timed_with_cameras_and_runs_whole_episodes():
    step, *episodes = benchmark.measure_simulation(QUICK, processes=2)
    assert step.name == "control step, 3 cameras 40x30"
    assert step.value > 0
    assert [item.name.split(":")[0] for item in episodes] == ["expert", "zero"]
    assert "200 steps" in episodes[1].name
    for item in episodes:
        assert item.unit == "episodes/min"
        assert item.ratio == pytest.approx(item.value / item.reference)


def test_workloads_take_turns_after_one_warm_up_each():
    calls = []
    take_turns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, rounds=3)
    assert calls == ["a", "b"] + 3 * ["a", "b"]


def test_the_arithmetic_of_a_workload_takes_as_many_products_as_it_has_operations(monkeypatch):
    factor = torch.randn(256, 256)
    monkeypatch.setattr(benchmark, "take_turns", lambda runs, _: dict.fromkeys(runs, Pace(1.0, 1.0)))
    found = benchmark._measure("eight", lambda: [factor @ factor for _ in range(128)], None, 1, "")
    assert found.arithmetic == pytest.approx(1e3 * 128 * 256**3 / 1024**3)
    assert (found.value, found.reference, found.ratio) == (1e3, None, None)


def test_waiting_costs_wall_time_but_no_processor_time():
    release = threading.Event()
    pace = take_turns({"wait": lambda: release.wait(0.05)}, rounds=1)["wait"]
    assert pace.cpu_seconds < pace.seconds


def test_a_measurement_is_one_line(capsys):
    for item in (Measurement("step", 10.0, "ms", 9.0, 6.0, 33.0, 3.3, "fast"), Measurement("rate", 2500.0, "/s")):
        print_cells(cells_of(item))
    first, second = capsys.readouterr().out.splitlines()
    assert first.split() == ["step", "10.0", "ms", "9.0", "ms", "6.0", "ms", "33.0", "ms", "3.30x", "fast"]
    assert second.split() == ["rate", "2500", "/s"]


@pytest.mark.parametrize("wrong", [["trainng"], ["--threads", "0"], ["--processes", "0"], ["--rounds", "0"]])
def test_an_impossible_request_is_refused_before_anything_is_measured(wrong, capsys):
    assert main(["speed", *wrong]) == 2
    assert capsys.readouterr().out == ""
