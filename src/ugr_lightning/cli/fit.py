"""`ugr fit` and `ugr validate`: LightningCLI with runs, includes and checkpoints that are found across processes."""

import argparse
import logging
import os
import re
import shutil
import sys
import warnings
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import torch
import yaml
from jsonargparse import Namespace
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from ugr_lightning.cli.failures import explain_training
from ugr_lightning.cli.parsing.call import at_home
from ugr_lightning.cli.parsing.config import config_of, expand_includes, explain, flat, run_name
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.errors import CheckpointError, DataError
from ugr_lightning.models.checkpoint import read_checkpoint
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.limits import usable_cores
from ugr_lightning.system.lock import locked
from ugr_lightning.system.signals import Stopped
from ugr_lightning.training.callbacks.averaging import WeightAverage
from ugr_lightning.training.callbacks.checkpoints import PolicyCheckpoints
from ugr_lightning.training.callbacks.figures import ValidationFigures
from ugr_lightning.training.callbacks.progress_line import TrainingProgress
from ugr_lightning.training.callbacks.rng import CounterSeeds
from ugr_lightning.training.callbacks.rollout_evaluation import RolloutEvaluation
from ugr_lightning.training.callbacks.stopping import OrderlyStop
from ugr_lightning.training.checkpoint_io import AtomicCheckpointIO
from ugr_lightning.training.loggers import run_loggers
from ugr_lightning.training.module import PolicyModule
from ugr_lightning.training.resume import TrainedWith, changes, check_data, check_training, check_weights
from ugr_lightning.training.runs import FILES, claim_version, home_of, resolve_checkpoint, run_folder

_SCORES = ("rollout/success_rate", "val/action_error", "val/loss")
_DEFAULT_POLICY = "--model.policy=ugr_lightning.models.act.ACT"
"""An argument before the user's, not a default of the parser, whose every value a class in a config would inherit."""
_FOLDERS = ("trainer.default_root_dir", "data.root", "data.folder")
_ABOUT = {
    "fit": "Train a policy; records missing demonstrations first.",
    "validate": "Validation losses and errors of a checkpoint.",
}
_LOADERS = {"fit": ("train_dataloaders", "val_dataloaders"), "validate": ("dataloaders",)}
_RUN_FOLDER = "UGR_RUN_FOLDER"  # tells the other processes of a distributed run which folder the first one chose


