import errno
import os
import subprocess
import sys

import pytest

from ugr_lightning.cli import main as entry
from ugr_lightning.cli.main import COMMANDS, main
from ugr_lightning.errors import DataError


def test_ugr_alone_prints_the_first_run_path(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert "ugr fit --config uncert" in out
    assert all(command in out for command in COMMANDS)


def test_an_unknown_command_names_the_closest_one(capsys):
    assert main(["rolout"]) == 2
    assert "Did you mean `ugr rollout`?" in capsys.readouterr().err


def test_a_problem_of_the_user_is_one_paragraph_and_a_traceback_only_on_request(monkeypatch, capsys):
    def fail(command, arguments):
        raise DataError("episode0.hdf5", "the key `state`", "no such key", "Record it again.")

    monkeypatch.setattr(entry, "_run", fail)
    assert main(["fit"]) == 2
    said = capsys.readouterr().err
    assert "episode0.hdf5: expected the key `state`, got no such key. Record it again." in said
    assert "Traceback" not in said
    monkeypatch.setenv("UGR_DEBUG", "1")
    with pytest.raises(DataError):
        main(["fit"])


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.ENOTDIR, errno.EEXIST, errno.EISDIR])
def test_a_disk_that_is_full_or_cannot_be_written_is_a_sentence_whatever_was_being_done(monkeypatch, capsys, number):
    def fail(command, arguments):
        raise OSError(number, os.strerror(number), "runs/a/run.lock")

    monkeypatch.setattr(entry, "_run", fail)
    assert main(["fit"]) == 2
    said = capsys.readouterr().err
    assert f"runs/a/run.lock: expected a file that can be read and written, got {os.strerror(number)}. " in said
    number = errno.ENOENT  # nothing that a user's disk is to blame for
    with pytest.raises(FileNotFoundError):
        main(["fit"])


def test_a_link_that_leads_to_itself_is_a_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert main(["data", "inspect", "loop"]) == 2
    assert "Choose another path: a link in it leads to itself." in capsys.readouterr().err


def test_training_works_where_no_simulator_is_installed():
    program = """
import sys
sys.modules.update({name: None for name in ("sapien", "mani_skill", "gymnasium")})
import ugr_lightning.cli.fit, ugr_lightning.cli.rollout, ugr_lightning.training.callbacks.rollout_evaluation
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


SLOW = {"torch", "lightning", "scipy", "matplotlib", "h5py", "PIL", "diffusers", "tensorboard"}
SLOW |= {"sapien", "mani_skill", "gymnasium", "imageio", "rerun", "pyarrow", "onnx", "transformers"}
TRAINING = {"torch", "lightning", "scipy", "matplotlib", "PIL", "h5py"}  # Lightning itself brings the first five
MAY_LOAD = {"doctor": {"torch"}, "import-act": {"torch"}, "import-lerobot": {"torch"}, "refine": {"torch"}}
MAY_LOAD |= {"fit": TRAINING, "validate": TRAINING}
PARTS = ("tasks list", "tasks verify", "data inspect", "data convert", "bridge robotwin", "bridge serve")
LINES = ["tasks", *(f"{line} --help" for line in (*COMMANDS, *PARTS))]


def test_a_command_that_only_explains_itself_or_lists_leaves_slow_packages_out_of_memory():
    """What a command may load is data; those that may load more come later in the one process, so that none hides."""
    lines = sorted(LINES, key=lambda line: len(MAY_LOAD.get(line.split()[0], ())))
    program = f"""
import contextlib, io, sys
from ugr_lightning.cli.main import main
for line in {lines!r}:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(line.split())
    print(line, *({SLOW!r} & set(sys.modules)), sep=",")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=300)
    loaded = {line: set(names) for line, *names in (row.split(",") for row in done.stdout.splitlines())}
    too_much = {line: names - MAY_LOAD.get(line.split()[0], set()) for line, names in loaded.items()}
    assert {line: names for line, names in too_much.items() if names} == {}
    assert len(loaded) == len(LINES)


def test_garbage_is_collected_again_once_a_command_is_imported():
    program = "import gc; from ugr_lightning.cli.main import main; main(['tasks']); "
    program += "assert gc.isenabled() and gc.get_freeze_count() > 10_000"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120, stdout=subprocess.DEVNULL)
