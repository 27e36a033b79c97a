"""`ugr sweep`: one checkpoint with many refinement budgets and several executions, in closed loop."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ugr_lightning.cli.parsing.call import Count, call
from ugr_lightning.cli.parsing.data import OWN, open_own
from ugr_lightning.cli.parsing.shard import every_nth, part_of
from ugr_lightning.cli.rollout import ExecutionName, both_executions
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.results.results import EpisodeResult
from ugr_lightning.training.runs import resolve_checkpoint

if TYPE_CHECKING:
    from ugr_lightning.contract import ChunkPolicy
    from ugr_lightning.rollout.actors import PolicyActor

VARIANCE: Literal["aggregate-variance"] = "aggregate-variance"


def _sweep(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    seeds: Literal["evaluation", "selection"] | int = "selection",
    episodes: Count = 100,
    ratios: list[float] | None = None,
    executions: list[ExecutionName] | None = None,
    teacher: str | None = None,
    data: str | None = OWN,
    stride: Count = 5,
    workers: int = 2,
    device: str = "auto",
    out: str | None = None,
    shard: str | None = None,
) -> int:
    """Success of one checkpoint by refinement budget and by execution, on the same seeds; goes on where it was stopped.

    Args:
        checkpoint: `best`, `best_loss`, `last`, a checkpoint file, or a folder from `ugr export --to safetensors`.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        seeds: `selection` (a budget may be chosen by them), `evaluation` (only to report), or the first seed.
        episodes: how many of those seeds, for each budget and for each execution.
        ratios: budgets as shares of the chunk; 0 and the one of the training are added, with a teacher 0 and 1; null
            means tenths from 0 to 1, `[]` leaves budgets out, for policies that do not rank steps.
        executions: each `aggregate`, `aggregate-variance`, or the number of steps executed of each chunk;
            budgets are compared in the first, the others with it. Null means all that the policy can, 25 steps of them.
        teacher: checkpoint file of a better policy, whose actions then take the place of those that would be refined,
            of the least certain steps, of scattered ones and of the first: the ceiling of what refining so many could
            give, in the first of the executions.
        data: folder of the recordings that the policy was trained on (`data.root`, or `data.folder` if it had one),
            for the offline error; `own` is what `config.yaml` beside the checkpoint names, null leaves the error out.
        stride: control steps between two queries of the offline error.
        workers: simulator processes.
        device: where the policy computes in closed loop: `auto` is the GPU where there is one; or `cpu`, `cuda:1`.
        out: folder for episodes, tables and figure; null means `sweep-<checkpoint>` beside the checkpoint, and
            `ceiling-<checkpoint>` with a teacher.
        shard: `3/8` is the third of eight processes that share the episodes and the folder; it only runs those of its
            part. `1/1` runs what is missing afterwards, and writes the tables.
    """
    from ugr_lightning.system.files import remove_unfinished
    from ugr_lightning.system.lock import locked

    part = every_nth(shard)
    alone = part.step == 1
    file = resolve_checkpoint(checkpoint, run, root)
    plan = _plan(file, ratios, executions, teacher)
    print(f"checkpoint: {file}")
    offline = alone and plan.budgets and data is not None and plan.teacher is None
    errors = _offline(plan, str(data), stride) if offline else None
    kind = "sweep" if plan.teacher is None else "ceiling"
    folder = Path(out) if out else file.with_name(f"{kind}-{file.stem}")
    with locked(folder / "sweep.lock", str(folder), shared=not alone):
        budgets, modes = _closed_loop(plan, folder / "episodes.jsonl", seeds, episodes, part, workers, device)
        if alone:
            remove_unfinished(folder)
            _report(plan, budgets, modes, errors, folder)
    return 0


run = partial(call, _sweep, leading=["checkpoint"])


class Trial(NamedTuple):
    """One way of using the checkpoint.

    Args:
        name: what the tables call it.
        execution: how its chunks are executed.
        ratio: share of each chunk that is refined, where that is not as trained.
        rule: by which the teacher takes over that share; None where the policy refines by itself.
    """

    name: str
    execution: ExecutionName
    ratio: float | None = None
    rule: str | None = None


class SweepPlan(NamedTuple):
    """What is to be tried.

    Args:
        checkpoint: its file.
        policy: from the checkpoint.
        info: what the checkpoint says about itself.
        budgets: the coarse policy first; none where none are asked for.
        executions: that of the budgets first; none with a teacher.
        teacher: a better policy and what its checkpoint says, or None.
    """

    checkpoint: Path
    policy: "ChunkPolicy"
    info: Any
    budgets: list[Trial]
    executions: list[Trial]
    teacher: "tuple[ChunkPolicy, Any] | None" = None


def _plan(
    checkpoint: Path, ratios: list[float] | None, executions: list[ExecutionName] | None, teacher: str | None
) -> SweepPlan:
    """What is asked for, once it is clear that the policy can do all of it."""
    from ugr_lightning.bridges.export import made_up_observation
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.models.refine.budget import with_refine_ratio
    from ugr_lightning.rollout.aggregation import make_execution
    from ugr_lightning.uncertainty.budgets import RATIOS
    from ugr_lightning.uncertainty.closed_loop import budget_name, execution_name

    policy, info = load_policy(checkpoint)
    wanted = list(RATIOS) if ratios is None else ratios
    for ratio in wanted:
        with_refine_ratio(policy, ratio)
    trained: Any = getattr(getattr(policy, "refine", None), "ratio", None)
    seen = made_up_observation(policy, info.data.get("image_size") or (120, 160), samples=1)
    certain = policy.predict(seen).log_variance is not None
    first, *others = both_executions(policy)
    weighted: list[ExecutionName] = [VARIANCE] if certain else []
    chosen = list(dict.fromkeys(executions or [first, *weighted, *others]))
    for execution in chosen:
        make_execution(execution, policy.chunk_length)
    if VARIANCE in chosen and not certain:
        fix = "Leave it out, or train with `uncertainty_head: true`."
        raise ConfigError(f"--executions {VARIANCE}", "a policy with a log-variance per step", "one without", fix)
    tried = sorted({0.0, trained, *wanted}) if wanted else []
    if teacher is not None and not certain:
        fix = "Take a student that was trained with `uncertainty_head: true`."
        raise ConfigError("--teacher", "a student with a log-variance per step", "one without", fix)
    if teacher is not None:
        trials = _ceilings(sorted(set(wanted)), policy.chunk_length, chosen[0])
        return SweepPlan(checkpoint, policy, info, trials, [], _taught_by(teacher, policy, info))
    budgets = [Trial(budget_name(r, trained), chosen[0], None if r == trained else r) for r in tried]
    return SweepPlan(checkpoint, policy, info, budgets, [Trial(execution_name(how), how) for how in chosen])


def _ceilings(ratios: list[float], chunk_length: int, execution: ExecutionName) -> list[Trial]:
    """Nothing, each share chosen by each rule, and everything."""
    from ugr_lightning.uncertainty.closed_loop import budget_name
    from ugr_lightning.uncertainty.taught import RULES

    if not any(ratios):
        raise ConfigError("--ratios", "shares for the teacher to take over", "none", "Give some, e.g. `[0.3]`.")
    for share in filter(None, ratios):
        RULES["first"](share).budget(chunk_length)
    some = [Trial(f"{100 * r:g}%, {rule}", execution, r, rule) for r in ratios if 0 < r < 1 for rule in RULES]
    return [Trial(budget_name(0, None), execution, 0.0), *some, Trial("100%", execution, 1.0, "first")]


def _taught_by(teacher: str, policy: "ChunkPolicy", info: Any) -> "tuple[ChunkPolicy, Any]":
    """The teacher, if it sees what the policy sees."""
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.uncertainty.taught import RULES, Taught

    loaded, known = load_policy(Path(teacher).expanduser())
    Taught(policy, loaded, RULES["first"](1.0))
    for name in ("image_size", "state", "control_hz"):
        ours, other = (about.data.get(name) for about in (info, known))
        if None not in (ours, other) and ours != other:
            fix = "Train both on the same demonstrations, with the same of these."
            raise ConfigError(f"--teacher, its {name}", f"that of the checkpoint, {ours}", other, fix)
    return loaded, known


def _actor(plan: SweepPlan, trial: Trial, task: str, device: str) -> "PolicyActor":
    from ugr_lightning.models.refine.budget import with_refine_ratio
    from ugr_lightning.rollout.evaluate import checkpoint_actor
    from ugr_lightning.uncertainty.taught import RULES, Taught

    if trial.rule is None or trial.ratio is None or plan.teacher is None:
        return checkpoint_actor(plan.policy, plan.info, task, refine_ratio=trial.ratio, device=device)
    teacher, about = plan.teacher
    taught = Taught(with_refine_ratio(plan.policy, 0), teacher, RULES[trial.rule](trial.ratio))
    actor = checkpoint_actor(taught, plan.info, task, device=device)
    actor.name = f"{type(plan.policy).__name__}({trial.name}: {about.sha256[:12]})"
    actor.refine_ratio = trial.ratio
    return actor


def _offline(plan: SweepPlan, data: str, stride: int) -> list[Any]:
    """The error of each budget on the validation episodes."""
    from ugr_lightning.models.refine.budget import with_refine_ratio
    from ugr_lightning.uncertainty.budgets import budget_errors
    from ugr_lightning.uncertainty.predictions import predict

    opened = open_own(plan.policy, plan.info, data)
    known = len(opened.episode_split.validation)
    if known < 2:
        fix = "Leave the offline error out with `--data null`, or train on more demonstrations."
        raise DataError("the checkpoint's split", "at least 2 validation episodes for the error's interval", known, fix)
    whole = with_refine_ratio(plan.policy, 1.0).for_inference()
    everything = predict(whole, opened, opened.episode_split.validation, stride=stride)
    return budget_errors(plan.policy, everything, [_share(plan, trial) for trial in plan.budgets])


def _share(plan: SweepPlan, trial: Trial) -> float:
    """Of each chunk, what is refined."""
    refine: Any = getattr(plan.policy, "refine", None)
    return float(refine.ratio if trial.ratio is None else trial.ratio)


Episodes = dict[str, Sequence[EpisodeResult]]


def _closed_loop(
    plan: SweepPlan,
    file: Path,
    seeds: Literal["evaluation", "selection"] | int,
    episodes: int,
    part: slice,
    workers: int,
    device: str,
) -> tuple[Episodes, Episodes]:
    """Episodes by name of the budget and by name of the execution; only those that the file lacks are run."""
    from ugr_lightning.rollout.evaluate import evaluation_spec, run_episodes
    from ugr_lightning.rollout.simulators import Simulators

    spec = evaluation_spec(plan.info.data, None, seeds, episodes, workers=workers, out=file, resume=True)
    mine = part_of(spec, part)
    if mine is None:
        return {}, {}
    with Simulators() as simulators:

        def act(trial: Trial) -> list[EpisodeResult]:
            actor = _actor(plan, trial, mine.task, device)
            return run_episodes(actor, replace(mine, execution=trial.execution), simulators=simulators)

        modes: Episodes = {trial.name: act(trial) for trial in plan.executions}
        budgets: Episodes = {trial.name: act(trial) for trial in plan.budgets}
    return budgets, modes


def _report(plan: SweepPlan, budgets: Episodes, modes: Episodes, errors: list[Any] | None, folder: Path) -> None:
    """Print and write what was found."""
    from ugr_lightning.results.tables import as_text
    from ugr_lightning.uncertainty import closed_loop as kit
    from ugr_lightning.uncertainty.study import write_page

    tables, figures, sentences = [], {}, []
    content: dict[str, Any] = {"checkpoint": {"file": str(plan.checkpoint), "sha256": plan.info.sha256}}
    if budgets:
        uses, ratios = kit.compare_uses(budgets), [_share(plan, trial) for trial in plan.budgets]
        steps = [int(ratio * plan.policy.chunk_length + 1e-9) for ratio in ratios]
        tables.append(kit.budget_table(uses, steps, errors))
        what = f"Budgets, {kit.execution_name(plan.budgets[0].execution)}."
        if plan.teacher is None:
            figures["budgets"] = kit.budget_figure(uses, ratios, errors)
        else:
            content["teacher"] = {"file": str(plan.teacher[1].path), "sha256": plan.teacher[1].sha256}
            what += f" The teacher in their steps is {plan.teacher[1].path}."
        sentences.append(f"{what} {kit.execution_verdict(uses, 'budget')}")
        content["budgets"] = {"ratios": ratios, "steps": steps, "uses": kit.use_records(uses), "offline": errors}
    if modes:
        uses = kit.compare_uses(modes)
        tables.append(kit.execution_table(uses))
        sentences.append(f"Executions, budget as trained. {kit.execution_verdict(uses, 'execution')}")
        content["executions"] = kit.use_records(uses)
    print("\n\n".join([*map(as_text, tables), *sentences]))
    write_page(folder, "sweep", f"Uses of {plan.checkpoint}", sentences, tables, figures, content)
    print(f"episodes, numbers, tables{' and figure' if figures else ''}: {folder}")
