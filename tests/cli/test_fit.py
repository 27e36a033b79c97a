import csv
import importlib.util
import multiprocessing
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import deployed
import pytest
import torch
import yaml
from folders import files_of
from recordings import record
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ugr_lightning.cli.main import main
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.system.lock import locked
from ugr_lightning.training.module import PolicyModule

RUN = Path("runs/tiny/version_0")


def fit(config, *options):
    assert main(["fit", "--config", config, *options]) == 0


def weights(folder, file="last.ckpt"):
    """The averaged weights of a checkpoint and, where it has them, those that are trained."""
    content = torch.load(folder / file, weights_only=True)
    return content["state_dict"] | {f"trained {k}": v for k, v in content.get("training_state_dict", {}).items()}


def scores(folder):
    """The log without what depends on the clock."""
    rows = csv.DictReader((folder / "metrics.csv").open())
    return [{key: value for key, value in row.items() if not key.startswith("speed/")} for row in rows]


def test_fit_leaves_config_logs_and_checkpoints_and_a_second_one_disturbs_nothing(tiny_config, capsys):
    fit(tiny_config)
    assert capsys.readouterr().out.endswith(f"trained to step 6: {RUN}\n")
    before = (RUN / "last.ckpt").read_bytes()
    fit(tiny_config, "--seed_everything", "1")
    assert (RUN / "last.ckpt").read_bytes() == before
    assert (RUN.parent / "version_1" / "last.ckpt").is_file()
    assert {"policy_best.ckpt", "policy_best_loss.ckpt", "metrics.csv"} <= {path.name for path in RUN.iterdir()}
    assert yaml.safe_load((RUN / "config.yaml").read_text())["average"]["decay"] == 0.9
    tags = EventAccumulator(str(RUN)).Reload().Tags()
    assert {"train/loss", "val/loss", "val/action_error", "train/learning_rate"} <= set(tags["scalars"])
    assert "figures/chunk" in tags["images"]
    assert "hp/val/action_error" in tags["scalars"]
    assert not weights(RUN)["policy.head.weight"].equal(weights(RUN.parent / "version_1")["policy.head.weight"])


