import subprocess

import pytest

from ugr_lightning.cli import shards
from ugr_lightning.cli.benchmark.command import PROGRAM
from ugr_lightning.cli.main import main


@pytest.fixture
def launched(monkeypatch):
    """What was given to the cluster and what ran here; the word `bad` fails on the cluster."""
    calls = []

    def launch(commands, folder, options):
        calls.append((commands, options))
        return int("bad" in commands[0])

    monkeypatch.setattr(shards, "launch", launch)
    monkeypatch.setattr(subprocess, "call", lambda words: calls.append(words) or 0)
    return calls


def test_a_command_runs_as_shards_and_what_puts_them_together_runs_here(launched):
    assert main(["shards", "2", "test --run 'my run'", "--launcher_options", "{cluster: slurm}"]) == 0
    words = [*PROGRAM, "test", "--run", "my run", "--shard"]
    assert launched == [([[*words, "1/2"], [*words, "2/2"]], {"cluster": "slurm"}), [*words, "1/1"]]


def test_nothing_is_put_together_where_a_shard_has_failed(launched):
    assert main(["shards", "2", "collect bad"]) == 1
    assert len(launched) == 1


@pytest.mark.parametrize("command", ["fit --run a", "", "test 'a"])
def test_a_command_without_shards_is_refused(launched, command, capsys):
    assert main(["shards", "2", command]) == 2
    assert "collect, rollout, test, sweep with its options" in capsys.readouterr().err
    assert launched == []
