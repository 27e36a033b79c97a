"""One demonstration: the expert drives, noise disturbs, frames and intentions are kept."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ugr_lightning.data.formats.robotwin import write_episode
from ugr_lightning.data.storage.jpeg import encode_frame
from ugr_lightning.demos.intended import intended_poses
from ugr_lightning.demos.noise import ExecutionNoise, Noise
from ugr_lightning.errors import DataError, SimulationError
from ugr_lightning.rollout.film import write_video
from ugr_lightning.sim.expert import ExpertStep
from ugr_lightning.sim.frame import Frame
from ugr_lightning.sim.registry import robot_of
from ugr_lightning.sim.simulator import Simulator
from ugr_lightning.system.files import publish_text


class _Attempt(NamedTuple):
    """An episode of N steps as it happened, in memory: N + 1 frames."""

    frames: list[Frame]  # without their pictures
    pictures: list[tuple[bytes, ...]]  # a JPEG of each camera
    views: list[np.ndarray]  # of the first camera, (H, W, 3) uint8; none unless a video was asked for
    camera_parameters: list[dict[str, dict[str, np.ndarray]]]
    intentions: list[ExpertStep]  # N of them
    scene_info: dict[str, Any]


class Outcome(NamedTuple):
    """What became of a seed.

    Args:
        seed: simulator seed.
        steps: control steps of its last attempt.
        failure: why there is no demonstration, None when there is one.
    """

    seed: int
    steps: int
    failure: str | None = None


def staged_episode(staging: Path, seed: int) -> Path:
    """Where the episode of a seed waits until all seeds before it are decided."""
    return staging / f"seed{seed}.hdf5"


def staged_scene(staging: Path, seed: int) -> Path:
    """What belongs to a staged episode and is not in its file."""
    return staging / f"seed{seed}.json"


def staged_video(staging: Path, seed: int) -> Path:
    """The video of a staged episode, where one was asked for."""
    return staging / f"seed{seed}.mp4"


class Recorder:
    """Records seeds into a staging folder; lives in a worker process.

    Args:
        open_task: opens the simulator.
        noise: how much the executed commands stray.
        staging: folder for finished episodes; each appears there complete, by rename.
        video: whether to write a video of the first camera too.
    """

    def __init__(self, open_task: Callable[[], Simulator], noise: Noise, staging: Path, video: bool = False) -> None:
        self._simulator, self._noise, self._staging, self._video = open_task(), noise, staging, video
        self._tries = 1 if noise.silent else noise.attempts

    def record(self, seed: int) -> Outcome:
        """Record a seed, unless it is there from before an interruption.

        Raises:
            DataError: the episode cannot be written.
        """
        scene = staged_scene(self._staging, seed)
        if staged_episode(self._staging, seed).is_file() and scene.is_file():
            return Outcome(seed, json.loads(scene.read_text())["steps"])
        failure, steps = "", 0
        for attempt in range(self._tries):
            try:
                recording = self._try(seed, attempt)
            except SimulationError as error:
                failure = str(error)
                continue
            steps = len(recording.intentions)
            if recording.frames[-1].success and steps:
                self._write(recording, seed, attempt)
                return Outcome(seed, steps)
            failure = self._simulator.gave_up or f"the expert did not succeed in {steps} steps"
        return Outcome(seed, steps, failure)

    def _try(self, seed: int, attempt: int) -> _Attempt:
        """The expert does the task once: the first frame after reset, then one after each step.

        Source: RoboTwin-Platform/RoboTwin@13c3c47, envs/_base_task.py (when a frame is stored); docs/data.md.
        """
        simulator, recording = self._simulator, _Attempt([], [], [], [], [], {})
        process = ExecutionNoise(self._noise, seed, attempt, simulator.control_hz, simulator.action_dim)

        def keep(frame: Frame) -> None:
            recording.frames.append(frame._replace(images=frame.images[:0]))
            recording.pictures.append(encode_frame(frame.images))
            recording.camera_parameters.append(simulator.camera_parameters())
            if self._video:
                recording.views.append(frame.images[0].copy())

        keep(simulator.reset(seed))
        recording.scene_info.update(simulator.scene_info())
        for intention in simulator.expert():
            recording.intentions.append(intention)
            keep(simulator.step(process.disturb(intention.action, intention.slack)))
        return recording

    def _write(self, recording: _Attempt, seed: int, attempt: int) -> None:
        frames, intentions, simulator = recording.frames, recording.intentions, self._simulator
        scene = {**recording.scene_info, "seed": seed, "attempt": attempt, "steps": len(intentions)}
        text = json.dumps(scene, indent=2)
        endpose, measured = (np.stack([getattr(frame, name) for frame in frames]) for name in ("endpose", "measured"))
        expert_action = np.stack([intention.action for intention in intentions])  # (N, A)
        slack = np.array([intention.slack for intention in intentions], np.float32)  # (N,)
        forward = None if self._noise.silent else robot_of(simulator.task).forward
        intended = None if forward is None else intended_poses(endpose, measured, expert_action, slack, forward)
        try:
            if self._video:
                self._staging.mkdir(parents=True, exist_ok=True)
                write_video(staged_video(self._staging, seed), recording.views, fps=simulator.control_hz)
            publish_text(staged_scene(self._staging, seed), text)
            write_episode(  # last: its presence says that the rest is there
                staged_episode(self._staging, seed),
                images=recording.pictures,
                commanded=np.stack([frame.commanded for frame in frames]),
                measured=measured,
                endpose=endpose,
                intended_endpose=intended,
                contacts=np.stack([frame.contacts for frame in frames]),
                expert_action=expert_action,
                phase=[intention.phase for intention in intentions],
                slack=slack,
                camera_parameters=recording.camera_parameters,
                task=simulator.task,
                setting=simulator.setting,
                seed=seed,
                control_hz=simulator.control_hz,
                noise={**asdict(self._noise), "attempt": attempt},
                task_version=simulator.task_version,
                cameras=simulator.cameras,
            )
        except OSError as error:
            fix = "Make room or correct the permissions and run the same command again: it goes on where it stopped."
            raise DataError(self._staging, "a folder that can be written to", error, fix) from error