@pytest.mark.parametrize("hook", ["prepare_data", "training_step"])
def test_a_training_that_fails_before_its_first_step_is_done_leaves_no_folder(tiny_config, monkeypatch, hook):
    owner = ChunkDataModule if hook == "prepare_data" else PolicyModule

    def fail(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(owner, hook, fail)
    with pytest.raises(ZeroDivisionError):
        main(["fit", "--config", tiny_config])
    assert not list(Path("runs").iterdir())


def test_a_training_looks_how_its_demonstrations_were_recorded(tiny_config, tmp_path, capsys):
    root = tmp_path / "noisy"
    record(root, steps=12, longer=0, size=(8, 12))
    (folder,) = {path.parents[1] for path in root.rglob("*.hdf5")}
    (folder / "recording.json").write_text('{"noise": {"std": 0.3}}')
    assert main(["fit", "--config", tiny_config, "--data.root", str(root), "--data.recording.noise_std", "0.1"]) == 2
    assert "expected a recording with `data.recording` noise_std 0.1, got noise_std 0.3" in capsys.readouterr().err


def test_two_fits_with_the_same_seed_agree_bit_for_bit_and_loader_workers_change_nothing(tiny_config):
    fit(tiny_config)
    fit(tiny_config, "--data.num_workers", "2", "--run", "parallel")
    a, b = weights(RUN), weights(Path("runs/parallel/version_0"))
    assert all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize(
    ("config", "options", "limit"),
    [
        ("tiny_config", "", "max_steps"),
        ("tiny_config", "--trainer.max_steps -1", "max_epochs"),
        ("muon_config", "", "max_steps"),
        ("muon_config", "--trainer.precision bf16-mixed --trainer.gradient_clip_val 1", "max_steps"),
    ],
)
def test_a_fit_that_goes_on_from_last_equals_the_uninterrupted_one(config, options, limit, request, capsys):
    part, whole = ("1", "2") if limit == "max_epochs" else ("3", "6")
    config = request.getfixturevalue(config)
    options = [*options.split(), "--model.schedule", "constant", f"--trainer.{limit}"]
    fit(config, *options, whole, "--run", "straight")
    fit(config, *options, part)
    fit(config, *options, whole, "--checkpoint", "last")
    assert f"checkpoint: {RUN / 'last.ckpt'}" in capsys.readouterr().out
    straight = Path("runs/straight/version_0")
    for file in ("last.ckpt", "policy_best.ckpt"):
        a, b = weights(RUN, file), weights(straight, file)
        assert all(torch.equal(a[name], b[name]) for name in a), file
    assert scores(RUN) == scores(straight)
    assert not (RUN.parent / "version_1").exists(), "it went on in its own folder"


def test_two_trainings_of_one_run_at_once_get_a_folder_each(tiny_config, monkeypatch):
    from tiny import TinyPolicy

    losses, inner = TinyPolicy.losses, []

    def another_starts(self, batch):
        if not inner:
            inner.append(1)
            fit(tiny_config, "--seed_everything", "1")
        return losses(self, batch)

    monkeypatch.setattr(TinyPolicy, "losses", another_starts)
    fit(tiny_config)
    for version in ("version_0", "version_1"):
        assert len(scores(RUN.with_name(version))) == len(scores(RUN))
        assert yaml.safe_load((RUN.with_name(version) / "config.yaml").read_text())["seed_everything"] == int(
            version[-1]
        )


def test_a_run_that_is_being_trained_cannot_be_gone_on_with(tiny_config, capsys):
    fit(tiny_config, "--trainer.max_steps", "3")
    with locked(RUN / "run.lock", "the run"):
        before = files_of(RUN)
        assert main(["fit", "--config", tiny_config, "--checkpoint", "last"]) == 2
        assert f"process {os.getpid()}" in capsys.readouterr().err
        assert files_of(RUN) == before
    fit(tiny_config, "--checkpoint", "last")


def test_a_training_that_cannot_start_leaves_no_run(tiny_config):
    assert main(["fit", "--config", tiny_config, "--data.folder", "nowhere"]) == 2
    assert not list(Path("runs").rglob("version_*"))


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_demonstrations_that_were_moved_are_asked_for_by_name(tiny_config, tmp_path, capsys, command):
    given = yaml.safe_load(Path(tiny_config).read_text())
    given["data"]["folder"] = str(tmp_path / "moved")
    Path("saved.yaml").write_text(yaml.safe_dump(given))
    fit(tiny_config, "--trainer.max_steps", "1")
    told = f"{tmp_path / 'moved'}: expected demonstrations, as `data.folder` in saved.yaml says, got nothing there."
    options = ["--checkpoint", str(RUN / "last.ckpt")] if command == "validate" else []
    assert main([command, "--config", "saved.yaml", *options]) == 2
    assert f"{told} Say where they are: `--data.folder FOLDER`." in capsys.readouterr().err
    assert main([command, "--config", "saved.yaml", *options, "--data.folder=nowhere"]) == 2
    assert "nowhere: expected demonstrations, got nothing there. Say where they" in capsys.readouterr().err


@pytest.mark.parametrize("resumed", [False, True])
def test_a_config_that_was_saved_starts_a_run_of_its_own_from_any_folder(tiny_config, tmp_path, monkeypatch, resumed):
    root = yaml.safe_load(Path(tiny_config).read_text())["data"]["root"]
    monkeypatch.chdir(Path(root).parent)
    here = ["--data.root", Path(root).name, "--trainer.default_root_dir", "saved"]
    fit(tiny_config, *here)
    run = Path.cwd() / "saved" / "tiny" / "version_0"
    if resumed:
        fit(tiny_config, *here, "--checkpoint", "last", "--trainer.max_steps", "9")
    before = files_of(run)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    fit(str(run / "config.yaml"), "--run", "other", "--seed_everything", "1")
    fit(str(run / "config.yaml"))
    assert files_of(run) == before
    assert {path.parent.parent.name for path in run.parents[1].rglob("last.ckpt")} == {"tiny", "other"}
    assert (run.parent / "version_1" / "last.ckpt").is_file()
    assert not list(Path.cwd().iterdir())


@pytest.mark.parametrize("run", ["runs/a", "./runs/a", "a", "runs/a/version_0"])
def test_a_run_may_be_named_or_given_as_a_folder(tiny_config, run, capsys):
    fit(tiny_config, "--run", run)
    assert Path("runs/a/version_0/last.ckpt").is_file()
    assert main(["validate", "--config", tiny_config, "--run", run, "--checkpoint", "last"]) == 0
    assert "checkpoint: runs/a/version_0/last.ckpt" in capsys.readouterr().out
    assert [path.name for path in Path("runs/a").iterdir()] == ["version_0"], "a validation is no run"


@pytest.mark.parametrize(
    ("options", "folder"),
    [(["--run", "other"], "other/version_0"), ([], "tiny/version_1"), (["--run", "tiny"], "tiny/version_1")],
)
def test_a_training_overwrites_nothing_but_the_last_checkpoint_that_it_goes_on_from(tiny_config, options, folder):
    fit(tiny_config, "--trainer.max_steps", "3")
    before = files_of(RUN)
    which = "last" if options == ["--run", "other"] else "best"
    fit(tiny_config, *options, "--checkpoint", str(RUN / {"last": "last.ckpt", "best": "policy_best.ckpt"}[which]))
    assert files_of(RUN) == before
    assert torch.load(Path("runs") / folder / "last.ckpt", weights_only=True)["global_step"] == 6


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_a_policy_of_another_size_is_refused_in_one_sentence_before_anything_changes(tiny_config, command, capsys):
    fit(tiny_config)
    before = files_of(Path("runs"))
    wider = ["--model.policy.init_args.width", "16"]
    assert main([command, "--config", tiny_config, *wider, "--checkpoint", "last"]) == 2
    error = capsys.readouterr().err
    assert error.partition(f"ugr {command}: ")[2].count("\n") == 2
    assert "trunk.0.weight (16, 14), got trunk.0.weight (8, 14)" in error
    assert files_of(Path("runs")) == before


HONOURED = {
    "model.learning_rate": "0.02",
    "model.weight_decay": "0.5",
    "model.betas": "[0.8, 0.9]",
    "average.decay": "0.5",
    "data.batch_size": "6",
}


def test_a_finished_training_that_is_resumed_says_that_nothing_is_left(tiny_config, capsys):
    for _ in range(2):
        assert "nothing is left to train" not in capsys.readouterr().out
        fit(tiny_config, "--trainer.max_steps", "3", *(["--checkpoint", "last"] if RUN.exists() else []))
    assert "step 3 of 3 is done: nothing is left to train" in capsys.readouterr().out


@pytest.mark.parametrize("key", HONOURED)
def test_what_is_learned_by_may_change_on_the_way_and_is_said(tiny_config, capsys, key):
    short = ["--model.schedule", "constant", "--trainer.max_steps"]
    fit(tiny_config, *short, "3")
    fit(tiny_config, *short, "6", "--checkpoint", "last", f"--{key}", HONOURED[key])
    assert f"from here on: {key} " in capsys.readouterr().out
    group = torch.load(RUN / "last.ckpt", weights_only=True)["optimizer_states"][0]["param_groups"][0]
    name = {"learning_rate": "lr"}.get(key.removeprefix("model."), key.removeprefix("model."))
    if name in group:
        assert str(list(group[name]) if name == "betas" else group[name]) == HONOURED[key]
    assert yaml.safe_load((RUN / "config.yaml").read_text())["run"] == "tiny"


def test_the_settings_before_a_change_stay_beside_those_of_the_end(tiny_config):
    fit(tiny_config, "--trainer.max_steps", "3", "--seed_everything", "4")
    first, reached = (RUN / "config.yaml").read_text(), (RUN / "last.ckpt").read_bytes()
    again = ["--checkpoint", "last", "--seed_everything"]
    fit(tiny_config, "--trainer.max_steps", "6", *again, "5")
    assert (RUN / "config-to-step3.yaml").read_text() == first
    assert yaml.safe_load((RUN / "config.yaml").read_text())["seed_everything"] == 5
    fit(tiny_config, "--trainer.max_steps", "6", *again, "6")
    assert yaml.safe_load((RUN / "config.yaml").read_text())["seed_everything"] == 5, "nothing was trained with 6"
    (RUN / "last.ckpt").write_bytes(reached)  # as if the second start had been killed
    fit(tiny_config, "--trainer.max_steps", "6", *again, "7")
    assert (RUN / "config-to-step3.yaml").read_text() == first


def test_the_same_episodes_in_other_words_are_no_others(tiny_config, capsys):
    count = yaml.safe_load(Path(tiny_config).read_text())["data"]["episodes"]
    fit(tiny_config, "--trainer.max_steps", "3")
    more = ["--trainer.max_steps", "6", "--checkpoint", "last"]
    assert main(["fit", "--config", tiny_config, *more, "--data.image_size", "[8,8]"]) == 2
    assert "its weights know no other" in capsys.readouterr().err
    assert main(["fit", "--config", tiny_config, *more, "--data.split_seed", "3"]) == 2
    assert "what was validated before would be trained on" in " ".join(capsys.readouterr().err.split())
    fit(tiny_config, *more, "--data.episodes", str(list(range(count))))


@pytest.fixture
def muon_config(tiny_config):
    """Config of a training with Muon, of a policy that has transformer layers."""
    sizes = deployed.TINY | {"dropout": 0.1, "chunk_length": 5}
    policy = {"class_path": "ugr_lightning.models.act.ACT", "init_args": sizes}
    config = yaml.safe_load(Path(tiny_config).read_text())
    config["model"] = {"learning_rate": 1e-3, "muon_learning_rate": 1e-3, "policy": policy}
    Path(tiny_config).write_text(yaml.safe_dump(config))
    return tiny_config


def test_muons_rate_may_change_on_the_way_and_is_said(muon_config, capsys):
    fit(muon_config, "--trainer.max_steps", "3")
    fit(muon_config, "--checkpoint", "last", "--model.muon_learning_rate", "0.5")
    assert "from here on: model.muon_learning_rate 0.001 -> 0.5\n" in capsys.readouterr().out
    groups = torch.load(RUN / "last.ckpt", weights_only=True)["optimizer_states"][0]["param_groups"]
    assert [group["lr"] for group in groups] == [1e-3, 1e-3, 0.5]


@pytest.mark.parametrize(("before", "now"), [("0.001", "null"), ("null", "0.001")])
def test_muon_may_not_be_switched_on_or_off_on_the_way(muon_config, capsys, before, now):
    fit(muon_config, "--trainer.max_steps", "3", "--model.muon_learning_rate", before)
    written = files_of(Path("runs"))
    assert main(["fit", "--config", muon_config, "--checkpoint", "last", "--model.muon_learning_rate", now]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"Set `model.muon_learning_rate` to {before}, or train afresh" in said
    assert files_of(Path("runs")) == written


@pytest.mark.parametrize(
    ("says", "options"),
    [
        ("torch 2.9 or later", []),
        ("got TinyPolicy", ["--model.policy", "tiny.TinyPolicy", "--model.policy.dim", "14"]),
    ],
)
def test_muon_that_cannot_train_is_refused_before_demonstrations_are_looked_for(
    muon_config, monkeypatch, capsys, says, options
):
    monkeypatch.delattr(torch.optim, "Muon")
    assert main(["fit", "--config", muon_config, *options, "--data.root", "nowhere"]) == 2
    assert says in capsys.readouterr().err
    assert not list(Path("runs").rglob("version_*"))
    assert not Path("nowhere").exists()


REFUSED = {
    "data.state": "measured",
    "data.split_seed": "1",
    "data.episodes": "4",
    "data.after_end": "hold",
    "data.normalise_over": "all",
    "model.policy.init_args.cameras": "[cam_left_wrist, cam_right_wrist, cam_high]",
}


@pytest.mark.parametrize("key", REFUSED)
def test_what_is_learned_from_may_not_change_and_is_named(tiny_config, capsys, key):
    fit(tiny_config, "--trainer.max_steps", "3")
    before = files_of(Path("runs"))
    assert main(["fit", "--config", tiny_config, "--checkpoint", "last", f"--{key}", REFUSED[key]]) == 2
    error = capsys.readouterr().err
    assert key.removeprefix("model.policy.init_args.") in error
    assert error.partition("ugr fit: ")[2].count("\n") == 2
    assert files_of(Path("runs")) == before


def test_other_episodes_under_the_same_names_are_refused(tiny_config, tmp_path, capsys):
    fit(tiny_config, "--trainer.max_steps", "3")
    record(tmp_path / "others", steps=12, longer=0, size=(8, 12), first_draw=100)
    assert main(["fit", "--config", tiny_config, "--checkpoint", "last", "--data.root", str(tmp_path / "others")]) == 2
    assert "others with the same names" in capsys.readouterr().err


def test_weights_without_a_training_cannot_be_gone_on_with(tiny_config, capsys):
    fit(tiny_config, "--trainer.max_steps", "3")
    content = torch.load(RUN / "last.ckpt", weights_only=True)
    weights_only = {key: content[key] for key in ("policy", "state_dict", "global_step", "epoch")}
    torch.save(weights_only, "imported.ckpt")
    assert main(["fit", "--config", tiny_config, "--checkpoint", "imported.ckpt"]) == 2
    assert "weights only" in capsys.readouterr().err


def test_an_optimiser_that_divides_the_parameters_in_another_way_cannot_be_gone_on_with(tiny_config, capsys):
    fit(tiny_config, "--trainer.max_steps", "3")
    content = torch.load(RUN / "last.ckpt", weights_only=True)
    groups = content["optimizer_states"][0]["param_groups"]
    size = sum(len(group["params"]) for group in groups)
    groups[:] = [{**groups[0], "params": list(range(size - 1))}, {**groups[0], "params": [size - 1]}]
    torch.save(content, "other.ckpt")
    before = sorted(RUN.parent.iterdir())
    assert main(["fit", "--config", tiny_config, "--checkpoint", "other.ckpt"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"other.ckpt: expected an optimiser of {size} parameters, got {size - 1} and 1. It is of another" in said
    groups[:] = groups[:1]
    torch.save(content, "other.ckpt")
    assert main(["fit", "--config", tiny_config, "--checkpoint", "other.ckpt"]) == 2
    assert "Other parameters are frozen now" in " ".join(capsys.readouterr().err.split())
    assert sorted(RUN.parent.iterdir()) == before


def test_a_log_that_was_cut_off_is_gone_on_with(tiny_config):
    fit(tiny_config, "--trainer.max_steps", "3")
    log = RUN / "metrics.csv"
    whole = log.read_bytes()
    log.write_bytes(whole[:-9])
    fit(tiny_config, "--checkpoint", "last")
    steps = [int(row["step"]) for row in scores(RUN)]
    assert steps[-1] == 5
    assert steps == sorted(steps)


LIGHTNINGS = {
    "a GPU that is not there": ["--trainer.accelerator", "cuda"],
    "a value that is not logged": [
        "--trainer.callbacks+=lightning.pytorch.callbacks.EarlyStopping",
        "--trainer.callbacks.monitor=val/lossx",
    ],
}


@pytest.mark.parametrize("options", LIGHTNINGS.values(), ids=LIGHTNINGS)
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_what_lightning_refuses_is_one_sentence(tiny_config, capsys, options):
    assert main(["fit", "--config", tiny_config, *options]) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "settings that Lightning can work with" in error


@pytest.mark.skipif(importlib.util.find_spec("wandb") is not None, reason="W&B is installed")
def test_a_package_that_a_config_needs_is_named(tiny_config, capsys):
    assert main(["fit", "--config", tiny_config, "--trainer.logger", "lightning.pytorch.loggers.WandbLogger"]) == 2
    assert "ConfigError\nugr fit: expected the packages that its config needs, got Requirement 'wandb" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--checkpoints.mode", "minimum"], "checkpoints.mode"),
        (["--checkpoints.monitor", "val/lss"], "Did you mean val/loss"),
        (["--data.after_end", "holds"], "data.after_end"),
        (["--model.schedule", "cosines"], "model.schedule"),
        (["--average.decay", "0.9x"], "average.decay"),
        (["--data.setting", "demo_foo"], "setting: expected demo_clean or demo_randomized"),
    ],
)
def test_a_word_that_is_none_of_the_right_ones_is_named(tiny_config, capsys, options, says):
    assert main(["fit", "--config", tiny_config, *options]) == 2
    said = capsys.readouterr()
    assert says in said.err
    assert "Recording" not in said.out


@pytest.mark.parametrize("how", ["yaml", "apart", "joined"])
def test_the_home_folder_is_understood_however_a_path_is_given(tiny_config, tmp_path, monkeypatch, how):
    monkeypatch.setenv("HOME", str(tmp_path / "me"))
    (tmp_path / "me").mkdir()
    (tmp_path / "me" / "data").symlink_to(yaml.safe_load(Path(tiny_config).read_text())["data"]["root"])
    paths = {"trainer.default_root_dir": "~/runs", "data.root": "~/data"}
    options = {
        "yaml": ["--config", "~/paths.yaml"],
        "apart": [word for key, value in paths.items() for word in (f"--{key}", value)],
        "joined": [f"--{key}={value}" for key, value in paths.items()],
    }
    nested = {key.split(".")[0]: {key.split(".")[1]: value} for key, value in paths.items()}
    (tmp_path / "me" / "paths.yaml").write_text(yaml.safe_dump(nested))
    fit(tiny_config, *options[how], "--run", "a")
    assert (tmp_path / "me" / "runs" / "a" / "version_0" / "last.ckpt").is_file()
    assert not Path("~").exists()


WHERE = {
    "step": "tiny.TinyPolicy.losses",
    "validation": "ugr_lightning.training.module.PolicyModule.validation_step",
    "figures": "ugr_lightning.training.callbacks.figures.ValidationFigures.on_validation_end",
    "loading": "ugr_lightning.data.chunks.ChunkDataset.__getitems__",
}


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_ends_with_its_code_and_leaves_a_checkpoint_that_goes_on_exactly(
    tiny_config, monkeypatch, capsys, where, name
):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also under `nohup`
    whole = ["--model.schedule", "constant", "--checkpoints.mode", "max"]  # the first validation's is the best
    fit(tiny_config, *whole, "--run", "straight")
    path, _, method = WHERE[where].rpartition(".")
    module, _, owner = path.rpartition(".")
    target = getattr(importlib.import_module(module), owner)
    original, calls = getattr(target, method), []

    def interrupted(self, *arguments):
        calls.append(1)
        if len(calls) == (1 if where in ("validation", "figures") else 2):
            os.kill(os.getpid(), getattr(signal, name))
        return original(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(target, method, interrupted)
        assert main(["fit", "--config", tiny_config, *whole]) == 128 + getattr(signal, name)
    assert f"interrupted by {name} after step" in capsys.readouterr().err
    reached = torch.load(RUN / "last.ckpt", weights_only=True)["global_step"]
    assert reached == {"step": 2, "validation": 3, "figures": 3, "loading": 1}[where]
    fit(tiny_config, *whole, "--checkpoint", "last")
    straight = Path("runs/straight/version_0")
    for file in ("last.ckpt", "policy_best.ckpt", "policy_best_loss.ckpt"):
        a, b = weights(RUN, file), weights(straight, file)
        assert all(torch.equal(a[key], b[key]) for key in a), file
    a, b = ([row["val/loss"] for row in scores(folder) if row["val/loss"]] for folder in (RUN, straight))
    assert a == b


@pytest.mark.parametrize("times", [1, 2])
def test_a_signal_in_the_last_validation_keeps_what_it_finds_unless_it_comes_twice(
    tiny_config, monkeypatch, capfd, times
):
    from ugr_lightning.training.module import PolicyModule

    original = PolicyModule.validation_step

    def interrupted(self, *arguments):
        if self.global_step == 6:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGTERM)
        return original(self, *arguments)

    monkeypatch.setattr(PolicyModule, "validation_step", interrupted)
    assert main(["fit", "--config", tiny_config]) == 128 + signal.SIGTERM
    said = capfd.readouterr().err
    assert "Stops when this validation is written" in said
    assert ("interrupted by SIGTERM after the last step" in said) == (times == 1)
    assert torch.load(RUN / "last.ckpt", weights_only=True)["global_step"] == 6
    assert len([row for row in scores(RUN) if row["val/loss"]]) == (2 if times == 1 else 1)


def test_a_signal_to_the_loaders_too_as_a_terminal_sends_it_loses_nothing(tiny_config, monkeypatch, capfd):
    from ugr_lightning.training.module import PolicyModule

    original = PolicyModule.validation_step
    many = [
        "--data.num_workers",
        "1",
        "--data.val_stride",
        "1",
        "--data.batch_size",
        "2",
    ]  # more than it fetches

    sent = []

    def interrupted(self, *arguments):
        for process in [*multiprocessing.active_children(), multiprocessing.current_process()] if not sent else ():
            sent.append(process.pid)
            os.kill(process.pid, signal.SIGINT)
        return original(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(PolicyModule, "validation_step", interrupted)
        assert main(["fit", "--config", tiny_config, *many]) == 130
    assert len(sent) > 1, "there was a loader"
    assert "interrupted by SIGINT after the last step" in capfd.readouterr().err
    assert torch.load(RUN / "policy_best.ckpt", weights_only=True)["global_step"] == 6


def test_an_interrupt_in_the_middle_of_a_step_leaves_the_checkpoint_before(tiny_config, monkeypatch):
    from tiny import TinyPolicy

    losses = TinyPolicy.losses

    def interrupted(self, batch):
        if self.calls == 4:
            raise KeyboardInterrupt
        return losses(self, batch)

    monkeypatch.setattr(TinyPolicy, "losses", interrupted)
    assert main(["fit", "--config", tiny_config]) == 130
    assert torch.load(RUN / "last.ckpt", weights_only=True)["global_step"] == 3


def test_validate_scores_the_checkpoint_it_names(tiny_config, capsys):
    fit(tiny_config)
    logged = [row["val/action_error"] for row in scores(RUN) if row["val/action_error"]]
    capsys.readouterr()
    assert main(["validate", "--config", tiny_config, "--checkpoint", "last"]) == 0
    out = capsys.readouterr().out
    assert f"checkpoint: {RUN / 'last.ckpt'}" in out
    assert logged[-1][:7] in out


@pytest.mark.parametrize("command", ["validate", "fit"])
def test_last_without_a_file_is_an_error(tiny_config, command, capsys):
    assert main([command, "--config", tiny_config, "--checkpoint", "last"]) == 2
    assert "last.ckpt" in capsys.readouterr().err
    assert not Path("runs").exists(), "nothing was trained"


def test_validate_without_a_checkpoint_is_an_error(tiny_config, capsys):
    assert main(["validate", "--config", tiny_config]) == 2
    assert "--checkpoint" in capsys.readouterr().err


def test_missing_demonstrations_are_recorded_first(tiny_config, monkeypatch, tmp_path, recording):
    asked = []

    def collect(task, folder, *, episodes, **options):
        asked.append((task, episodes, options["image_size"]))
        folder.parent.mkdir(parents=True)
        folder.symlink_to(recording / "click_alarmclock" / "demo_clean")

    monkeypatch.setattr("ugr_lightning.demos.collect.collect", collect)
    fit(tiny_config, "--data.root", str(tmp_path / "empty"), "--data.recording.image_size", "[8,12]")
    assert asked == [("click_alarmclock", 5, (8, 12))]


def test_two_processes_see_every_sample_once_and_validate_the_same(tiny_config, monkeypatch, tmp_path):
    still = ["--model.learning_rate", "0", "--model.policy.init_args.still", "true", "--trainer.max_steps", "-1"]
    still += ["--trainer.max_epochs", "1", "--average.decay", "0"]
    fit(tiny_config, *still, "--run", "one")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TINY_LOG": str(tmp_path / "seen")}
    program = "import sys; from ugr_lightning.cli.main import main; sys.exit(main(sys.argv[1:]))"
    (tmp_path / "go.py").write_text(program)  # Lightning starts the second process by the script's path
    command = [sys.executable, "go.py", "fit", "--config", tiny_config, *still]
    command += "--run two --data.batch_size 2 --trainer.strategy ddp --trainer.devices 2".split()
    subprocess.run(command, env=environment, check=True, timeout=300)
    seen = [(tmp_path / f"seen.{rank}").read_text().split("\n")[:-1] for rank in (0, 1)]
    assert len(seen[0]) == len(seen[1]) == 6
    assert max(Counter(seen[0] + seen[1]).values()) == 1, "12 of 48 frames without repetition"
    assert [path.name for path in Path("runs/two").iterdir()] == ["version_0"], "both processes share one folder"
    one, two = (
        {k: float(v) for k, v in scores(Path(f"runs/{run}/version_0"))[-1].items() if v} for run in ("one", "two")
    )
    for name in ("val/action_error", "val/first_frame_error", "val/coarse_error", "val/spearman"):
        assert two[name] == pytest.approx(one[name], rel=1e-5)
