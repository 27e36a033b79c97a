"""The subcommands of `ugr` that are one typed function each; jsonargparse turns their signatures into options."""

import argparse
import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from jsonargparse import ArgumentParser

from ugr_lightning.cli.config import explain
from ugr_lightning.cli.runs import resolve_checkpoint
from ugr_lightning.contract import EpisodeResult
from ugr_lightning.errors import ConfigError, UGRError
from ugr_lightning.rollout.noise import Noise


def call(function: Callable[..., int], command: str, argv: Sequence[str]) -> int:
    """Parse a command line by the signature of a function and call it.

    Args:
        function: its parameters become options; those without a default are required.
        command: name of the subcommand.
        argv: what follows it.

    Raises:
        ConfigError: an unknown option or a value that does not fit.
    """
    summary = (function.__doc__ or "").split("\n", 1)[0]
    parser = ArgumentParser(prog=f"ugr {command}", description=summary, exit_on_error=False, allow_abbrev=False)
    parser.add_function_arguments(function, as_group=False, as_positional=False, sub_configs=True)
    for action in parser._actions:
        if getattr(action, "_typehint", None) is bool:
            action.nargs, action.const = "?", True  # `--quick` alone means `--quick true`
    if "config" not in inspect.signature(function).parameters:
        parser.add_argument("--config", action="config", help="YAML file with options")
    try:
        options = parser.instantiate_classes(parser.parse_args(list(argv)))
    except argparse.ArgumentError as error:
        if isinstance(error.__cause__ or error.__context__, UGRError):
            raise (error.__cause__ or error.__context__) from None  # type: ignore[misc]
        raise explain(error, parser) from None
    given = {name: options[name] for name in inspect.signature(function).parameters}
    return function(**given)


def _collect(
    task: str,
    episodes: int = 50,
    root: str = "data/160x120",
    setting: str = "demo_clean",
    image_size: tuple[int, int] = (120, 160),
    noise: Noise = Noise(),  # noqa: B008 - frozen
    workers: int = 2,
    video: bool = False,
) -> int:
    """Record demonstrations of a task's scripted expert in RoboTwin 2.0's layout; goes on where it was stopped.

    Args:
        task: a name from `ugr tasks`.
        episodes: how many the folder shall hold.
        root: where to; episodes are in `<root>/<task>/<setting>/data`.
        setting: `demo_clean` or `demo_randomized`.
        image_size: height and width of the pictures.
        noise: noise on the executed commands; the intended ones are the labels.
        workers: simulator processes.
        video: write a video of each episode as well.
    """
    from ugr_lightning.rollout.collect import collect as record

    folder = Path(root) / task / setting
    record(
        task,
        folder,
        episodes=episodes,
        setting=setting,
        image_size=image_size,
        noise=noise,
        workers=workers,
        video=video,
    )
    print(f"{episodes} demonstrations in {folder}")
    return 0


def _rollout(
    task: str | None = None,
    policy: str = "expert",
    seeds: Literal["evaluation", "selection"] | int = "evaluation",
    episodes: int | None = None,
    execution: Literal["aggregate"] | int = "aggregate",
    setting: str | None = None,
    image_size: tuple[int, int] | None = None,
    workers: int = 2,
    video: str | None = None,
    out: str | None = None,
) -> int:
    """Let a policy act in a task and count its successes.

    Args:
        task: a name from `ugr tasks`; null takes the task a checkpoint was trained on.
        policy: `zero`, `random`, `expert`, or a checkpoint file.
        seeds: `evaluation` (the task's fixed list), `selection` (for choices of a recipe), or the first seed.
        episodes: how many of those seeds; null means 100, or 1 where only a video is asked for.
        execution: `aggregate`, or the number of steps executed of each chunk.
        setting: `demo_clean` or `demo_randomized`; null takes the checkpoint's.
        image_size: height and width of the pictures; null takes the checkpoint's.
        workers: simulator processes.
        video: file for an animated GIF of the first episode.
        out: results file, one JSON line per episode is appended.
    """
    from ugr_lightning.rollout.results import success_table

    if episodes is None:
        episodes = 1 if video and not out else 100
    if episodes < 1:
        raise ConfigError("--episodes", "at least 1", episodes, "Correct the number.")
    results = roll_out(
        policy,
        task,
        seeds=seeds,
        episodes=episodes,
        execution=execution,
        setting=setting,
        image_size=image_size,
        workers=workers,
        video=None if video is None else Path(video),
        out=None if out is None else Path(out),
    )
    print(success_table(results))
    return 0