class RunRecord(SaveConfigCallback):
    """Leaves `config.yaml` in the run's folder, and its values beside the final scores in TensorBoard's HPARAMS.

    The file is written after the first step, not before: it says what the run's checkpoints are from. It starts the
    same training anywhere, so its folders are absolute and it names no checkpoint to go on from. Where a training goes
    on with other settings, those it had before stay in `config-to-stepN.yaml`.
    """

    written, start = False, 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Nothing yet: whether the training can start is not known."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember where the training goes on."""
        self.start = trainer.global_step

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        """Write the config, once."""
        if self.written:
            return
        path, self.written = Path(str(trainer.log_dir)) / self.config_filename, True
        if not trainer.is_global_zero:
            return
        text = self.parser.dump(anywhere(self.config), skip_none=False)
        kept = path.with_name(f"config-to-step{self.start}.yaml")
        if path.is_file() and path.read_text() != text and not kept.exists():
            publish_text(kept, path.read_text())
        publish_text(path, text)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Log the hyper-parameters with success as a metric, where there were rollouts."""
        values = _by_key(self.parser, self.config)
        scores = {f"hp/{name}": trainer.callback_metrics[name] for name in _SCORES if name in trainer.callback_metrics}
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(values, scores, trainer.global_step)


def anywhere(config: Namespace) -> Namespace:
    """A resolved config that starts the same training from any folder: absolute paths, and no checkpoint.

    Args:
        config: of `ugr fit`.
    """
    config = config.clone()
    config.checkpoint = None
    for key, value in config.items(branches=False):
        if isinstance(value, (str, Path)) and (key in _FOLDERS or ("/" in str(value) and Path(value).is_file())):
            config[key] = str(Path(value).resolve())
    return config


def _by_key(parser: LightningArgumentParser, config: Namespace) -> dict[str, Any]:
    """A config by dotted key; what is no number and no text, as text."""
    values = flat(yaml.safe_load(parser.dump(config, skip_none=False)))
    return {key: value if isinstance(value, (bool, int, float, str)) else str(value) for key, value in values.items()}


class UGRCLI(LightningCLI):
    """LightningCLI for policies: `fit` and `validate`.

    Args:
        args: command line, starting with the subcommand, includes expanded.
        default_run: name of the run where `--run` is not given.
        held: keeps the run's folder locked until it is closed.
    """

    def __init__(self, args: list[str], default_run: str, held: ExitStack) -> None:
        self.command, self.given, self.default_run, self.held = args[0], args, default_run, held
        strict: dict[str, Any] = {"exit_on_error": False, "allow_abbrev": False}
        super().__init__(
            PolicyModule,
            ChunkDataModule,
            save_config_callback=RunRecord,
            save_config_kwargs={"overwrite": True},
            trainer_defaults={
                "default_root_dir": "runs",
                "max_epochs": -1,
                "num_sanity_val_steps": 0,
                "enable_model_summary": False,
                "log_every_n_steps": 10,
            },
            seed_everything_default=0,
            parser_kwargs=strict | {self.command: strict | {"description": _ABOUT[self.command]}},
            args=args,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,
        )

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]
        """The trainer's method that was asked for, with the arguments that are not for the user.

        Another one's parser would take as long to build and not be read.
        """
        return {self.command: {"model", "datamodule", "weights_only", "ckpt_path", *_LOADERS[self.command]}}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """The run's name, the callbacks' settings, and links that keep data and policy in agreement."""
        parser.add_argument("--run", type=str | None, default=None, help="name of the run, or the folder of one")
        parser.add_argument(
            "--checkpoint",
            "--ckpt_path",  # Lightning's word
            type=str | None,
            default=None,
            help="`last`, `best` or `best_loss` of the run, or a checkpoint file; a fit goes on from it",
        )
        parser.add_argument("--include", type=_merged_already, default=None, help="configs that come before this one")
        parser.add_lightning_class_args(WeightAverage, "average")
        parser.add_lightning_class_args(PolicyCheckpoints, "checkpoints")
        parser.add_lightning_class_args(RolloutEvaluation, "rollout")
        parser.add_lightning_class_args(ValidationFigures, "figures")
        parser.link_arguments("seed_everything", "data.seed", int)  # one seed names a training
        parser.link_arguments("model", "data.cameras", lambda module: list(module.policy.cameras), "instantiate")
        parser.link_arguments("model", "data.chunk_length", lambda module: module.policy.chunk_length, "instantiate")
        parser.link_arguments(
            "model", "data.observation_steps", lambda module: module.policy.observation_steps, "instantiate"
        )

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse; what is wrong becomes one paragraph that names the key."""
        try:
            self.config = parser.parse_args(args)
        except argparse.ArgumentError as error:
            raise explain(error, self._parser(args[0]), args) from None

    def _parse_ckpt_path(self) -> None:
        """Say once and for all where the run is, and resolve `best` and `last` before Lightning sees them.

        Lightning would go on with fresh weights.
        """
        config = self.config[self.config.subcommand]
        at_home(config)
        root = Path(config.trainer.default_root_dir or "runs")
        folder = run_folder(config.run or self.default_run, root)
        if config.get("checkpoint"):
            checkpoint = resolve_checkpoint(config.checkpoint, str(folder), root)
            if checkpoint.is_dir():
                fix = "Use `ugr test` or `ugr predict`; `ugr fit` and `ugr validate` want a checkpoint of `ugr fit`."
                raise CheckpointError("--checkpoint", "a checkpoint file", f"{checkpoint}, an exported folder", fix)
            config.checkpoint = str(checkpoint)
            print(f"checkpoint: {config.checkpoint}")
            if config.run is None and _is_of_a_run(checkpoint):
                folder = checkpoint.parent
        elif self.config.subcommand == "validate":
            fix = "Add --checkpoint best (or last, or a file)."
            raise CheckpointError("--checkpoint", "a checkpoint to validate", "none", fix)
        self.home = home_of(folder)
        config.run = str(self.home.relative_to(root) if self.home.is_relative_to(root) else self.home.resolve())

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """The trainer with atomic checkpoints and all logs in the run's folder; a validation leaves nothing there."""
        config = self._get(self.config_init, "trainer")
        loggers = [] if isinstance(config.get("logger"), bool) else _listed(config.get("logger"))
        if self.subcommand == "fit":
            folder, step = self._claim()
            kwargs["default_root_dir"] = str(folder)
            if config.get("logger") is not False:  # ours come first: the trainer writes where the first one does
                loggers = [*run_loggers(folder, step), *loggers]
        kwargs["logger"] = loggers or False
        kwargs["plugins"] = [*_listed(config.get("plugins")), AtomicCheckpointIO()]
        always: list[Callback] = [CounterSeeds(self._get(self.config, "seed_everything"))]
        if self.subcommand == "fit":
            always.append(TrainedWith(self._values()))
        if config.get("enable_progress_bar") is not False:
            always.append(TrainingProgress())
        config["callbacks"] = [*_listed(config.get("callbacks")), *always]
        return super().instantiate_trainer(**kwargs)

    def _instantiate_trainer(self, config: dict[str, Any], callbacks: list[Callback]) -> Trainer:
        """Put `OrderlyStop` behind the average, which belongs to a step, and before what may take long after it."""
        place = 1 + next(i for i, callback in enumerate(callbacks) if isinstance(callback, WeightAverage))
        return super()._instantiate_trainer(config, [*callbacks[:place], OrderlyStop(), *callbacks[place:]])

    def _claim(self) -> tuple[Path, int | None]:
        """A folder that no other training writes to, and the step to go on from where that is known.

        A training goes on in its own folder from `last.ckpt`; from any other checkpoint, or under another `--run`, it
        begins a new version, so that nothing is overwritten.
        """
        given = self._get(self.config, "checkpoint")
        checkpoint = Path(given or "none")
        ours = checkpoint.name == FILES["last"] and checkpoint.resolve().parents[1] == self.home.resolve()
        if not _is_first_process():  # the first writes, and tells the others where
            return Path(os.environ.get(_RUN_FOLDER, self.home / "version_0")), None
        folder = checkpoint.parent if ours else claim_version(self.home)
        os.environ[_RUN_FOLDER] = str(folder)
        self.held.callback(_remove_if_nothing_came_of_it, folder)
        self.held.enter_context(locked(folder / "run.lock", f"the run {folder}"))
        return folder, int(read_checkpoint(checkpoint, mmap=True)["global_step"]) if ours else None

    def fit(self, **given: Any) -> None:
        """Train; Lightning calls it in place of the trainer's."""
        self.trainer.fit(ckpt_path=self._get(self.config, "checkpoint"), **given)
        folder = self.trainer.log_dir  # asked in every process: the first one tells the others
        if _is_first_process():
            print(f"trained to step {self.trainer.global_step}: {folder}")
        asked = next(item.asked for item in self.trainer.callbacks if isinstance(item, OrderlyStop))  # type: ignore[attr-defined]
        if asked is not None:
            raise Stopped(asked, "after the last step")

    def validate(self, **given: Any) -> None:
        """Validate; Lightning calls it in place of the trainer's."""
        self.trainer.validate(ckpt_path=self._get(self.config, "checkpoint"), **given)

    def before_fit(self) -> None:
        """Find out whether the training may begin or go on, before anything is recorded, decoded or touched."""
        parts = self.model.parts()
        content = self._check_weights()
        if content is None or not _is_first_process():
            return
        path = Path(self._get(self.config, "checkpoint"))
        check_training(path, content, parts)
        self.datamodule.prepare_data()
        self.datamodule.setup("fit")
        check_data(path, content, self.model.policy, self.datamodule)
        changed = changes(content, self._values())
        if changed:
            print(f"from here on: {'; '.join(changed)}")
        done, last = int(content["global_step"]), self.trainer.max_steps
        if 0 <= last <= done:
            print(f"step {done} of {last} is done: nothing is left to train (--trainer.max_steps sets another end)")

    def before_validate(self) -> None:
        """Find out whether the checkpoint fits."""
        self._check_weights()

    def _check_weights(self) -> dict[str, Any] | None:
        given = self._get(self.config, "checkpoint")
        if not given:
            return None
        content = read_checkpoint(given, mmap=True)
        check_weights(Path(given), content, self.model.policy)
        return content

    def _values(self) -> dict[str, Any]:
        """The resolved config by dotted key."""
        return _by_key(self._parser(self.subcommand), self.config[self.subcommand])

    def after_instantiate_classes(self) -> None:
        """Let the data module record what is missing, with the simulator's help, unless it is to be elsewhere."""
        from ugr_lightning.cli.collect import check_recording, record_demonstrations

        if self.datamodule.elsewhere and not self.datamodule.folder.exists():
            config = config_of("data.folder", self.given)
            expected = "demonstrations" + f", as `data.folder` in {config} says" * (config is not None)
            fix = "Say where they are: `--data.folder FOLDER`."
            raise DataError(self.datamodule.folder, expected, "nothing there", fix)
        self.datamodule.recorder = record_demonstrations
        check_recording(self.datamodule)


