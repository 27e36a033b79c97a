"""Evaluations of trained policies on disk: which policy, task and training seed a results file belongs to."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml

from ugr_lightning.errors import DataError
from ugr_lightning.results.results import EpisodeResult, read_results
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.records import read_record

RUN_FILE, RESULTS_FILE = "run.json", "results.jsonl"


@dataclass
class RunInfo:
    """What a training of a benchmark is, and how far it has come; `run.json` beside its results.

    Args:
        policy: the policy's name in the comparison.
        task: task name.
        training_seed: seed of the training.
        config_sha256: of the resolved config, `config.yaml` beside it.
        run: folder of the run, relative to the benchmark's folder; None before it was trained.
        checkpoint: file that is evaluated, relative to the benchmark's folder; None before it was trained.
        checkpoint_sha256: of that file.
        seconds: wall-clock seconds by part (`fit`, `test`), over all attempts.
        modes: by execution as results say it, the name under which it is compared where that is another one.
        job: its place in the grid; reports keep this order.
    """

    policy: str
    task: str
    training_seed: int
    config_sha256: str
    run: str | None = None
    checkpoint: str | None = None
    checkpoint_sha256: str | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    modes: dict[str, str] = field(default_factory=dict)
    job: int | None = None

    def write(self, folder: Path) -> None:
        """Write `run.json` into a folder, aside first."""
        text = json.dumps(asdict(self), indent=2) + "\n"
        publish_text(folder / RUN_FILE, text)

    @classmethod
    def read(cls, folder: Path) -> "RunInfo":
        """Read `run.json` of a folder.

        Raises:
            DataError: it is missing or is something else.
        """
        path = folder / RUN_FILE
        fix = "Restore the file, or remove the folder and run `ugr benchmark` again."
        try:
            content = path.read_bytes()
        except OSError as error:
            raise DataError(path, "what a training of a benchmark is", str(error), fix) from error
        return read_record(cls, content, path, fix)


@dataclass(frozen=True)
class Evaluation:
    """Episodes of one trained policy.

    Args:
        policy: the policy's name in the comparison.
        training_seed: None where nothing beside the results tells it.
        source: the results file.
        results: its episodes; of one checkpoint, each task, setting, execution and seed once.
        modes: by execution, the name under which it is compared where that is another one.
    """

    policy: str
    training_seed: int | None
    source: Path
    results: list[EpisodeResult]
    modes: dict[str, str] = field(default_factory=dict)


def evaluated_runs(folder: Path) -> list[Path]:
    """The folders of a benchmark's runs, or of a copy of its `results`; none where there is no benchmark."""
    return sorted({path.parent for root in (folder, folder / "results") for path in root.glob(f"*/{RUN_FILE}")})


def read_benchmark(folder: str | Path) -> list[Evaluation]:
    """The evaluations of a folder that `ugr benchmark` writes, or of a copy of its `results`, in the grid's order.

    Raises:
        DataError: there are none, or a file is damaged; names the file and the line.
    """
    folder = Path(folder)
    found = evaluated_runs(folder)
    if not found:
        fix = "Give a results folder of `ugr benchmark`, or single files with --runs NAME=FILE."
        raise DataError(folder, f"folders with {RUN_FILE}", "none", fix)
    evaluations = []
    infos = [(place, RunInfo.read(place)) for place in found]
    for place, info in sorted(infos, key=lambda item: (item[1].job is None, item[1].job or 0)):
        path = place / RESULTS_FILE
        results = _once(path, read_results(path)) if path.is_file() else []
        wrong = {item.checkpoint for item in results} - {info.checkpoint_sha256}
        if wrong:
            fix = "Remove the results file; `ugr benchmark` evaluates again."
            raise DataError(path, f"episodes of checkpoint {info.checkpoint_sha256}", f"also {wrong.pop()}", fix)
        evaluations.append(Evaluation(info.policy, info.training_seed, path, results, info.modes))
    return evaluations


def read_labelled(label: str, path: str | Path) -> Evaluation:
    """One results file under a name of the user's choice; the training seed is read from `config.yaml` beside it.

    `FILE@WHICH` are those of one policy of several in a file, by its name or by how its checkpoint's SHA-256 begins.
    Episodes of `zero`, `random` and `expert`, which `ugr demo` writes into the same file, are left out where there
    are episodes of a checkpoint.

    Raises:
        DataError: the file is damaged, or holds episodes of more than one policy.
    """
    path, which = Path(path), ""
    if not path.is_file() and "@" in path.name:
        name, _, which = path.name.rpartition("@")
        path = path.with_name(name)
    everyone = read_results(path)
    if not everyone:
        raise DataError(path, "episodes", "none", "Write some with `ugr rollout CHECKPOINT --out` this file.")
    trained = [item for item in everyone if item.checkpoint is not None]
    results = [item for item in (everyone if which else trained or everyone) if _is_meant(item, which)]
    actors = {(item.policy, item.checkpoint) for item in results}
    if len(actors) != 1:
        there = actors or {(item.policy, item.checkpoint) for item in everyone}
        got = f"{len(actors)} of " + ", ".join(sorted(f"{name} {(sha or '')[:8]}".strip() for name, sha in there))
        fix = f"Say whose they shall be: {path}@WHICH, by the policy's name or its checkpoint's first digits."
        raise DataError(path, "episodes of one policy", got, fix)
    seed = run_config(path.with_name("config.yaml")).get("seed_everything")
    return Evaluation(label, seed if isinstance(seed, int) else None, path, _once(path, results))


def _is_meant(item: EpisodeResult, which: str) -> bool:
    return item.policy == which or (item.checkpoint or "").startswith(which)


def run_config(path: Path) -> dict[str, Any]:
    """What the `config.yaml` of a run says; empty where there is none.

    Raises:
        DataError: a file that is damaged.
    """
    try:
        return dict(yaml.safe_load(path.read_text()) or {}) if path.is_file() else {}
    except (yaml.YAMLError, ValueError, TypeError) as error:
        fix = "Restore it, or move it away."
        raise DataError(path, "the config of a run", " ".join(str(error).split())[:200], fix) from error


def _once(path: Path, results: Iterable[EpisodeResult]) -> list[EpisodeResult]:
    """Drop repetitions of an episode that went the same way; one that went another way is an error."""
    kept: dict[tuple[object, ...], EpisodeResult] = {}
    for item in results:
        key = (item.task, item.setting, item.execution, item.policy, item.checkpoint, item.seed)
        first = kept.setdefault(key, item)
        if first.success != item.success or (first.crash is None) != (item.crash is None):
            where = f"{path}: {item.task}, seed {item.seed}, execution {item.execution}"
            fix = "Remove the file and evaluate again; the same seed has to go the same way."
            raise DataError(where, "each episode once", "two with different outcomes", fix)
    return list(kept.values())
