"""Which demonstrations of a folder are meant: by task, by how many, or by their numbers."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from ugr_lightning.data.formats import EpisodeLocation
from ugr_lightning.errors import ConfigError, DataError

SHOWN = 8  # tasks that are named in an error or a sentence


@dataclass(frozen=True)
class Selection:
    """Which demonstrations are meant.

    Args:
        tasks: those of these tasks, by name or by pattern (`click_*`); empty for all.
        episodes: the first so many of them, or those with these numbers; null for all.
    """

    tasks: str | Sequence[str] = ()
    episodes: int | Sequence[int] | None = None

    def __post_init__(self) -> None:
        number = self.episodes
        if isinstance(number, int) and number < 1:
            raise ConfigError("episodes", "at least 1", number, "Correct the number.")
        if number is not None and not isinstance(number, int) and len(set(number)) < max(len(number), 1):
            raise ConfigError("episodes", "numbers, each once", list(number), "Correct the list.")

    @property
    def patterns(self) -> tuple[str, ...]:
        """The names and patterns of tasks."""
        return (self.tasks,) if isinstance(self.tasks, str) else tuple(self.tasks)

    def choose(self, found: Mapping[int, EpisodeLocation], where: Path) -> dict[int, EpisodeLocation]:
        """The demonstrations that are meant, by number; fewer than asked for where there are not so many.

        Args:
            found: what a folder has.
            where: the folder, for the error.

        Raises:
            ConfigError: a task that no episode is of, or tasks in data that do not name them.
            DataError: a number that the folder does not have.
        """
        chosen = self._of_tasks(found, where)
        if self.episodes is None or isinstance(self.episodes, int):
            return dict(list(chosen.items())[: self.episodes])
        missing = [number for number in self.episodes if number not in chosen]
        if missing:
            got = f"{len(chosen)} episodes: {ranges(chosen)}" if chosen else "none"
            raise DataError(where, f"the episodes {shorten(missing)}", got, "Correct the list of episodes.")
        return {number: chosen[number] for number in self.episodes}

    def _of_tasks(self, found: Mapping[int, EpisodeLocation], where: Path) -> dict[int, EpisodeLocation]:
        if not self.patterns:
            return dict(found)
        known = count_tasks(found.values())
        unknown = [one for one in self.patterns if not any(_fits(task, one) for task in known)]
        if unknown:
            fix = "Give the folder of one task instead."
            if known:
                fix = "Correct the name, or give a pattern such as `click_*`; `ugr data inspect` counts them."
            got = describe_tasks(known) if known else "episodes that do not say their task"
            raise ConfigError(f"tasks of {where}", f"episodes of {', '.join(unknown)}", got, fix)
        wanted = {task for task in known if any(_fits(task, one) for one in self.patterns)}
        return {number: location for number, location in found.items() if wanted.intersection(location.tasks)}


ALL = Selection()


def _fits(task: str, pattern: str) -> bool:
    return task == pattern or fnmatchcase(task, pattern)


def count_tasks(locations: Iterable[EpisodeLocation]) -> dict[str, int]:
    """How many episodes there are of each task, most first; an episode of several tasks counts for each."""
    return dict(Counter(task for location in locations for task in location.tasks).most_common())


def describe_tasks(counts: Mapping[str, int]) -> str:
    """Tasks and their numbers of episodes in words."""
    return shorten([f"{task} ({count})" for task, count in counts.items()], SHOWN)


def ranges(numbers: Iterable[int]) -> str:
    """Whole numbers in words: those that follow each other as one range."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1][1:] = [number]
        else:
            runs.append([number])
    return shorten([" to ".join(map(str, run)) for run in runs])


def told_strays(strays: Sequence[Path]) -> list[str]:
    """One line where files lie among demonstrations that are taken for none; see `EpisodeFormat.strays`."""
    names = shorten([path.name for path in strays])
    return [f"files that are taken for no demonstrations: {names}"] if strays else []


def shorten(values: Sequence[object], most: int = 8) -> str:
    """A list in words, the first of it where it is long."""
    return ", ".join(map(str, values[:most])) + (f" and {len(values) - most} more" if len(values) > most else "")