def _is_first_process() -> bool:
    return getattr(rank_zero_only, "rank", 0) == 0


def _is_of_a_run(checkpoint: Path) -> bool:
    return re.fullmatch(r"version_\d+", checkpoint.parent.name) is not None


def _remove_if_nothing_came_of_it(folder: Path) -> None:
    """Remove the folder of a training without a step, and that of its run where it was the only one."""
    if not (folder / "config.yaml").exists() and not any(folder.glob("*.ckpt")):
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # there are others
            folder.parent.rmdir()


def _listed(value: Any) -> list[Any]:
    if value is None:
        return []
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _merged_already(value: Any) -> None:
    """`include` has been resolved before parsing; nothing of it remains."""


def run(command: str, argv: Sequence[str]) -> int:
    """Run `ugr fit` or `ugr validate`.

    Args:
        command: `fit` or `validate`.
        argv: what follows it.

    Raises:
        ConfigError: an unknown key or a value that does not fit.
    """
    for remark in ("does not have many workers", "smaller than the logging interval", "isinstance.treespec, LeafSpec"):
        warnings.filterwarnings("ignore", message=f".*{remark}.*")
    warnings.filterwarnings("ignore", message=".*exists and is not empty.*")  # the log that a resumed run continues
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(usable_cores())
    try:
        with ExitStack() as held:
            UGRCLI([command, _DEFAULT_POLICY, *expand_includes(argv)], run_name(argv), held)
    except SystemExit as end:
        if isinstance(end.__context__, KeyboardInterrupt):  # Lightning has shut down and exits with 1
            raise end.__context__ from None
        raise
    except Exception as error:
        told = explain_training(error)
        if told is not None:
            raise told from error
        raise
    return 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1], sys.argv[2:]))
