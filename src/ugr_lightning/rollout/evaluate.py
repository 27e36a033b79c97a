"""Closed-loop episodes: who acts, what is checked before the first one, and what is written of each."""

import copy
import warnings
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.data.layout import Layout
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.checkpoint import PolicyInfo
from ugr_lightning.models.device import chosen_device
from ugr_lightning.models.refine.budget import with_refine_ratio
from ugr_lightning.results.results import EpisodeResult, append_result, drop_cut_off_line, read_results
from ugr_lightning.rollout.actors import DUMMIES, Actor, PolicyActor
from ugr_lightning.rollout.alarm import read_alarms
from ugr_lightning.rollout.film import write_video
from ugr_lightning.rollout.loop import ClosedLoop
from ugr_lightning.rollout.simulators import Simulators
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.rollout.traces import write_trace
from ugr_lightning.rollout.trajectory import OnResult, RunningEpisode
from ugr_lightning.sim.registry import robot_of
from ugr_lightning.sim.render import require_rendering
from ugr_lightning.sim.seeds import SeedChoice, seed_list, seeds_hash
from ugr_lightning.system.progress import Progress

VIDEO_EVERY = 2
"""Videos keep every second control step."""


def run_episodes(
    actor: Actor | ChunkPolicy | str,
    spec: RolloutSpec,
    *,
    simulators: Simulators | None = None,
    on_result: OnResult | None = None,
) -> list[EpisodeResult]:
    """Run one episode per seed and say how each ended.

    An episode ends with the task's success, at the horizon, or when the expert is done. One in which the simulator
    crashes or hangs, or the policy's output is not finite, is a failure with `crash` set; the others go on.

    Args:
        actor: an `Actor`, a policy, or `zero`, `random`, `expert`.
        spec: which episodes, and how.
        simulators: where those of earlier calls are, and those of this one stay; None ends them.
        on_result: called with each result and its trace as soon as the episode ends.

    Returns:
        Results in the order of the seeds, those that were there before included.

    Raises:
        CheckpointError: a policy of another robot or other cameras than the task's.
        ConfigError: an execution or an actor that does not exist.
        SimulationError: no simulator starts.
    """
    acting = make_actor(actor, spec.task)
    if isinstance(acting, PolicyActor):
        require_fit(acting.policy, spec.task)
        _compare_rates(acting.control_hz, spec.task)
    done = _finished(spec, acting) if spec.resume and spec.out is not None else {}
    left = [seed for seed in spec.seeds if seed not in done]
    if left:
        rest = replace(spec, seeds=left, seeds_hash=spec.seeds_hash or seeds_hash(spec.seeds))
        done |= {result.seed: result for result in _run(acting, rest, simulators, on_result)}
    return [done[seed] for seed in spec.seeds]


def evaluation_spec(
    data: Mapping[str, Any], task: str | None, seeds: SeedChoice, episodes: int, **chosen: Any
) -> RolloutSpec:
    """What is rolled out, where a checkpoint says what the command line does not.

    Args:
        data: what the checkpoint says about its data, `PolicyInfo.data`; empty for a dummy.
        task: None takes that of the data.
        seeds: name of a list, or the first seed.
        episodes: how many of them.
        chosen: further fields of `RolloutSpec`; None takes that of the data.

    Raises:
        ConfigError: neither names a task, or there are not so many seeds.
    """
    task = task or data.get("task")
    if task is None:
        raise ConfigError("--task", "a task", "none", "`ugr tasks` lists them.")
    wanted, whole = seed_list(seeds, task, episodes)
    known = {name: data[name] for name in ("setting", "image_size") if data.get(name)}
    fields = known | {name: value for name, value in chosen.items() if value is not None}
    if "image_size" in fields:
        fields["image_size"] = tuple(fields["image_size"])
    return RolloutSpec(task, wanted, seeds_hash=seeds_hash(whole), **fields)


def make_actor(actor: Actor | ChunkPolicy | str, task: str) -> Actor:
    """What `run_episodes` accepts: an actor, a policy, or the name of a dummy.

    Raises:
        CheckpointError: a policy of another robot or other cameras than the task's.
        ConfigError: a name that is none of `zero`, `random`, `expert`.
    """
    if isinstance(actor, ChunkPolicy):
        require_fit(actor, task)
        return PolicyActor(actor, cameras=robot_of(task).cameras)
    if isinstance(actor, Actor):
        return actor
    if actor not in DUMMIES:
        fix = "For a trained policy give its checkpoint."
        raise ConfigError("policy", f"one of {', '.join(DUMMIES)}", actor, fix)
    return DUMMIES[actor]()


def checkpoint_actor(
    policy: ChunkPolicy, info: PolicyInfo, task: str, *, refine_ratio: float | None = None, device: str = "auto"
) -> PolicyActor:
    """A loaded checkpoint, ready to act in a task; the policy itself stays as it is.

    Args:
        policy: from the checkpoint.
        info: what the checkpoint says about itself.
        task: what it is to act in.
        refine_ratio: share of each chunk that is refined, in place of the one in training.
        device: where it computes; `auto` is the GPU where there is one.

    Raises:
        CheckpointError: it was trained for another robot or other cameras, or the alarm beside it is another's.
        ConfigError: a budget that the policy does not have, or no such device.
    """
    require_fit(policy, task)
    name, data = type(policy).__name__, info.data
    if Layout.of_training(data).picked:
        warnings.warn(
            "`data.layout` picked the policy's joints from those of the files it was trained on: unless it gave them "
            f"the order and units of the robot of {task}, success says little.",
            stacklevel=2,
        )
    if refine_ratio is not None:
        policy, name = with_refine_ratio(policy, refine_ratio), f"{name}(refine_ratio={refine_ratio:g})"
    return PolicyActor(
        copy.deepcopy(policy).to(chosen_device(device)).for_inference(),
        name=name,
        state=data.get("state", "commanded"),
        cameras=robot_of(task).cameras,
        refine_ratio=refine_ratio,
        checkpoint=info.sha256,
        control_hz=data.get("control_hz"),
        alarms=read_alarms(info.path, info.sha256),
    )