def roll_out(
    policy: str,
    task: str | None,
    *,
    seeds: Literal["evaluation", "selection"] | int,
    episodes: int,
    execution: str | int,
    setting: str | None = None,
    image_size: tuple[int, int] | None = None,
    workers: int = 2,
    video: Path | None = None,
    out: Path | None = None,
) -> list[EpisodeResult]:
    """Roll out a dummy or a checkpoint; see `ugr rollout`.

    Raises:
        ConfigError: no task is given and the policy does not name one.
        CheckpointError: not a usable checkpoint.
        RenderError: nothing here can render.
    """
    import tempfile

    from ugr_lightning.contract import CAMERAS
    from ugr_lightning.rollout.actors import DUMMIES, Actor, PolicyActor, make_actor
    from ugr_lightning.rollout.results import append_result
    from ugr_lightning.rollout.runner import run_episodes
    from ugr_lightning.sim.render import require_rendering
    from ugr_lightning.sim.seeds import seeds_hash
    from ugr_lightning.training.checkpoint import load_policy

    actor: Actor
    trained: dict[str, object] = {}
    sha = None
    if policy in DUMMIES:
        actor = make_actor(policy)
    else:
        if not Path(policy).is_file() and not policy.endswith(".ckpt"):
            fix = "For a run's checkpoint use `ugr test --run NAME`, or give the file."
            raise ConfigError("--policy", f"one of {', '.join(DUMMIES)}, or a checkpoint file", policy, fix)
        model, info = load_policy(policy)
        missing = sorted(set(model.cameras) - set(CAMERAS))
        if missing:
            raise ConfigError("cameras", f"cameras of the simulator, {CAMERAS}", missing, "Use another checkpoint.")
        trained, sha = info.data, info.sha256
        actor = PolicyActor(model.for_inference(), name=type(model).__name__, state=trained.get("state", "commanded"))  # type: ignore[arg-type]
    task = task or trained.get("task")  # type: ignore[assignment]
    if task is None:
        raise ConfigError("--task", "a task", "none", "`ugr tasks` lists them.")
    if actor.cameras or video is not None:
        require_rendering()
    wanted, whole = seed_list(seeds, str(task), episodes)
    with tempfile.TemporaryDirectory() as scratch:
        results = run_episodes(
            actor,
            str(task),
            wanted,
            setting=setting or str(trained.get("setting", "demo_clean")),
            image_size=tuple(image_size or trained.get("image_size") or (120, 160)),  # type: ignore[arg-type]
            execution=execution,
            workers=min(workers, len(wanted)),
            checkpoint=sha,
            seeds_hash=seeds_hash(whole),
            on_result=None if out is None else lambda result, trace: append_result(out, result),
            video_dir=scratch if video is not None else None,
            video_seeds=wanted[:1],
        )
        if video is not None and results[0].video is not None:
            video.parent.mkdir(parents=True, exist_ok=True)
            video.with_name(video.name + ".partial").write_bytes(Path(results[0].video).read_bytes())
            video.with_name(video.name + ".partial").replace(video)
            print(f"video: {video}")
    return results


