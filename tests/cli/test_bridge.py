"""`ugr bridge` from the command line."""

import signal
import subprocess
import sys

import pytest
import yaml
from deployed import save, tiny_act

from ugr_lightning.cli.main import main

SETTINGS = {"robotwin": "deploy_policy.yml", "xpolicylab": "deploy.yml"}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A checkpoint with statistics and one without."""
    folder = tmp_path_factory.mktemp("run")
    for name, fitted in (("unfitted.ckpt", False), ("policy_best.ckpt", True)):
        save(tiny_act(fitted), folder / name)
    return folder


@pytest.mark.parametrize("evaluator", ["robotwin", "xpolicylab"])
def test_a_folder_is_written_with_the_settings_asked_for(checkpoints, tmp_path, capsys, evaluator):
    folder, file = tmp_path / "policy" / "Mine", checkpoints / "policy_best.ckpt"
    options = ["--execution", "5", "--cameras.cam_high", "overhead"]
    assert main(["bridge", evaluator, str(file), "--out", str(folder), *options]) == 0
    assert str(folder / "eval.sh") in capsys.readouterr().out
    settings = yaml.safe_load((folder / SETTINGS[evaluator]).read_text())
    assert settings["policy_name"] == "Mine"
    assert settings["execution"] == 5
    assert settings["cameras"]["cam_high"] == "overhead"
    assert settings["cameras"]["cam_left_wrist"] in ("left_camera", "cam_left_wrist")
    assert settings["checkpoint"] == str(file.resolve())


@pytest.mark.parametrize("evaluator", ["robotwin", "xpolicylab"])
def test_of_a_run_it_is_the_best_checkpoint(checkpoints, tmp_path, evaluator):
    folder = tmp_path / "UGR"
    assert main(["bridge", evaluator, "--run", str(checkpoints), "--out", str(folder)]) == 0
    assert str(checkpoints / "policy_best.ckpt") in (folder / SETTINGS[evaluator]).read_text()


@pytest.mark.parametrize("evaluator", ["robotwin", "xpolicylab"])
def test_a_checkpoint_without_statistics_is_refused_and_nothing_written(checkpoints, tmp_path, capsys, evaluator):
    file, folder = checkpoints / "unfitted.ckpt", tmp_path / "UGR"
    assert main(["bridge", evaluator, str(file), "--out", str(folder)]) == 2
    assert "statistics" in capsys.readouterr().err
    assert not folder.exists()


def test_a_wrong_name_is_an_error(capsys):
    for wrong in (["bridge"], ["bridge", "robottwin"], ["bridge", "serve"]):
        assert main(wrong) == 2
        assert "ugr bridge" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_served_checkpoint_answers_until_it_is_interrupted_also_where_sigint_was_ignored(checkpoints, number):
    pytest.importorskip("msgpack", reason="the extra `xpolicylab` is not installed")
    client = pytest.importorskip("websockets.sync.client", reason="the extra `xpolicylab` is not installed")
    command = ["sh", "-c", 'trap "" INT; exec "$@"', "sh"]  # as the `&` of a script has it
    command += [sys.executable, "-m", "ugr_lightning.cli.main", "bridge", "serve", "--port", "0"]
    command += ["--checkpoint", str(checkpoints / "policy_best.ckpt")]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("policy: ACT of")
            url = process.stdout.readline().split()[-1]
            assert url.startswith("ws://127.0.0.1:")
            with client.connect(url) as connection:
                connection.send(b"nonsense")
                assert b"invalid_frame" in connection.recv(timeout=60)
                process.send_signal(number)
                _, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 128 + number
    assert errors.strip() == f"ugr bridge: interrupted by {number.name}"
