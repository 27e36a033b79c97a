"""The tasks: one file each, found by listing this folder. Nothing here imports SAPIEN until a task is loaded.

Environments made by others are in `sim.outside`; their names, summaries and versions are found here as well.
"""

import ast
import difflib
import importlib
from pathlib import Path
from typing import Any

from ugr_lightning.errors import ConfigError, SimulationError
from ugr_lightning.sim.outside import outside_names


def task_names() -> tuple[str, ...]:
    """Names of our own tasks, sorted."""
    return tuple(sorted(path.stem for path in Path(__file__).parent.glob("*.py") if not path.stem.startswith("_")))


def all_task_names() -> tuple[str, ...]:
    """Names of our own tasks, then those of outside ones."""
    return (*task_names(), *outside_names())


def task_summaries() -> dict[str, str]:
    """One line on each task, ours and outside ones, the first of its file."""
    summaries = {}
    for name in all_task_names():
        text = ast.get_docstring(ast.parse(_path(name).read_text(encoding="utf-8"))) or ""
        summaries[name] = text.split("\n", 1)[0]
    return summaries


def task_version(name: str) -> int:
    """Version of a task, read from its file without loading it; raised whenever the same seed means something else.

    Raises:
        ConfigError: there is no such task.
        SimulationError: its class states none.
    """
    check_task(name)
    path = _path(name)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["version"]:
            return int(ast.literal_eval(node.value))
    raise SimulationError(path, "a line `version = 1` in the class", "none", "State the task's version.")


def check_task(name: str) -> None:
    """Make sure that a task exists, without loading it.

    Raises:
        ConfigError: there is no such task; the message names the closest ones.
    """
    names = all_task_names()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
        fix = f"Did you mean {' or '.join(close)}?" if close else "`ugr tasks` lists them."
        raise ConfigError("task", "one of " + ", ".join(names), repr(name), fix)


def named_tasks(which: str) -> tuple[str, ...]:
    """The tasks that `all`, which means our own, or a name stands for.

    Raises:
        ConfigError: neither.
    """
    if which == "all":
        return task_names()
    check_task(which)
    return (which,)


def _path(name: str) -> Path:
    """The file of a task."""
    folder = Path(__file__).parent
    return (folder.parent / "outside" if name in outside_names() else folder) / f"{name}.py"


def environment_id(name: str) -> str:
    """The task's gymnasium id, e.g. `UGR-ClickAlarmclock-v1`."""
    return f"UGR-{''.join(part.capitalize() for part in name.split('_'))}-v1"


def load_task(name: str) -> type[Any]:
    """The environment class of a task, registered with gymnasium; imports SAPIEN.

    Args:
        name: a name from `task_names`.

    Raises:
        ConfigError: there is no such task, or it is an outside one.
        SimulationError: SAPIEN or ManiSkill is not installed, or the file defines no task.
    """
    check_task(name)
    if name in outside_names():
        raise ConfigError("task", "one of our own", name, "`sim.outside.simulator_of` opens it.")
    try:
        from mani_skill.utils.registration import REGISTERED_ENVS, register_env

        from ugr_lightning.sim.scene import TwoArmEnv

        module = importlib.import_module(f"{__name__}.{name}")
    except ModuleNotFoundError as error:
        fix = "Install the simulator: `pip install sapien mani-skill`. Training works without it."
        raise SimulationError(f"task {name}", "an installed simulator", f"no module {error.name}", fix) from error
    classes = [item for item in vars(module).values() if isinstance(item, type) and item.__module__ == module.__name__]
    tasks = [item for item in classes if issubclass(item, TwoArmEnv)]
    if len(tasks) != 1:
        raise SimulationError(module.__name__, "one subclass of TwoArmEnv", len(tasks), "Define exactly one per file.")
    if environment_id(name) not in REGISTERED_ENVS:
        register_env(environment_id(name), max_episode_steps=tasks[0].horizon)(tasks[0])
    return tasks[0]
