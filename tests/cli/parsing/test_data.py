"""`--data own`, which four commands have."""

import pytest
import yaml

from ugr_lightning.cli.main import main

COMMANDS = {"predict": ["--pictures", "0"], "analyze": ["--resamples", "5"], "refine": [], "sweep": ["--episodes", "2"]}


@pytest.fixture
def run(tmp_path, monkeypatch, ten_demonstrations, untrained, tiny_act, world):
    """Trains in the folder named by a key of the config, as far as the files tell; the working folder has no data."""

    def build(key):
        place = ten_demonstrations / ("click_alarmclock/demo_clean" if key == "folder" else "")
        checkpoint = untrained(tiny_act(), tmp_path, {key: str(place)})
        config = {"data": {"root": "data/160x120", "folder": None, key: str(place)}}
        checkpoint.with_name("config.yaml").write_text(yaml.safe_dump(config))
        return checkpoint

    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    return build


@pytest.mark.parametrize("key", ["root", "folder"])
@pytest.mark.parametrize("name", COMMANDS)
def test_what_a_run_was_trained_on_is_found_and_said(name, key, run, ten_demonstrations, capsys):
    assert main([name, str(run(key)), *COMMANDS[name]]) == 0
    assert f"data: {ten_demonstrations / 'click_alarmclock' / 'demo_clean'}\n" in capsys.readouterr().out


def test_a_folder_that_is_given_wins(run, tmp_path, capsys):
    assert main(["refine", str(run("root")), "--data", "elsewhere"]) == 2
    told = "elsewhere/click_alarmclock/demo_clean: expected the demonstrations of the checkpoint, got nothing there."
    assert f"{told} Say where they are: `--data FOLDER`." in capsys.readouterr().err


@pytest.mark.parametrize("key", ["root", "folder"])
@pytest.mark.parametrize("name", COMMANDS)
def test_where_they_were_moved_it_is_said_what_named_the_folder(name, key, run, ten_demonstrations, capsys):
    checkpoint, own = run(key), ten_demonstrations / "click_alarmclock" / "demo_clean"
    own.rename(own.with_name("moved"))
    assert main([name, str(checkpoint)]) == 2
    config = checkpoint.with_name("config.yaml")
    told = f"{own}: expected the demonstrations of the checkpoint, as {config} says, got nothing there."
    assert f"{told} Say where they are: `--data FOLDER`." in capsys.readouterr().err


def test_where_no_config_names_it_the_usual_folder_is_looked_into_unless_it_was_another(run, capsys):
    for key, said in (("root", "data/160x120/click_alarmclock/demo_clean: expected"), ("folder", "Give it: `--data")):
        checkpoint = run(key)
        checkpoint.with_name("config.yaml").unlink()
        assert main(["predict", str(checkpoint)]) == 2
        assert said in " ".join(capsys.readouterr().err.split())


def test_a_damaged_config_is_named(run, capsys):
    checkpoint = run("root")
    checkpoint.with_name("config.yaml").write_text("data: [")
    assert main(["predict", str(checkpoint)]) == 2
    assert "config.yaml: expected the config of a run" in " ".join(capsys.readouterr().err.split())
