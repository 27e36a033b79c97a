"""`ugr analyze`: whether a checkpoint's uncertainty knows the error."""

import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ugr_lightning.errors import CheckpointError, ConfigError, DataError


def run(command: str, argv: Sequence[str]) -> int:
    """Run `ugr analyze`."""
    from ugr_lightning.cli.call import call

    if argv and not argv[0].startswith("-"):  # `ugr analyze CKPT`
        argv = ["--ckpt_path", *argv]
    return call(_analyze, command, argv)


def _analyze(
    ckpt_path: str = "best",
    run: str | None = None,
    root: str = "runs",
    data: str = "data/160x120",
    stride: int = 5,
    after_end: Literal["mask", "hold"] | None = None,
    resamples: int = 500,
    budgets: bool = False,
    estimators: bool = False,
    traces: str | None = None,
    out: str | None = None,
) -> int:
    """Say whether a policy's uncertainty knows the error, on the validation episodes of its own split.

    Args:
        ckpt_path: `best`, `best_loss`, `last`, or a checkpoint file.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        data: folder of the recordings that the policy was trained on.
        stride: control steps between two queries.
        after_end: count steps past the end of an episode (`hold`) or not (`mask`); null does as the training did.
        resamples: draws of the bootstrap over episodes.
        budgets: also the error when from none to all of the steps are refined, chosen by s_k and by its rivals.
        estimators: also other estimates of the uncertainty: MC dropout, sampled latents, overlapping chunks.
        traces: folder that `ugr rollout --traces` filled; says whether s_k warned before episodes failed.
        out: folder for tables, numbers and figures; null means `analysis-<checkpoint>` beside the checkpoint.
    """
    from ugr_lightning.analysis import calibration_report as report
    from ugr_lightning.analysis.calibration_figures import calibration_figure, event_figure
    from ugr_lightning.analysis.predictions import open_data, predict
    from ugr_lightning.cli.rollout import newest_run
    from ugr_lightning.cli.runs import resolve_checkpoint
    from ugr_lightning.training.checkpoint import load_policy

    for name, value in (("--stride", stride), ("--resamples", resamples)):
        if value < 1:
            raise ConfigError(name, "at least 1", value, "Correct the number.")
    checkpoint = resolve_checkpoint(ckpt_path, run or newest_run(Path(root)), Path(root))
    policy, info = load_policy(checkpoint)
    extras = [extra for wanted, extra in ((budgets, _budgets), (estimators, _estimators)) if wanted]
    for extra in extras:
        extra(policy, None)
    opened = open_data(policy, info.data, data, after_end)
    split, fast = opened.episode_split, policy.for_inference()
    validation = predict(fast, opened, split.validation, stride=stride)
    if validation.log_variance is None:
        fix = "Train with `refine` Uncertainty, or with `uncertainty_head: true`."
        raise CheckpointError(checkpoint, "a policy with a log-variance per step", "one without", fix)
    training = predict(fast, opened, split.train, stride=stride)
    budget = getattr(policy, "budget", None) or int(0.3 * policy.chunk_length)
    rows = report.compare_with_prior(validation, training, budget, resamples)
    sentence = report.verdict(rows, len(split.validation), budget)
    found, seen = report.curves(validation, training), report.generalisation(validation, training, budget)
    events = report.around_events(validation, opened.demonstrations, resamples)
    tables = [report.table(rows), report.generalisation_table(seen)]
    tables += [report.coverage_table(found), report.event_table(events)]
    figures = {"calibration": calibration_figure(found), **({"events": event_figure(events)} if events else {})}
    content = {
        "checkpoint": {"file": str(checkpoint), "sha256": info.sha256, "task": opened.task},
        "validation": {"episodes": len(split.validation), "chunks": len(validation.step)},
        "settings": {"stride": stride, "after_end": opened.after_end, "resamples": resamples, "budget": budget},
        "verdict": sentence,
        "statistics": [row._asdict() for row in rows],
        "generalisation": seen,
        "events": events,
        **found,
    }
    study = Study(opened, validation, training, stride, resamples, budget, content, tables, figures)
    for extra in extras:
        extra(policy, study)
    sentences = [sentence]
    if traces is not None:
        sentences += _failures(Path(traces), info.sha256, content)
    print(f"checkpoint: {checkpoint}")
    print("\n\n".join([*map(report.as_text, tables), *sentences]))
    folder = Path(out) if out else checkpoint.with_name(f"analysis-{checkpoint.stem}")
    _write(folder, content, sentences, tables, figures)
    print(f"numbers, tables and figures: {folder}")
    return 0


