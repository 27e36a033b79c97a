"""`ugr rollout` and `ugr test`: let a policy act and count its successes."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.cli.parsing.shard import every_nth, part_of
from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.system.signals import Stopped
from ugr_lightning.training.runs import FILES, or_best, resolve_checkpoint

if TYPE_CHECKING:
    from ugr_lightning.contract import ChunkPolicy
    from ugr_lightning.results.results import EpisodeResult
    from ugr_lightning.rollout.actors import Actor
    from ugr_lightning.rollout.spec import RolloutSpec

ExecutionName = Literal["aggregate", "aggregate-variance"] | int
EXECUTED_STEPS = 25
"""Steps executed of each chunk, at most, where nothing else is asked for; half of a chunk of 50."""


def _rollout(
    checkpoint: str | None = None,
    policy: str | None = None,
    run: str | None = None,
    root: str = "runs",
    task: str | None = None,
    seeds: Literal["evaluation", "selection"] | int = "evaluation",
    episodes: int | None = None,
    execution: ExecutionName = "aggregate",
    setting: str | None = None,
    image_size: tuple[int, int] | None = None,
    workers: int = 2,
    video: str | None = None,
    out: str | None = None,
    traces: str | None = None,
    refine_ratio: float | None = None,
    device: str = "auto",
    resume: bool = False,
    shard: str | None = None,
) -> int:
    """Let a policy act in a task and count its successes.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or a folder from `ugr export --to safetensors`;
            null takes `best` of a `run` that is given.
        policy: without a checkpoint, who acts: `expert`, which null means, `zero` or `random`.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        task: a name from `ugr tasks`; null takes the task the checkpoint was trained on.
        seeds: `evaluation` (the task's fixed list), `selection` (for choices of a recipe), or the first seed.
        episodes: how many of those seeds; null means 100, or 1 where only a video is asked for.
        execution: `aggregate`; `aggregate-variance`, which aggregates with the inverse of the predicted variance; or
            the number of steps executed of each chunk.
        setting: `demo_clean` or `demo_randomized`; null takes the checkpoint's.
        image_size: height and width of the pictures; null takes the checkpoint's.
        workers: simulator processes.
        video: file for a film of the first episode, `.gif` or `.mp4`.
        out: results file, one JSON line per episode is appended.
        traces: folder for what was predicted in each episode, one `.npz` file each.
        refine_ratio: share of each chunk that is refined, 0 to 1, in place of the one in training.
        device: where the policy computes: `auto` is the GPU where there is one; or `cpu`, `cuda:1`.
        resume: run only the episodes that the results file lacks.
        shard: `3/8` is the third of eight processes that share the episodes and the results file; it runs what the file
            lacks of its part. `1/1` runs what is missing afterwards, and sums up all.
    """
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.rollout.actors import DUMMIES
    from ugr_lightning.rollout.evaluate import checkpoint_actor, evaluation_spec, run_episodes

    checkpoint = or_best(checkpoint, run)
    if policy not in (None, *DUMMIES):
        fix = "A checkpoint comes first or behind --checkpoint: `ugr rollout FILE`."
        raise ConfigError("--policy", f"one of {', '.join(DUMMIES)}", policy, fix)
    if checkpoint is None and refine_ratio is not None:
        fix = "Give one by --checkpoint."
        raise ConfigError("--refine_ratio", "a checkpoint to refine less or more", "none", fix)
    if checkpoint is not None and policy is not None:
        raise ConfigError("--policy", "a checkpoint or one of these, not both", policy, "Leave one out.")
    if shard is not None and out is None:
        fix = "Give all of them the same `--out FILE`."
        raise ConfigError("--shard", "a results file that the shards share", "none", fix)
    if resume and out is None:
        raise ConfigError("--resume", "the results file of the start before", "none", "Give its `--out FILE`.")
    part = every_nth(shard)
    loaded = None if checkpoint is None else load_policy(resolve_checkpoint(checkpoint, run, root))
    spec = evaluation_spec(
        loaded[1].data if loaded else {},
        task,
        seeds,
        episodes if episodes is not None else 1 if video and not out else 100,
        execution=execution,
        setting=setting,
        image_size=image_size,
        workers=workers,
        out=Path(out) if out else None,
        traces=Path(traces) if traces else None,
        resume=resume or shard is not None,
    )
    if video:
        spec = replace(spec, videos={spec.seeds[0]: Path(video)})
    mine = part_of(spec, part)
    if mine is None:
        return 0
    actor = (
        checkpoint_actor(*loaded, spec.task, refine_ratio=refine_ratio, device=device) if loaded else policy or "expert"
    )
    if loaded:
        _warn_of_other_conditions(mine, loaded[1].data)
    with _noting(mine.out):
        results = run_episodes(actor, mine)
    if video and results[0].seed in spec.videos:
        print(f"video: {results[0].video or 'none: its episode was in the results file already, or has crashed'}")
    return _tell(results, actor)


@contextmanager
def _noting(out: Path | None) -> Iterator[None]:
    """Say, where episodes are kept and a signal ends their run, how the rest of them is run."""
    try:
        yield
    except Stopped as stop:
        stop.note = "" if out is None else "(`--resume` runs the other episodes)"
        raise


def _warn_of_other_conditions(spec: "RolloutSpec", data: Mapping[str, Any]) -> None:
    """A policy that sees other pictures than in training, or the scenes of its training."""
    from ugr_lightning.sim.seeds import EVALUATION_START

    if (size := data.get("image_size")) and tuple(size) != spec.image_size:
        seen = "x".join(map(str, spec.image_size))
        warnings.warn(f"The policy was trained on pictures of {size[0]}x{size[1]}, not {seen}.", stacklevel=2)
    if spec.seeds[0] < EVALUATION_START:
        warnings.warn(
            f"Seeds below {EVALUATION_START} are those of demonstrations: success on scenes that a policy was shown "
            "says nothing about new ones. Leave `--seeds` out, or give `selection`.",
            stacklevel=2,
        )


def _test(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    task: str | None = None,
    episodes: int = 100,
    executions: list[ExecutionName] | None = None,
    workers: int = 2,
    out: str | None = None,
    traces: str | None = None,
    refine_ratio: float | None = None,
    device: str = "auto",
    resume: bool = False,
    shard: str | None = None,
) -> int:
    """Success of a checkpoint on the task's evaluation seeds, with aggregated chunks and with executed ones.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or a folder from `ugr export --to safetensors`.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        task: a name from `ugr tasks`; null takes the task the checkpoint was trained on.
        episodes: how many of the 100 evaluation seeds.
        executions: each `aggregate`, `aggregate-variance`, or the number of steps executed of each chunk;
            null means `aggregate` and 25, or the whole chunk where it is shorter.
        workers: simulator processes.
        out: results file; null appends to `evaluation.jsonl` beside a best checkpoint, `evaluation-<checkpoint>.jsonl`
            beside another.
        traces: folder for what was predicted in each episode, one `.npz` file each.
        refine_ratio: share of each chunk that is refined, 0 to 1, in place of the one in training.
        device: where the policy computes: `auto` is the GPU where there is one; or `cpu`, `cuda:1`.
        resume: run only the episodes that the results file lacks.
        shard: `3/8` is the third of eight processes that share the episodes and the results file; it runs what the file
            lacks of its part. `1/1` runs what is missing afterwards, and sums up all.
    """
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.rollout.evaluate import checkpoint_actor, evaluation_spec, run_episodes
    from ugr_lightning.rollout.simulators import Simulators

    part = every_nth(shard)
    file = resolve_checkpoint(checkpoint, run, root)
    print(f"checkpoint: {file}")
    policy, info = load_policy(file)
    spec = evaluation_spec(
        info.data,
        task,
        "evaluation",
        episodes,
        workers=workers,
        out=Path(out) if out else _results_of(file),
        traces=Path(traces) if traces else None,
        resume=resume or shard is not None,
    )
    mine = part_of(spec, part)
    if mine is None:
        return 0
    actor = checkpoint_actor(policy, info, spec.task, refine_ratio=refine_ratio, device=device)
    results = []
    with Simulators() as simulators, _noting(spec.out):
        for execution in executions or both_executions(policy):
            results += run_episodes(actor, replace(mine, execution=execution), simulators=simulators)
    print(f"episodes: {spec.out}")
    return _tell(results, actor)


def _tell(results: Sequence["EpisodeResult"], actor: "Actor | str") -> int:
    """Print the table, and what came of alarms; one in which every episode has crashed is no result."""
    from ugr_lightning.results.results import success_table
    from ugr_lightning.rollout.alarm import alarm_report

    print(success_table(results))
    for alarm in getattr(actor, "alarms", {}).values():
        if any(item.alarm_rate is not None and item.execution == alarm.execution for item in results):
            print(alarm_report(alarm, results))
    if all(result.crash is not None for result in results):
        got = f"{len(results)} that crashed, the first with: {results[0].crash}"
        fix = "Mend what it names; where that is the simulator, `ugr doctor` checks it."
        raise SimulationError("episodes", "at least one that comes to its end", got, fix)
    return 0


def _results_of(checkpoint: Path) -> Path:
    """Each checkpoint of a run has a results file of its own: a report compares policies, one a file."""
    if checkpoint.is_dir():
        return checkpoint / "evaluation.jsonl"
    return checkpoint.with_name(
        "evaluation.jsonl" if checkpoint.name == FILES["best"] else f"evaluation-{checkpoint.stem}.jsonl"
    )


def both_executions(policy: "ChunkPolicy") -> list[ExecutionName]:
    """Aggregation, and 25 steps of each chunk or the whole of it where it is shorter."""
    return ["aggregate", min(EXECUTED_STEPS, policy.chunk_length)]


FUNCTIONS: dict[str, Callable[..., int]] = {"rollout": _rollout, "test": _test}


def run(command: str, argv: Sequence[str]) -> int:
    """Run one of the subcommands above."""
    return call(FUNCTIONS[command], command, argv, ["checkpoint"])
