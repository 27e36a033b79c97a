"""Evaluations in a file that is small enough to keep in a repository: one JSON line per policy, task and execution."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ugr_lightning.errors import DataError
from ugr_lightning.results.evaluations import Evaluation, evaluated_runs, read_benchmark
from ugr_lightning.results.results import EpisodeResult
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.records import parse_json

SUMMARY_FILE = "summary.jsonl"
FIX = "Write the file again with `ugr report ... --out`, from the results it was made of."
TEXTS = ("policy", "task", "setting", "execution", "mode", "actor", "seeds_hash")


def read_evaluations(folder: str | Path) -> list[Evaluation]:
    """The evaluations of a benchmark's folder, or of a report's folder with a summary.

    A report may be written beside the results that it is of: these count then, not what they were that day.

    Raises:
        DataError: there are none, or a file is damaged; names the file and the line.
    """
    path = Path(folder) / SUMMARY_FILE
    return read_summary(path) if path.is_file() and not evaluated_runs(path.parent) else read_benchmark(folder)


def write_summary(evaluations: Iterable[Evaluation], path: Path) -> None:
    """Write what comparisons need of every episode: its seed, whether it succeeded, its steps, whether it crashed.

    Args:
        evaluations: any number, each of a known or unknown training seed.
        path: the file.
    """
    lines = []
    for item in evaluations:
        groups: dict[tuple[str, str, str], list[EpisodeResult]] = {}  # in the order in which they were run
        for result in item.results:
            groups.setdefault((result.task, result.setting, result.execution), []).append(result)
        for (task, setting, execution), found in groups.items():
            episodes = sorted(found, key=lambda r: r.seed)
            about = {
                "policy": item.policy,
                "training_seed": item.training_seed,
                "task": task,
                "setting": setting,
                "execution": execution,
                "mode": item.modes.get(execution, execution),
                "actor": episodes[0].policy,
                "checkpoint": episodes[0].checkpoint,
                "seeds_hash": episodes[0].seeds_hash,
                "seeds": [r.seed for r in episodes],
                "steps": [r.steps for r in episodes],
                "succeeded": [r.seed for r in episodes if r.success and r.crash is None],
                "crashed": [r.seed for r in episodes if r.crash is not None],
            }
            lines.append(json.dumps(about) + "\n")
    publish_text(path, "".join(lines))


def read_summary(path: Path) -> list[Evaluation]:
    """Read evaluations back, with what the file has of their episodes.

    Raises:
        DataError: the file is missing, or a line is not such a summary; names the file and the line.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, ValueError) as error:
        raise DataError(path, "a summary of evaluations", str(error), FIX) from error
    found: dict[tuple[Any, ...], Evaluation] = {}  # one for each checkpoint: not every training seed is known
    places = set()
    for number, line in enumerate(lines, start=1):
        where = f"{path}, line {number}"
        about = _checked(where, line)
        key = (about["policy"], about["training_seed"], about["checkpoint"])
        place = (*key, about["task"], about["setting"], about["execution"])
        if place in places:
            raise DataError(where, "each checkpoint, task, setting and execution once", "this one again", FIX)
        places.add(place)
        item = found.setdefault(key, Evaluation(about["policy"], about["training_seed"], path, [], {}))
        item.results.extend(_episodes(about))
        item.modes[about["execution"]] = about["mode"]
    return list(found.values())


def _episodes(about: dict[str, Any]) -> list[EpisodeResult]:
    succeeded, crashed = set(about["succeeded"]), set(about["crashed"])
    return [
        EpisodeResult(
            task=about["task"],
            setting=about["setting"],
            seed=seed,
            seeds_hash=about["seeds_hash"],
            policy=about["actor"],
            checkpoint=about["checkpoint"],
            execution=about["execution"],
            success=seed in succeeded,
            steps=steps,
            crash="crashed, see the results this summary was made of" if seed in crashed else None,
        )
        for seed, steps in zip(about["seeds"], about["steps"], strict=True)
    ]


def _checked(where: str, line: str) -> dict[str, Any]:
    try:
        about = parse_json(line)
    except ValueError as error:
        raise DataError(where, "one JSON object", f"a broken line ({error})", FIX) from error
    if not isinstance(about, dict) or not all(isinstance(about.get(key), str) for key in TEXTS):
        raise DataError(where, f"an object with {', '.join(TEXTS)}", line[:80], FIX)
    numbers = [about.get(key) for key in ("seeds", "steps", "succeeded", "crashed")]
    if not all(isinstance(part, list) and all(type(value) is int for value in part) for part in numbers):
        raise DataError(where, "lists of whole numbers: seeds, steps, succeeded, crashed", line[:80], FIX)
    seeds, steps, *marked = (list[int](part) for part in numbers if part is not None)
    if len(set(seeds)) != len(seeds) or len(steps) != len(seeds) or not all(set(part) <= set(seeds) for part in marked):
        raise DataError(where, "steps for every seed, and marks for seeds that are there", line[:80], FIX)
    if not isinstance(about.get("training_seed"), (int, type(None))):
        raise DataError(where, "a training seed or null", about["training_seed"], FIX)
    if not isinstance(about.get("checkpoint"), (str, type(None))):
        raise DataError(where, "the hash of a checkpoint or null", about["checkpoint"], FIX)
    return about
