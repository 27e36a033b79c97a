"""Closed-loop rollouts during training, on seeds that belong neither to demonstrations nor to the evaluation."""

import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_warn
from matplotlib.figure import Figure

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.errors import CheckpointError, ConfigError, RenderError
from ugr_lightning.results.results import EpisodeResult, append_result, summarize
from ugr_lightning.rollout.actors import PolicyActor
from ugr_lightning.rollout.evaluate import require_fit, run_episodes
from ugr_lightning.rollout.simulators import Simulators
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.rollout.trajectory import EpisodeTrace
from ugr_lightning.sim.registry import robot_of
from ugr_lightning.sim.seeds import SELECTION_START, seeds_hash
from ugr_lightning.training.callbacks.averaging import averaged_weights
from ugr_lightning.training.tensorboard import log_figure, log_image


class RolloutEvaluation(Callback):
    """Lets the policy act in the simulator every so many steps and logs how often it succeeds.

    The seeds start at 200000: recipe choices and checkpoints may look at them, the evaluation never does. The
    simulators start with the first rollout and stay until the training ends.

    Args:
        every_n_steps: optimiser steps between two rollouts; 0 for never.
        episodes: episodes per rollout.
        execution: `aggregate`, `aggregate-variance`, or the number of steps executed of each chunk.
        workers: simulator processes.
        task: task to roll out; null means that of the data.
        video: log the first episode as an animated GIF.
    """

    def __init__(
        self,
        every_n_steps: int = 0,
        episodes: int = 10,
        execution: Literal["aggregate", "aggregate-variance"] | int = "aggregate",
        workers: int = 2,
        task: str | None = None,
        video: bool = True,
    ) -> None:
        self.every_n_steps = every_n_steps
        self.episodes = episodes
        self.execution = execution
        self.workers = workers
        self.task = task
        self.video = video
        self._last_step = 0
        self._simulators = Simulators()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        self._simulators.close()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._simulators.close()

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Find out before the first step whether rollouts will be possible.

        Raises:
            ConfigError: data without a task, or a policy of another robot.
        """
        if not self.every_n_steps or trainer.fast_dev_run:  # type: ignore[attr-defined]
            self.every_n_steps = 0
            return
        if self.task is None:
            self.task = getattr(trainer.datamodule, "task", None)  # type: ignore[attr-defined]
        if self.task is None:
            fix = "Set rollout.task, or rollout.every_n_steps to 0."
            raise ConfigError("rollout.task", "the task of the data", "data without a task", fix)
        self._check_robot(pl_module.policy)  # type: ignore[arg-type]
        if trainer.is_global_zero and not self._can_render():
            self.every_n_steps = 0

    def _check_robot(self, policy: ChunkPolicy) -> None:
        """A policy of another robot's demonstrations would only fail at the first rollout."""
        try:
            require_fit(policy, str(self.task))
        except CheckpointError as error:
            fix = "Set rollout.every_n_steps to 0 for demonstrations of another robot."
            raise ConfigError("rollout.task", error.expected, error.got, fix) from error

    def _can_render(self) -> bool:
        try:
            from ugr_lightning.sim.render import require_rendering

            require_rendering(self.task)
        except (RenderError, ImportError) as error:
            rank_zero_warn(f"Training goes on without rollouts. {error}")
            return False
        return True

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: Any) -> None:
        """Roll out when it is time; other processes of a distributed run wait at their next exchange."""
        step = trainer.global_step
        if not self.every_n_steps or step % self.every_n_steps or step == self._last_step:
            return
        self._last_step = step
        folder = Path(trainer.log_dir or trainer.default_root_dir)  # asked in every process: the first tells the others
        if trainer.is_global_zero:
            self._evaluate(trainer, pl_module, step, folder)

    def _evaluate(self, trainer: Trainer, pl_module: LightningModule, step: int, folder: Path) -> None:
        with averaged_weights(trainer, pl_module), tempfile.TemporaryDirectory() as scratch:
            results, uncertainty = self._run(trainer, pl_module, Path(scratch))
            video = _first_video(results)
        for result in results:
            result.video = None  # it went to TensorBoard, not to a file that stays
            append_result(folder / "rollouts" / f"step{step:07d}.jsonl", result)
        summary = summarize(results)
        values = {"success_rate": summary.rate, "success_low": summary.low, "success_high": summary.high}
        named = {f"rollout/{name}": value for name, value in values.items()}
        pl_module.log_dict(named, on_step=False, on_epoch=True, rank_zero_only=True, batch_size=1)
        if video:
            log_image(trainer.loggers, "rollout/episode", video, step)
        if uncertainty:
            log_figure(trainer.loggers, "rollout/uncertainty", _uncertainty_figure(uncertainty), step)
        print(f"step {step}  rollout on {len(results)} selection seeds: {summary}", flush=True)

    def _run(
        self, trainer: Trainer, pl_module: LightningModule, videos: Path
    ) -> tuple[list[EpisodeResult], list[np.ndarray]]:
        """Results, and the s_k (K,) of each chunk of the first episode."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        policy = pl_module.policy
        assert isinstance(policy, ChunkPolicy)
        assert self.task is not None
        seeds = [SELECTION_START + episode for episode in range(self.episodes)]
        uncertainty: list[np.ndarray] = []

        def keep(result: EpisodeResult, trace: EpisodeTrace) -> None:
            if result.seed == seeds[0]:
                uncertainty.extend(values for values in trace.log_variance if values is not None)

        actor = PolicyActor(
            policy.for_inference(),
            name=type(policy).__name__,
            state=data.state,
            cameras=robot_of(self.task).cameras,
            control_hz=getattr(data, "control_hz", None),
        )
        spec = RolloutSpec(
            self.task,
            seeds,
            setting=data.setting,
            seeds_hash=seeds_hash([SELECTION_START]),
            image_size=data.image_size,
            execution=self.execution,
            workers=self.workers,
            videos={seeds[0]: videos / "episode.gif"} if self.video else {},
            progress=False,
        )
        results = run_episodes(actor, spec, simulators=self._simulators, on_result=keep)
        return results, uncertainty


def _uncertainty_figure(log_variance: list[np.ndarray]) -> Figure:
    """The predicted uncertainty of every chunk of an episode, one column per chunk."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    picture = axis.imshow(np.stack(log_variance, axis=1), aspect="auto", origin="lower", interpolation="nearest")
    figure.colorbar(picture, label="log-variance s_k")
    axis.set_xlabel("chunk of the episode")
    axis.set_ylabel("step k of the chunk")
    return figure


def _first_video(results: list[EpisodeResult]) -> bytes | None:
    for result in results:
        if result.video:
            return Path(result.video).read_bytes()
    return None
