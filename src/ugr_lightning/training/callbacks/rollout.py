"""Closed-loop rollouts during training, on seeds that belong neither to demonstrations nor to the evaluation."""

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_warn
from matplotlib.figure import Figure

from ugr_lightning.contract import EpisodeResult
from ugr_lightning.errors import ConfigError, RenderError
from ugr_lightning.training.callbacks.averaging import averaged_weights
from ugr_lightning.training.tensorboard import log_figure, log_image


class RolloutEvaluation(Callback):
    """Lets the policy act in the simulator every so many steps and logs how often it succeeds.

    The seeds start at 200000: recipe choices and checkpoints may look at them, the evaluation never does.

    Args:
        every_n_steps: optimiser steps between two rollouts; 0 for never.
        episodes: episodes per rollout.
        execution: `aggregate`, or the number of steps executed of each chunk.
        workers: simulator processes.
        task: task to roll out; null means that of the data.
        video: log the first episode as an animated GIF.
        on_missing_renderer: `warn` once and train on without rollouts where nothing can render, or stop with an
            `error`.
    """

    def __init__(
        self,
        every_n_steps: int = 0,
        episodes: int = 10,
        execution: Literal["aggregate"] | int = "aggregate",
        workers: int = 2,
        task: str | None = None,
        video: bool = True,
        on_missing_renderer: Literal["warn", "error"] = "warn",
    ) -> None:
        self.every_n_steps = every_n_steps
        self.episodes = episodes
        self.execution = execution
        self.workers = workers
        self.task = task
        self.video = video
        self.on_missing_renderer = on_missing_renderer
        self._last_step = 0

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Find out before the first step whether rollouts will be possible."""
        if not self.every_n_steps or trainer.fast_dev_run:  # type: ignore[attr-defined]
            self.every_n_steps = 0
            return
        if self.task is None:
            self.task = getattr(trainer.datamodule, "task", None)  # type: ignore[attr-defined]
        if self.task is None:
            fix = "Set rollout.task, or rollout.every_n_steps to 0."
            raise ConfigError("rollout.task", "the task of the data", "data without a task", fix)
        if trainer.is_global_zero and not self._can_render():
            self.every_n_steps = 0

    def _can_render(self) -> bool:
        try:
            from ugr_lightning.sim.render import require_rendering

            require_rendering()
        except (RenderError, ImportError) as error:
            if self.on_missing_renderer == "error":
                raise
            rank_zero_warn(f"Training goes on without rollouts. {error}")
            return False
        return True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Roll out when it is time; other processes of a distributed run wait at their next exchange."""
        step = trainer.global_step
        if not self.every_n_steps or step % self.every_n_steps or step == self._last_step:
            return
        self._last_step = step
        if trainer.is_global_zero:
            self._evaluate(trainer, pl_module, step)

    def _evaluate(self, trainer: Trainer, pl_module: LightningModule, step: int) -> None:
        from ugr_lightning.rollout.results import append_result, summarize

        folder = Path(trainer.log_dir or trainer.default_root_dir)
        training = pl_module.training
        pl_module.eval()
        try:
            with averaged_weights(trainer, pl_module), tempfile.TemporaryDirectory() as scratch:
                results = self._run(trainer, pl_module, Path(scratch))
                video = _first_video(results)
                for result in results:
                    result.video = None
                    append_result(folder / "rollouts" / f"step{step:07d}.jsonl", result)
        finally:
            pl_module.train(training)
        summary = summarize(results)
        values = {"success_rate": summary.rate, "success_low": summary.low, "success_high": summary.high}
        named = {f"rollout/{name}": value for name, value in values.items()}
        pl_module.log_dict(named, on_step=False, on_epoch=True, rank_zero_only=True, batch_size=1)
        if video:
            log_image(trainer.loggers, "rollout/episode", video, step)
        print(f"step {step}: rollout {summary}", flush=True)

    def _run(self, trainer: Trainer, pl_module: LightningModule, videos: Path) -> list[EpisodeResult]:
        from ugr_lightning.rollout.runner import run_episodes
        from ugr_lightning.sim.seeds import SELECTION_START

        data = trainer.datamodule  # type: ignore[attr-defined]
        return run_episodes(
            pl_module.policy,
            self.task,
            [SELECTION_START + episode for episode in range(self.episodes)],
            setting=getattr(data, "setting", "demo_clean"),
            image_size=tuple(data.image_size),
            execution=self.execution,
            workers=self.workers,
            video_dir=videos if self.video else None,
        )


def _first_video(results: list[EpisodeResult]) -> bytes | None:
    for result in results:
        if result.video and Path(result.video).suffix == ".gif":
            return Path(result.video).read_bytes()
    return None
