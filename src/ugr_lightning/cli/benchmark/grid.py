"""The grid of a benchmark: policies x tasks x training seeds, read from one YAML file."""

import difflib
import hashlib
import io
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from ugr_lightning.cli.parsing.config import find_config, flat
from ugr_lightning.errors import ConfigError

Execution = str | int
WHERE_ONLY = ("run", "checkpoint", "ckpt_path", "config", "trainer.default_root_dir")
"""Keys of a resolved config that say where a run is and not what it is."""


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    Args:
        index: its place in the grid.
        policy: the policy's name in the comparison.
        task: task name.
        training_seed: seed of the training.
        configs: configs of the training, later ones win.
        executions: how chunks are executed, by the name under which policies are compared.
    """

    index: int
    policy: str
    task: str
    training_seed: int
    configs: tuple[Path, ...]
    executions: dict[str, Execution]

    @property
    def name(self) -> str:
        """Name of its run and of its results."""
        return f"{self.policy}-{self.task}-seed{self.training_seed}"

    @property
    def modes(self) -> dict[str, str]:
        """By execution, the name under which it is compared where that is another one."""
        return {str(value): name for name, value in self.executions.items() if str(value) != name}

    def fit_arguments(self) -> list[str]:
        """What `ugr fit` trains, without where it goes."""
        configs = [word for path in self.configs for word in ("--config", str(path))]
        return [*configs, "--seed_everything", str(self.training_seed)]


@dataclass(frozen=True)
class Grid:
    """What `ugr benchmark` trains and evaluates.

    Args:
        path: the file it was read from; paths in it are relative to its folder.
        policies: by name, configs, and executions where they differ from those of the grid.
        tasks: by task name, configs on top of the policy's.
        training_seeds: seeds of the trainings.
        overlays: configs on top of everything.
        executions: how chunks are executed, by the name under which policies are compared.
        episodes: how many of the task's evaluation seeds.
        checkpoint: which of a run's checkpoints is evaluated.
        workers: simulator processes of an evaluation.
    """

    path: Path
    policies: dict[str, tuple[tuple[Path, ...], dict[str, Execution] | None]]
    tasks: dict[str, tuple[Path, ...]]
    training_seeds: tuple[int, ...] = (0,)
    overlays: tuple[Path, ...] = ()
    executions: dict[str, Execution] = field(default_factory=lambda: {"aggregate": "aggregate", "25": 25})
    episodes: int = 100
    checkpoint: Literal["best", "best_loss", "last"] = "best"
    workers: int = 2

    def jobs(self) -> list[Job]:
        """All jobs; the training seed changes slowest, so that a part of the grid already compares all policies."""
        found: list[Job] = []
        for seed in self.training_seeds:
            for task, overlays in self.tasks.items():
                for policy, (configs, executions) in self.policies.items():
                    paths = (*configs, *overlays, *self.overlays)
                    found.append(Job(len(found), policy, task, seed, paths, executions or self.executions))
        return found


def read_grid(path: str | Path) -> Grid:
    """Read and check a grid.

    Args:
        path: its file, or the name of one that ships with the package: `table1`.

    Raises:
        ConfigError: a missing file, an unknown key or a value that does not fit; names the key.
    """
    path = find_config(path, "ugr benchmark", under="benchmark")
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(path, "valid YAML", " ".join(str(error).split()), "Correct the file.") from error
    entries = _mapping(path, "grid", content)
    _refuse_unknown(path, entries, {*READERS})
    for name in ("policies", "tasks"):
        if name not in entries:
            raise ConfigError(path, f"the key {name}", f"only {', '.join(entries)}", "Add it.")
    return Grid(path, **{name: READERS[name](path, name, value) for name, value in entries.items()})


def resolved_config(job: Job) -> dict[str, Any]:
    """Everything that `ugr fit` would train with, defaults included.

    Raises:
        ConfigError: a config is missing or wrong, or trains on another task than the grid says.
    """
    from ugr_lightning.cli.fit import run

    captured = io.StringIO()
    try:
        with redirect_stdout(captured):
            run("fit", [*job.fit_arguments(), "--print_config"])
    except SystemExit:
        pass  # that is how printing ends
    config = yaml.safe_load(captured.getvalue())
    if config["data"]["task"] != job.task:
        fix = "Give the task the config that chooses it, such as configs/task/NAME.yaml."
        raise ConfigError(f"tasks.{job.task}", f"configs with data.task {job.task}", config["data"]["task"], fix)
    return dict(config)


def fingerprint(config: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a resolved config, without where its run is kept."""
    return hashlib.sha256(json.dumps(identity(config), sort_keys=True).encode()).hexdigest()


def identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a resolved config by dotted key, without the keys that say where a run is."""
    return {key: value for key, value in flat(config).items() if key not in WHERE_ONLY}


def _mapping(path: Path, name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        raise ConfigError(f"{path}: {name}", "a mapping of names", value, "Correct the file.")
    return {str(key): item for key, item in value.items()}


def _refuse_unknown(where: object, entries: Mapping[str, Any], known: set[str]) -> None:
    for key in entries.keys() - known:
        near = difflib.get_close_matches(key, known, n=1)
        fix = f"Did you mean `{near[0]}`?" if near else f"Known are {', '.join(sorted(known))}."
        raise ConfigError(f"{where}: {key}", "a known key", "an unknown one", fix)


def _paths(path: Path, name: str, value: Any) -> tuple[Path, ...]:
    return tuple(find_config(str(item), f"{path}: {name}", path.parent) for item in _listed(value))


def _policies(path: Path, name: str, value: Any) -> dict[str, tuple[tuple[Path, ...], dict[str, Execution] | None]]:
    found = {}
    for policy, entry in _mapping(path, name, value).items():
        where = f"{name}.{policy}"
        entry = entry if isinstance(entry, dict) else {"configs": entry}
        _refuse_unknown(f"{path}: {where}", entry, {"configs", "executions"})
        own = _executions(path, where, entry["executions"]) if "executions" in entry else None
        found[_file_name(path, policy)] = _paths(path, where, entry.get("configs")), own
    return found


def _tasks(path: Path, name: str, value: Any) -> dict[str, tuple[Path, ...]]:
    entries = _mapping(path, name, value)
    return {_file_name(path, task): _paths(path, f"{name}.{task}", configs) for task, configs in entries.items()}


def _file_name(path: Path, name: str) -> str:
    if not name.replace("_", "").replace("-", "").replace(".", "").isalnum() or name.startswith("."):
        raise ConfigError(f"{path}: {name}", "letters, digits, `-`, `_` and `.`", name, "It names files; rename it.")
    return name


def _executions(path: Path, name: str, value: Any) -> dict[str, Execution]:
    entries = value if isinstance(value, dict) else {str(item): item for item in _listed(value)}
    for item in entries.values():
        if not isinstance(item, (str, int)) or isinstance(item, bool):
            raise ConfigError(f"{path}: {name}", "`aggregate` or a number of steps", item, "Correct the value.")
    return _mapping(path, name, entries)


def _training_seeds(path: Path, name: str, value: Any) -> tuple[int, ...]:
    seeds = tuple(_count(path, name, item, 0) for item in _listed(value))
    if not seeds or len(set(seeds)) != len(seeds):
        raise ConfigError(f"{path}: {name}", "at least one seed, each once", value, "Correct the list.")
    return seeds


def _count(path: Path, name: str, value: Any, least: int = 1) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ConfigError(f"{path}: {name}", f"a whole number from {least}", value, "Correct the number.")
    return value


def _checkpoint(path: Path, name: str, value: Any) -> str:
    if value not in ("best", "best_loss", "last"):
        raise ConfigError(f"{path}: {name}", "best, best_loss or last", value, "Correct the name.")
    return str(value)


def _listed(value: Any) -> Iterator[Any]:
    yield from value if isinstance(value, list) else () if value is None else (value,)


READERS: dict[str, Callable[[Path, str, Any], Any]] = {
    "policies": _policies,
    "tasks": _tasks,
    "training_seeds": _training_seeds,
    "overlays": _paths,
    "executions": _executions,
    "episodes": _count,
    "checkpoint": _checkpoint,
    "workers": _count,
}