class Study(NamedTuple):
    """What has been predicted and found so far; extras add to the last three."""

    data: Any
    validation: Any
    training: Any
    stride: int
    resamples: int
    budget: int
    content: dict[str, Any]
    tables: list[list[tuple[str, ...]]]
    figures: dict[str, Any]


def _budgets(policy: Any, study: Study | None) -> None:
    """Add the sweep over budgets; without a study, only check that the policy can have others."""
    from ugr_lightning.analysis.budgets import sweep, sweep_figure, sweep_table
    from ugr_lightning.analysis.predictions import predict
    from ugr_lightning.models.refine.budget import with_refine_ratio

    whole = with_refine_ratio(policy, 1.0).for_inference()
    if study is None:
        return
    everything = predict(whole, study.data, study.data.episode_split.validation, stride=study.stride)
    found = sweep(everything, study.training.coarse, resamples=study.resamples)
    study.content["budgets"] = found
    study.tables.append(sweep_table(found))
    study.figures["budgets"] = sweep_figure(found)


def _estimators(policy: Any, study: Study | None) -> None:
    """Add other estimates of the uncertainty; without a study, only check that the policy can give them."""
    from ugr_lightning.analysis.estimators import estimate, estimator_table
    from ugr_lightning.models.act import ACT

    if not isinstance(policy, ACT):
        raise ConfigError("--estimators", "a policy of the class ACT", type(policy).__name__, "Leave it out.")
    if study is None:
        return
    estimates = estimate(policy, study.data, study.data.episode_split.validation, stride=study.stride)
    table = estimator_table(study.validation, estimates, study.budget)
    study.content["estimators"] = table
    study.tables.append(table)


def _failures(folder: Path, sha256: str, content: dict[str, Any]) -> list[str]:
    """One sentence on failure detection for each task and execution that has traces of this checkpoint."""
    from ugr_lightning.analysis.failure import detect_failures
    from ugr_lightning.rollout.traces import read_traces

    groups: dict[str, list[Path]] = {}
    for path in sorted(folder.glob(f"*-{sha256[:8]}-*.npz")):
        groups.setdefault(path.stem.rpartition("-")[0], []).append(path)
    if not groups:
        fix = "Make some with `ugr rollout --policy CKPT --seeds selection --traces FOLDER`."
        raise DataError(folder, "traces of this checkpoint", "none", fix)
    found = {name: detect_failures(read_traces(paths)) for name, paths in groups.items()}
    content["failures"] = found
    return [f"{name}: {alarms}" for name, alarms in found.items()]


def _write(
    folder: Path,
    content: dict[str, Any],
    sentences: list[str],
    tables: list[list[tuple[str, ...]]],
    figures: dict[str, Any],
) -> None:
    """Write `analysis.json`, `analysis.md`, `prior.json` (for the selector `Prior`) and the figures."""
    from ugr_lightning.analysis.calibration_report import as_markdown
    from ugr_lightning.data.folder import publish

    text = json.dumps(_plain(content), indent=1, allow_nan=False)
    prior = json.dumps(_plain(content["position"]["training_error"]))
    title = f"# Uncertainty of {content['checkpoint']['file']}"
    parts = [title, *sentences, *map(as_markdown, tables), *(f"![{name}]({name}.png)" for name in figures)]
    for name, written in (("analysis.json", text), ("prior.json", prior), ("analysis.md", "\n\n".join(parts))):
        publish(folder / name, partial(_write_text, written + "\n"))
    for name, figure in figures.items():
        publish(folder / f"{name}.png", partial(figure.savefig, format="png", dpi=120))


def _write_text(text: str, path: Path) -> None:
    path.write_text(text)


def _plain(value: Any) -> Any:
    """Plain containers for JSON; numbers that are not finite become null."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
