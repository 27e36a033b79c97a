"""`ugr tasks`: list and verify the simulated tasks."""

from collections.abc import Callable, Sequence
from functools import partial

from ugr_lightning.cli.parsing.call import Count, call_one_of
from ugr_lightning.sim.outside_simulator import SETTING
from ugr_lightning.sim.settings import SETTINGS, check_setting
from ugr_lightning.sim.task_files import outside_names
from ugr_lightning.sim.tasks import named_tasks, task_summaries


def run(command: str, argv: Sequence[str]) -> int:
    """Run `ugr tasks NAME`; without a name, list them."""
    return call_one_of(FUNCTIONS, command, argv or ["list"])


def _list(task: str = "all") -> int:
    """List the simulated tasks; those in the folders that the environment variable UGR_TASKS names are among them.

    Args:
        task: a name, or `all`.
    """
    for name in (*named_tasks(task), *(outside_names() if task == "all" else ())):
        print(f"{name:<20}{task_summaries()[name]}")
    return 0


def _verify(task: str = "all", setting: str = "all", episodes: Count = 50, workers: Count = 2) -> int:
    """Run the same seeds twice, in opposite order and other processes, and recompute the evaluation seeds.

    Exit code 2 where something differs.

    Args:
        task: a name, or `all`: all but outside ones.
        setting: `demo_clean`, `demo_randomized`, or `all`.
        episodes: seeds of the expert.
        workers: simulator processes.
    """
    from ugr_lightning.demos.verify import verify_determinism, verify_evaluation_seeds

    differing = 0
    for name in named_tasks(task):
        checks = [
            partial(verify_determinism, name, setting=each, episodes=episodes) for each in _settings(task, setting)
        ]
        for check in [*checks, partial(verify_evaluation_seeds, name)]:
            found = check(workers=workers)
            print(found, flush=True)
            differing += len(found.differing)
    return 2 if differing else 0


def _seeds(task: str, count: Count = 100, workers: Count = 2) -> int:
    """Write a task's list of evaluation seeds: the first from 100000 upward that the expert solves.

    A new task, or a new version of one, needs it before policies can be tested on it.

    Args:
        task: a name, or `all`: all but outside ones.
        count: how many seeds; fewer are a quick look at a new task, and wider intervals for good.
        workers: simulator processes.
    """
    from ugr_lightning.demos.verify import find_evaluation_seeds

    for name in named_tasks(task):
        print(find_evaluation_seeds(name, count=count, workers=workers))
    return 0


def _settings(task: str, setting: str) -> tuple[str, ...]:
    if setting != "all":
        check_setting(setting)
        return (setting,)
    return (SETTING,) if task in outside_names() else tuple(SETTINGS)


FUNCTIONS: dict[str, tuple[Callable[..., int], Sequence[str]]] = {
    "list": (_list, ["task"]),
    "verify": (_verify, ["task"]),
    "seeds": (_seeds, ["task"]),
}
