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
from ugr_lightning.errors import ConfigError
from ugr_lightning.results.results import EpisodeResult
from ugr_lightning.training.runs import resolve_checkpoint

if TYPE_CHECKING:
    from ugr_lightning.contract import ChunkPolicy

VARIANCE: Literal["aggregate-variance"] = "aggregate-variance"


def _sweep(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    seeds: Literal["evaluation", "selection"] | int = "selection",
    episodes: Count = 100,
    ratios: list[float] | None = None,
    executions: list[ExecutionName] | None = None,
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
        ratios: budgets as shares of the chunk; 0 and the one of the training are added; null means tenths from 0 to 1,
            `[]` leaves budgets out, for policies that do not rank steps.
        executions: each `aggregate`, `aggregate-variance`, or the number of steps executed of each chunk;
            budgets are compared in the first, the others with it. Null means all that the policy can, 25 steps of them.
        data: folder of the recordings that the policy was trained on (`data.root`, or `data.folder` if it had one),
            for the offline error; `own` is what `config.yaml` beside the checkpoint names, null leaves the error out.
        stride: control steps between two queries of the offline error.
        workers: simulator processes.
        device: where the policy computes in closed loop: `auto` is the GPU where there is one; or `cpu`, `cuda:1`.
        out: folder for episodes, tables and figure; null means `sweep-<checkpoint>` beside the checkpoint.
        shard: `3/8` is the third of eight processes that share the episodes and the folder; it only runs those of its
            part. `1/1` runs what is missing afterwards, and writes the tables.
    """
    from ugr_lightning.system.files import remove_unfinished
    from ugr_lightning.system.lock import locked

    part = every_nth(shard)
    alone = part.step == 1
    file = resolve_checkpoint(checkpoint, run, root)
    plan = _plan(file, ratios, executions)
    print(f"checkpoint: {file}")
    errors = _offline(plan, data, stride) if alone and plan.ratios and data is not None else None
    folder = Path(out) if out else file.with_name(f"sweep-{file.stem}")
    with locked(folder / "sweep.lock", str(folder), shared=not alone):
        budgets, modes = _closed_loop(plan, folder / "episodes.jsonl", seeds, episodes, part, workers, device)
        if alone:
            remove_unfinished(folder)
            _report(plan, budgets, modes, errors, folder)
    return 0


run = partial(call, _sweep, leading=["checkpoint"])


class SweepPlan(NamedTuple):
    """What is to be tried.

    Args:
        checkpoint: its file.
        policy: from the checkpoint.
        info: what the checkpoint says about itself.
        trained: share of a chunk that it refines as trained; None where it ranks no steps.
        ratios: budgets, 0 first; empty where none are asked for.
        executions: the first is that of the budgets.
    """

    checkpoint: Path
    policy: "ChunkPolicy"
    info: Any
    trained: float | None
    ratios: list[float]
    executions: list[ExecutionName]


def _plan(checkpoint: Path, ratios: list[float] | None, executions: list[ExecutionName] | None) -> SweepPlan:
    """What is asked for, once it is clear that the policy can do all of it."""
    from ugr_lightning.bridges.export import made_up_observation
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.models.refine.budget import with_refine_ratio
    from ugr_lightning.rollout.aggregation import make_execution
    from ugr_lightning.uncertainty.budgets import RATIOS

    policy, info = load_policy(checkpoint)
    wanted = list(RATIOS) if ratios is None else ratios
    for ratio in wanted:
        with_refine_ratio(policy, ratio)
    trained: Any = getattr(getattr(policy, "refine", None), "ratio", None)
    tried: list[float] = sorted({0.0, trained, *wanted}) if wanted else []
    seen = made_up_observation(policy, info.data.get("image_size") or (120, 160), samples=1)
    certain = policy.predict(seen).log_variance is not None
    first, *others = both_executions(policy)
    weighted: list[ExecutionName] = [VARIANCE] if certain else []
    chosen = executions or [first, *weighted, *others]
    for execution in chosen:
        make_execution(execution, policy.chunk_length)
    if VARIANCE in chosen and not certain:
        fix = "Leave it out, or train with `uncertainty_head: true`."
        raise ConfigError(f"--executions {VARIANCE}", "a policy with a log-variance per step", "one without", fix)
    return SweepPlan(checkpoint, policy, info, trained, tried, list(dict.fromkeys(chosen)))


def _offline(plan: SweepPlan, data: str, stride: int) -> list[Any]:
    """The error of each budget on the validation episodes."""
    from ugr_lightning.models.refine.budget import with_refine_ratio
    from ugr_lightning.uncertainty.budgets import budget_errors
    from ugr_lightning.uncertainty.predictions import predict

    opened = open_own(plan.policy, plan.info, data)
    whole = with_refine_ratio(plan.policy, 1.0).for_inference()
    everything = predict(whole, opened, opened.episode_split.validation, stride=stride)
    return budget_errors(plan.policy, everything, plan.ratios)


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
    from ugr_lightning.rollout.evaluate import checkpoint_actor, evaluation_spec, run_episodes
    from ugr_lightning.rollout.simulators import Simulators
    from ugr_lightning.uncertainty.closed_loop import budget_name, execution_name

    spec = evaluation_spec(plan.info.data, None, seeds, episodes, workers=workers, out=file, resume=True)
    mine = part_of(spec, part)
    if mine is None:
        return {}, {}
    with Simulators() as simulators:

        def act(ratio: float | None, execution: ExecutionName) -> list[EpisodeResult]:
            changed = None if ratio == plan.trained else ratio
            actor = checkpoint_actor(plan.policy, plan.info, mine.task, refine_ratio=changed, device=device)
            return run_episodes(actor, replace(mine, execution=execution), simulators=simulators)

        modes: Episodes = {execution_name(execution): act(None, execution) for execution in plan.executions}
        budgets: Episodes = {budget_name(ratio, plan.trained): act(ratio, plan.executions[0]) for ratio in plan.ratios}
    return budgets, modes


def _report(plan: SweepPlan, budgets: Episodes, modes: Episodes, errors: list[Any] | None, folder: Path) -> None:
    """Print and write what was found."""
    from ugr_lightning.results.tables import as_text
    from ugr_lightning.uncertainty import closed_loop as kit
    from ugr_lightning.uncertainty.study import write_page

    tables, figures, sentences = [], {}, []
    content: dict[str, Any] = {"checkpoint": {"file": str(plan.checkpoint), "sha256": plan.info.sha256}}
    if budgets:
        uses = kit.compare_uses(budgets)
        steps = [int(ratio * plan.policy.chunk_length + 1e-9) for ratio in plan.ratios]
        tables.append(kit.budget_table(uses, steps, errors))
        figures["budgets"] = kit.budget_figure(uses, plan.ratios, errors)
        sentences.append(f"Budgets, {kit.execution_name(plan.executions[0])}. {kit.execution_verdict(uses, 'budget')}")
        content["budgets"] = {"ratios": plan.ratios, "steps": steps, "uses": kit.use_records(uses), "offline": errors}
    uses = kit.compare_uses(modes)
    tables.append(kit.execution_table(uses))
    sentences.append(f"Executions, budget as trained. {kit.execution_verdict(uses, 'execution')}")
    content["executions"] = kit.use_records(uses)
    print("\n\n".join([*map(as_text, tables), *sentences]))
    write_page(folder, "sweep", f"Uses of {plan.checkpoint}", sentences, tables, figures, content)
    print(f"episodes, numbers, tables and figure: {folder}")