def require_fit(policy: ChunkPolicy, task: str) -> None:
    """Refuse a policy of another robot before anything is simulated.

    Raises:
        CheckpointError: the task's robot has other joints or cameras than the policy.
    """
    robot = robot_of(task)
    if (policy.state_dim, policy.action_dim) == (robot.action_dim,) * 2 and set(policy.cameras) <= set(robot.cameras):
        return
    wanted = f"state {robot.action_dim}, action {robot.action_dim}, cameras among {', '.join(robot.cameras)}"
    got = f"state {policy.state_dim}, action {policy.action_dim}, cameras {', '.join(policy.cameras)}"
    fix = "Roll out a policy that was trained on demonstrations of this robot."
    raise CheckpointError("policy", f"one for the robot of {task} ({wanted})", got, fix)


def _compare_rates(trained: float | None, task: str) -> None:
    """Warn where the data of a policy had another rate than the simulator."""
    here = robot_of(task).control_hz
    if trained is not None and abs(trained - here) > 0.01 * here:
        warnings.warn(
            f"The policy was trained on {trained:g} actions a second and {task} takes {here:g}: it moves "
            f"{here / trained:.2g} times as fast as its demonstrations. Success says little then.",
            stacklevel=3,
        )


def _run(
    actor: Actor, spec: RolloutSpec, simulators: Simulators | None, on_result: OnResult | None
) -> list[EpisodeResult]:
    with ExitStack() as stack:
        render = bool(actor.cameras or spec.videos)
        if render:
            require_rendering(spec.task)
        open_ones = stack.enter_context(Simulators()) if simulators is None else simulators
        crew = open_ones.open(spec, render)
        actor.begin(crew.slots, spec.execution)
        stack.callback(actor.end)

        def ended(episode: RunningEpisode, crash: str | None) -> EpisodeResult:
            result = _result(episode, crash, actor, spec)
            _write(result, episode, spec)
            if on_result is not None:
                on_result(result, episode.trace)
            return result

        line = stack.enter_context(Progress(f"{spec.task}: {actor.name}", len(spec.seeds), shown=spec.progress))
        return ClosedLoop(crew, actor, spec, line, ended).finish()


def _result(episode: RunningEpisode, crash: str | None, actor: Actor, spec: RolloutSpec) -> EpisodeResult:
    known = [values for values in episode.trace.log_variance if values is not None]
    queries = sum(chunk is not None for chunk in episode.trace.chunks)
    success = crash is None and episode.success
    filmed = spec.videos.get(episode.seed) if episode.trace.images else None
    return EpisodeResult(
        task=spec.task,
        setting=spec.setting,
        seed=episode.seed,
        seeds_hash=spec.seeds_hash or seeds_hash(spec.seeds),
        policy=actor.name,
        checkpoint=actor.checkpoint,
        execution=actor.execution,
        refine_ratio=actor.refine_ratio,
        success=success,
        steps=episode.steps,
        first_success_step=episode.steps if success else None,
        motion_hash=episode.trace.motion_hash(),
        log_variance={"mean": float(np.mean(known)), "max": float(np.max(known))} if known else {},
        seconds={"query": round(episode.query, 4), "simulate": round(episode.simulate, 4)},
        video=None if filmed is None else str(filmed),
        crash=crash,
        queries=queries or None,
        disagreement=episode.trace.disagreement,
        alarm=episode.trace.alarm,
        alarm_rate=None if actor.alarm is None else actor.alarm.rate,
        image_size=list(spec.image_size) if actor.cameras else None,
        refine=actor.refine,
    )


def _write(result: EpisodeResult, episode: RunningEpisode, spec: RolloutSpec) -> None:
    """The video first: a result that is in the file is complete."""
    if result.video is not None:
        write_video(result.video, episode.trace.video(VIDEO_EVERY), fps=episode.control_hz / VIDEO_EVERY)
    if spec.traces is not None:
        write_trace(spec.traces, result, episode.trace)
    if spec.out is not None:
        append_result(spec.out, result)


def _finished(spec: RolloutSpec, actor: Actor) -> dict[int, EpisodeResult]:
    """The episodes that the results file has already, by seed: of this task, seed list, policy, execution and size."""
    assert spec.out is not None
    drop_cut_off_line(spec.out)
    stamp = (spec.task, spec.setting, spec.seeds_hash or seeds_hash(spec.seeds))
    stamp += (actor.name, actor.checkpoint, actor.called(spec.execution))  # type: ignore[assignment]
    return {
        item.seed: item
        for item in (read_results(spec.out) if spec.out.is_file() else [])
        if (item.task, item.setting, item.seeds_hash, item.policy, item.checkpoint, item.execution) == stamp
        and (item.image_size is None or item.image_size == list(spec.image_size))
    }