def seed_list(which: Literal["evaluation", "selection"] | int, task: str, count: int) -> tuple[list[int], list[int]]:
    """The seeds of some episodes, and the whole list they are from.

    Args:
        which: name of a list, or the first seed.
        task: whose evaluation list.
        count: how many.

    Raises:
        ConfigError: more than the list has.
    """
    from ugr_lightning.sim.seeds import SELECTION_START, evaluation_seeds

    if which == "evaluation":
        whole = evaluation_seeds(task)
        if count > len(whole):
            fix = "Give the first seed of another range instead, e.g. --seeds 300000."
            raise ConfigError("--episodes", f"at most the {len(whole)} evaluation seeds", count, fix)
        return whole[:count], whole
    first = SELECTION_START if which == "selection" else int(which)
    seeds = list(range(first, first + count))
    return seeds, seeds


def _test(
    ckpt_path: str = "best",
    run: str | None = None,
    root: str = "runs",
    task: str | None = None,
    episodes: int = 100,
    executions: list[Literal["aggregate"] | int] = ["aggregate", 25],  # noqa: B006 - jsonargparse copies it
    workers: int = 2,
    out: str | None = None,
) -> int:
    """Success of a checkpoint on the task's evaluation seeds, with aggregated chunks and with executed ones.

    Args:
        ckpt_path: `best`, `best_loss`, `last`, or a checkpoint file.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        task: a name from `ugr tasks`; null takes the task the checkpoint was trained on.
        episodes: how many of the 100 evaluation seeds.
        executions: each `aggregate`, or the number of steps executed of each chunk.
        workers: simulator processes.
        out: results file; null appends to `evaluation.jsonl` beside the checkpoint.
    """
    from ugr_lightning.rollout.results import success_table

    checkpoint = resolve_checkpoint(ckpt_path, run or newest_run(Path(root)), Path(root))
    print(f"checkpoint: {checkpoint}")
    results = []
    for execution in executions:
        file = Path(out) if out else checkpoint.with_name("evaluation.jsonl")
        results += roll_out(
            str(checkpoint), task, seeds="evaluation", episodes=episodes, execution=execution, workers=workers, out=file
        )
    print(success_table(results))
    return 0


def newest_run(root: Path) -> str:
    """Name of the run that was written to last; `run` where there is none, which then is not found."""
    found = sorted(root.glob("*/version_*/*.ckpt"), key=lambda path: path.stat().st_mtime)
    return str(found[-1].parent) if found else "run"


def _tasks() -> int:
    """List the simulated tasks."""
    from ugr_lightning.sim.tasks import task_summaries

    for name, summary in task_summaries().items():
        print(f"{name:<20}{summary}")
    return 0


def _doctor() -> int:
    """Check this machine and say what to do."""
    from ugr_lightning.cli.doctor import run_doctor

    return run_doctor(sys.stdout)


def _bench(
    parts: list[Literal["training", "query", "data", "simulation"]] | None = None,
    quick: bool = False,
    threads: int | None = None,
    processes: int = 2,
    rounds: int | None = None,
    json: str | None = None,
) -> int:
    """Measure speed on this machine.

    Args:
        parts: what to measure; null means all.
        quick: tiny sizes, to see that everything runs; the numbers then mean nothing.
        threads: torch threads; null for one per core.
        processes: simulators that run side by side.
        rounds: times that each workload is timed; null for the default.
        json: file for the numbers.
    """
    from ugr_lightning.cli.bench import PARTS, run_bench

    path = None if json is None else Path(json)
    return run_bench(
        sys.stdout,
        parts=parts or PARTS,
        quick=quick,
        threads=threads,
        processes=processes,
        rounds=rounds,
        json_path=path,
    )


FUNCTIONS: dict[str, Callable[..., int]] = {
    "collect": _collect,
    "rollout": _rollout,
    "test": _test,
    "tasks": _tasks,
    "doctor": _doctor,
    "bench": _bench,
}


def run(command: str, argv: Sequence[str]) -> int:
    """Run one of the subcommands above."""
    return call(FUNCTIONS[command], command, argv)
