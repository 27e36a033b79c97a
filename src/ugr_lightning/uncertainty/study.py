"""What `ugr analyze` finds about one checkpoint: numbers, tables, figures and sentences, and the folder they go to."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.errors import ConfigError, DataError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.refine.budget import with_refine_ratio
from ugr_lightning.results.tables import Cells, as_markdown, as_text
from ugr_lightning.rollout.overlap import action_unit
from ugr_lightning.rollout.traces import read_traces
from ugr_lightning.system.files import publish, publish_text
from ugr_lightning.uncertainty import calibration_report as report
from ugr_lightning.uncertainty.budgets import sweep, sweep_figure, sweep_table
from ugr_lightning.uncertainty.calibration_figures import calibration_figure, event_figure
from ugr_lightning.uncertainty.estimators import estimator_table, overlapping
from ugr_lightning.uncertainty.events import KINDS, find_events
from ugr_lightning.uncertainty.failure import Alarms, Score, detect_failures, overlap_score, uncertainty_score
from ugr_lightning.uncertainty.foretold import foretold, foretold_table
from ugr_lightning.uncertainty.predictions import Predictions, predict
from ugr_lightning.uncertainty.sight import sight_of_keyframes, sight_table


@dataclass
class Study:
    """What has been predicted and found so far; extras add to the last four.

    Args:
        policy: from the checkpoint.
        data: its demonstrations, with its own split.
        validation, training: its predictions on both parts.
        stride: control steps between two queries.
        resamples: draws of the bootstrap over episodes.
        budget: steps of a chunk that count as the worst ones, M.
        content: numbers, for `analysis.json`.
        tables: cells, heading first.
        figures: by the name of their file.
        sentences: what is said below the tables; the verdict comes first.
    """

    policy: ChunkPolicy
    data: ChunkDataModule
    validation: Predictions
    training: Predictions
    stride: int
    resamples: int
    budget: int
    content: dict[str, Any]
    tables: list[Cells] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    sentences: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return "\n\n".join([*map(as_text, self.tables), *self.sentences])

    def write(self, folder: Path) -> None:
        """Write `analysis.json`, `analysis.md` and the figures."""
        title = f"Uncertainty of {self.content['checkpoint']['file']}"
        write_page(folder, "analysis", title, self.sentences, self.tables, self.figures, self.content)


def write_page(
    folder: Path,
    name: str,
    title: str,
    sentences: Sequence[str],
    tables: Sequence[Cells],
    figures: dict[str, Any],
    content: dict[str, Any],
) -> None:
    """Write `<name>.md`, `<name>.json` and the figures into a folder.

    Args:
        folder: made if missing.
        name: of the files.
        title: heading of the page.
        sentences: what the page says first.
        tables: cells, heading first.
        figures: by the name of their file.
        content: numbers.
    """
    pictures = [f"![{figure}]({figure}.png)" for figure in figures]
    page = "\n\n".join([f"# {title}", *sentences, *map(as_markdown, tables), *pictures])
    numbers = json.dumps(plain_json(content), indent=1, allow_nan=False)
    for file, text in ((f"{name}.json", numbers), (f"{name}.md", page)):
        publish_text(folder / file, text + "\n")
    for file, figure in figures.items():
        publish(folder / f"{file}.png", partial(figure.savefig, format="png", dpi=120))


def begin_study(
    policy: ChunkPolicy, data: ChunkDataModule, checkpoint: dict[str, str], *, stride: int, resamples: int
) -> Study:
    """Predict on both parts of the split; compare s_k with the error and with the prior; say how keyframes are seen.

    Each where the policy has them.

    Args:
        policy: from the checkpoint.
        data: its demonstrations, after `setup`.
        checkpoint: its `file`, `sha256` and `task`.
        stride: control steps between two queries.
        resamples: draws of the bootstrap over episodes.
    """
    fast, split = policy.for_inference(), data.episode_split
    validation, training = (predict(fast, data, part, stride=stride) for part in (split.validation, split.train))
    budget = getattr(policy, "budget", None) or int(0.3 * policy.chunk_length)
    content: dict[str, Any] = {
        "checkpoint": checkpoint,
        "validation": {"episodes": len(split.validation), "chunks": len(validation.step)},
        "settings": {"stride": stride, "after_end": data.after_end, "resamples": resamples, "budget": budget},
    }
    study = Study(policy, data, validation, training, stride, resamples, budget, content)
    if validation.log_variance is None:
        errors = [float(np.nanmean(part.executed)) for part in (training, validation)]
        study.content["mean error"] = dict(zip(("training", "validation"), errors, strict=True))
        study.sentences.append(
            f"The policy predicts no s_k (`uncertainty_head: true` trains one). Its mean error is {errors[0]:.3g} on "
            f"training and {errors[1]:.3g} on validation episodes, length over all joints, in standard deviations."
        )
    else:
        _add_calibration(study)
    if sight := sight_of_keyframes(validation, training):
        study.content["sight"] = sight
        study.tables.append(sight_table(sight))
    return study


def _add_calibration(study: Study) -> None:
    """Add how well s_k ranks errors, covers them, and knows events."""
    validation, training, budget = study.validation, study.training, study.budget
    rows = report.compare_with_prior(validation, training, budget, study.resamples)
    verdict = report.calibration_verdict(rows, len(study.data.episode_split.validation), budget)
    found, seen = report.curves(validation, training), report.generalisation(validation, training, budget)
    events = report.around_events(validation, study.data.demonstrations, study.resamples)
    study.tables += [report.table(rows), report.generalisation_table(seen)]
    study.tables += [report.coverage_table(found), report.event_table(events)]
    study.figures |= {"calibration": calibration_figure(found), **({"events": event_figure(events)} if events else {})}
    statistics = [row._asdict() for row in rows]
    study.content |= {"verdict": verdict, "statistics": statistics, "generalisation": seen, "events": events, **found}
    study.sentences.append(verdict)
    demonstrations = study.data.demonstrations
    if unknown := [kind for kind in KINDS if not any(kind in find_events(each) for each in demonstrations)]:
        study.sentences.append(f"The demonstrations do not tell of these events: {', '.join(unknown)}.")


def _require_uncertainty(study: Study, option: str) -> None:
    if study.validation.log_variance is None:
        fix = "Train with `refine` Uncertainty, or with `uncertainty_head: true`."
        raise ConfigError(option, "a policy with a log-variance per step", "one without", fix)


def add_budgets(study: Study) -> None:
    """Add the error when from none to all of the steps are refined.

    Raises:
        ConfigError: the policy has no s_k to choose them by.
    """
    _require_uncertainty(study, "--budgets")
    whole = with_refine_ratio(study.policy, 1.0).for_inference()
    everything = predict(whole, study.data, study.data.episode_split.validation, stride=study.stride)
    found = sweep(everything, study.training.coarse, resamples=study.resamples)
    study.content["budgets"] = found
    study.tables.append(sweep_table(found))
    study.figures["budgets"] = sweep_figure(found)


def add_estimators(study: Study) -> None:
    """Add another estimate of the uncertainty: overlapping chunks.

    Raises:
        ConfigError: the policy has no s_k to compare it with, or its chunks do not overlap.
    """
    _require_uncertainty(study, "--estimators")
    if study.stride >= study.policy.chunk_length:
        expected = f"chunks of {study.policy.chunk_length} steps that overlap"
        raise ConfigError("--estimators", expected, f"one every {study.stride} steps", "Lower --stride.")
    overlap = overlapping(study.policy, study.data, study.data.episode_split.validation, stride=study.stride)
    table = estimator_table(study.validation, {"overlapping chunks": overlap}, study.budget)
    study.content["estimators"] = table
    study.tables.append(table)


def add_foretold(study: Study) -> None:
    """Add how much of the error on new scenes a branch could take away."""
    assert isinstance(study.policy, ACT)
    found = foretold(study.policy, study.data, stride=study.stride, resamples=study.resamples)
    study.content["foretold"] = found
    study.tables.append(foretold_table(found))


def add_failures(study: Study, folder: Path) -> None:
    """Add whether s_k, or chunks that disagree, warned before episodes failed, for each execution with traces.

    Args:
        study: of the checkpoint.
        folder: what `ugr rollout --traces` filled.

    Raises:
        DataError: there are none.
    """
    groups: dict[str, list[Path]] = {}
    for path in sorted(folder.glob(f"*-{study.content['checkpoint']['sha256'][:8]}-*.npz")):
        groups.setdefault(path.stem.rpartition("-")[0], []).append(path)
    if not groups:
        fix = "Make some with `ugr rollout CHECKPOINT --seeds selection --traces FOLDER`."
        raise DataError(folder, "traces of this checkpoint", "none", fix)
    overlap = overlap_score(action_unit(study.policy))
    scores: dict[str, Score] = {"s_k": uncertainty_score, "overlapping chunks": overlap}
    if study.validation.log_variance is None:
        del scores["s_k"]
    found: dict[str, Alarms] = {}
    for name, paths in groups.items():
        episodes = read_traces(paths)
        try:
            found |= {f"{name}, {by}": detect_failures(episodes, score) for by, score in scores.items()}
        except DataError as error:  # of one execution: what is known of the others stays
            study.sentences.append(f"{name}: {error}")
    study.content["failures"] = found
    study.sentences += [f"{name}: {alarms}" for name, alarms in found.items()]


def plain_json(value: Any) -> Any:
    """Plain containers for JSON; numbers that are not finite become null.

    Args:
        value: numbers, arrays, named tuples and containers of them.
    """
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {str(key): plain_json(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
