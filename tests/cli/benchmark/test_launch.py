import contextlib
import sys

import pytest

from ugr_lightning.cli.benchmark.launch import _Command, launch
from ugr_lightning.errors import ConfigError

# Not within a test: on its import it closes all log handlers, and absl's then closes what pytest captures.
with contextlib.suppress(ImportError):
    import submitit  # noqa: F401


def writing(path, code=0):
    return [sys.executable, "-c", f"open({str(path)!r}, 'w').close(); raise SystemExit({code})"]


def test_without_submitit_it_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(ConfigError, match=r"ugr-lightning\[cluster\]"):
        launch([["true"]], tmp_path, {})


def test_nothing_left_submits_nothing(tmp_path, capsys):
    pytest.importorskip("submitit")
    assert launch([], tmp_path / "logs", {"cluster": "debug"}) == 0
    assert "Nothing" in capsys.readouterr().out


def test_jobs_run_and_one_that_fails_is_counted(tmp_path, capsys):
    pytest.importorskip("submitit")
    commands = [writing(tmp_path / "a"), writing(tmp_path / "b", code=1)]
    assert launch(commands, tmp_path / "logs", {"cluster": "debug"}) == 1
    assert (tmp_path / "a").exists()
    assert (tmp_path / "b").exists()
    assert "1 of 2 jobs failed" in capsys.readouterr().out


def test_jobs_run_in_processes_of_their_own(tmp_path):
    pytest.importorskip("submitit")
    assert launch([writing(tmp_path / "a")], tmp_path / "logs", {"cluster": "local", "timeout_min": 5}) == 0
    assert (tmp_path / "a").exists()


@pytest.mark.parametrize("options", [{"cluster": "slrm"}, {"cluster": "debug", "slurm_partitio": "gpu"}])
def test_an_option_that_submitit_does_not_know_is_explained(tmp_path, options):
    pytest.importorskip("submitit")
    with pytest.raises(ConfigError, match="slurm_partition: gpu"):
        launch([["true"]], tmp_path / "logs", options)


def test_a_job_that_meets_its_time_limit_is_the_same_command_again(tmp_path):
    pytest.importorskip("submitit")
    assert _Command().checkpoint(writing(tmp_path / "a", code=3)).result() == 3
    assert (tmp_path / "a").exists()
