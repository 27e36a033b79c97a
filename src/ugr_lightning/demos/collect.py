"""Demonstrations by the scripted expert: recorded in parallel, kept when they succeed, resumable after any kill."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

from ugr_lightning.data.folder import (
    episode_path,
    find_episodes,
    read_scene_info,
    read_seeds,
    write_instructions,
    write_scene_info,
    write_seeds,
)
from ugr_lightning.data.formats import RECORDED, recognise
from ugr_lightning.demos.noise import Noise
from ugr_lightning.demos.recorder import Outcome, Recorder, staged_episode, staged_scene, staged_video
from ugr_lightning.errors import ConfigError, DataError, SimulationError
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.sim.settings import check_setting
from ugr_lightning.sim.tasks import all_task_names, check_task, task_summaries, task_version
from ugr_lightning.system.files import publish_text, remove_unfinished
from ugr_lightning.system.lock import locked
from ugr_lightning.system.progress import Progress
from ugr_lightning.system.spread import spread

EVERY = slice(0, None, 1)
HOPELESS = 50
"""So many seeds without a success mean that the expert cannot do the task in this setting."""


def collect(
    task: str,
    folder: str | Path,
    *,
    episodes: int,
    setting: str = "demo_clean",
    image_size: tuple[int, int] = (120, 160),
    noise: Noise | None = None,
    workers: int = 2,
    first_seed: int = 0,
    progress: bool = True,
    video: bool = False,
    part: slice = EVERY,
) -> None:
    """Fill a folder with successful demonstrations in RoboTwin 2.0's raw layout.

    Episode i is the i-th seed from `first_seed` upward that the expert solves: the content depends neither on the
    number of workers nor on interruptions. A call that finds enough episodes does nothing; one that finds fewer
    records the rest. Two calls for one folder at the same time wait for each other, unless each has a part of its own:
    these record side by side and leave their episodes staged, for the next call that has the whole to file.

    Args:
        task: a name from `ugr tasks`.
        folder: where to, `data/<task>/<setting>` by custom.
        episodes: how many the folder shall hold.
        setting: how the surroundings vary, `demo_clean` or `demo_randomized`.
        image_size: height and width of the pictures.
        noise: how much the executed commands stray; None for the default. The intended ones are recorded as labels.
        workers: simulator processes.
        first_seed: where the search for seeds starts.
        progress: whether to show a progress line.
        video: whether to write `video/episode{i}.mp4` of the head camera as well.
        part: which of the seeds, as places in their order: of `slice(2, None, 8)` the third, the eleventh and so on.

    Raises:
        ConfigError: no such task or setting.
        DataError: the folder holds a recording of another kind; says what differs. Nothing is deleted.
        SimulationError: the simulator does not start, or the expert solves nothing.

    Source: RoboTwin-Platform/RoboTwin@13c3c47, script/collect_data.py (layout of the folder).
    """
    if episodes < 1 or workers < 1:
        got = f"{episodes} episodes, {workers} workers"
        raise ConfigError("collect", "at least one episode and one worker", got, "Correct the number.")
    folder, noise = Path(folder), noise if noise is not None else Noise()
    if not find_episodes(folder):
        check_task(task)
        check_setting(setting)
    foreign = [form.name for form in recognise(folder) if form.name != RECORDED]
    if foreign:
        got = f"demonstrations of the format {foreign[0]}"
        raise DataError(folder, "a folder to record into", got, "Record into another folder.")
    folder.mkdir(parents=True, exist_ok=True)
    settings = _settings(task, setting, image_size, noise, first_seed)
    alone = part.step == 1
    with locked(folder / "recording.lock", f"Recording into {folder}", shared=not alone, wait=True):
        for place in (folder, folder / "instructions", folder / "video") if alone else ():
            remove_unfinished(place)
        if _is_complete(folder, episodes, settings):
            return
        open_task = partial(open_simulator, task, setting=setting, image_size=image_size)
        build = partial(Recorder, open_task, noise, folder / "staging", video)
        ledger = _Ledger(folder, task, first_seed)
        if not alone:
            ledger = _Part(folder, task, first_seed, episodes, part)
            episodes = ledger.wanted
        with Progress(f"{task}: demonstrations", episodes, done=ledger.count(episodes), shown=progress) as line:
            _record(ledger, episodes, build, workers, line)
        if alone:
            shutil.rmtree(folder / "staging", ignore_errors=True)


def _record(ledger: "_Ledger", episodes: int, build: Callable[[], Recorder], workers: int, line: Progress) -> None:
    """Keep every process busy with the next seed, and file the outcomes in the order of the seeds."""
    wanted = ledger.seeds(episodes)
    given: list[int] = []
    again: list[int] = []  # seeds that have killed a process once
    outcomes: dict[int, Outcome] = {}
    useless = 0

    def seeds() -> Iterator[int]:
        while True:
            given.append(again.pop(0) if again else next(wanted))
            yield given[-1]

    with closing(spread(build, "record", seeds(), workers=min(workers, episodes))) as ended:
        for done in ended:
            seed = given[done.job]
            if done.fault is None:
                outcomes[seed] = done.value
            elif given.count(seed) > 1:
                outcomes[seed] = Outcome(seed, 0, done.fault)
            else:
                line.message(f"Seed {seed}: {done.fault}; trying it once more.")
                again.append(seed)
            for outcome in ledger.file(outcomes, episodes):
                useless = 0 if outcome.failure is None else useless + 1
                if outcome.failure is not None:
                    line.message(f"Seed {outcome.seed} is skipped: {outcome.failure}")
                if useless >= HOPELESS:
                    got = f"{useless} seeds in a row without success, the last because: {outcome.failure}"
                    fix = "Check the task with `ugr rollout --policy expert`, or record with less noise."
                    raise SimulationError("expert", "a task that it solves", got, fix)
                if outcome.failure is None:
                    line.advance(f"seed {outcome.seed}, {outcome.steps} steps")
            if ledger.count(episodes) >= episodes:
                return


class _Ledger:
    """Which seed becomes which episode; the files are always in a state from which it can be rebuilt.

    A seed enters `seed.txt` before its episode file is renamed into place. A seed there without a file is therefore
    one whose filing was interrupted (or whose file was removed): it is recorded first, under its own index.
    """

    def __init__(self, folder: Path, task: str, first_seed: int) -> None:
        self._folder = folder
        self._seeds = read_seeds(folder)
        self._scenes = read_scene_info(folder)
        self._present = set(find_episodes(folder))
        self._instruction = task_summaries().get(task, task.replace("_", " "))
        self._next_seed = self._seeds[-1] + 1 if self._seeds else first_seed
        self._gaps = [index for index in range(len(self._seeds)) if index not in self._present]
        self._order: list[int] = []
        if self._present and max(self._present) >= len(self._seeds):
            got = f"{len(self._seeds)} seeds and episode {max(self._present)}"
            fix = "Restore seed.txt, or record into another folder."
            raise DataError(folder / "seed.txt", "a seed for every episode", got, fix)

    def count(self, episodes: int) -> int:
        """How many of the first episodes there are."""
        return len(self._present & set(range(episodes)))

    def seeds(self, episodes: int) -> Iterator[int]:
        """Seeds in the order in which they are to be recorded and filed, without end."""
        self._gaps = [index for index in self._gaps if index < episodes]
        again = [self._seeds[index] for index in self._gaps]
        self._order.extend(again)
        yield from again
        while True:
            self._order.append(self._next_seed)
            self._next_seed += 1
            yield self._order[-1]

    def file(self, outcomes: dict[int, Outcome], episodes: int) -> Iterator[Outcome]:
        """File those outcomes whose predecessors have all been filed, and yield them."""
        while self._order and self._order[0] in outcomes and self.count(episodes) < episodes:
            outcome = outcomes.pop(self._order.pop(0))
            if self._gaps:
                self._refile(outcome)
            elif outcome.failure is None:
                self._seeds.append(outcome.seed)
                self._place(len(self._seeds) - 1, outcome.seed)
            yield outcome

    def _refile(self, outcome: Outcome) -> None:
        index = self._gaps.pop(0)
        if outcome.failure is not None:
            fix = "Record into another folder."
            got = f"seed {outcome.seed} fails: {outcome.failure}"
            raise SimulationError(episode_path(self._folder, index), "an expert as it was at the time", got, fix)
        self._place(index, outcome.seed)

    def _place(self, index: int, seed: int) -> None:
        """The rename of the episode comes last: it is what makes the episode count."""
        staging = self._folder / "staging"
        self._scenes[index] = json.loads(staged_scene(staging, seed).read_text())
        write_seeds(self._folder, self._seeds)
        write_scene_info(self._folder, self._scenes)
        write_instructions(self._folder, index, [self._instruction])
        film = staged_video(staging, seed)
        if film.is_file():
            (self._folder / "video").mkdir(exist_ok=True)
            os.replace(film, self._folder / "video" / f"episode{index}.mp4")
        target = episode_path(self._folder, index)
        target.parent.mkdir(exist_ok=True)
        os.replace(staged_episode(staging, seed), target)
        self._present.add(index)


class _Part(_Ledger):
    """One part of the seeds, while other processes record the others: what succeeds stays staged.

    Attributes:
        wanted: how many episodes are its share of those that are missing.
    """

    def __init__(self, folder: Path, task: str, first_seed: int, episodes: int, part: slice) -> None:
        super().__init__(folder, task, first_seed)
        self._episodes, self._part, self._staged = episodes, part, 0
        self.wanted = len(range(episodes - super().count(episodes))[part])

    def count(self, episodes: int) -> int:
        """How many of its episodes are staged."""
        return self._staged

    def seeds(self, episodes: int) -> Iterator[int]:
        """The seeds of the part, without end."""
        return islice(super().seeds(self._episodes), self._part.start, None, self._part.step)

    def file(self, outcomes: dict[int, Outcome], episodes: int) -> Iterator[Outcome]:
        """Count what has been staged, in any order."""
        while outcomes:
            _, outcome = outcomes.popitem()
            self._staged += outcome.failure is None
            yield outcome


def _settings(task: str, setting: str, image_size: tuple[int, int], noise: Noise, first_seed: int) -> dict[str, Any]:
    return {
        "task": task,
        "setting": setting,
        "image_size": list(image_size),
        "noise": asdict(noise),
        "first_seed": first_seed,
        "task_version": task_version(task) if task in all_task_names() else None,
    }


def _is_complete(folder: Path, episodes: int, settings: dict[str, Any]) -> bool:
    """Whether there is nothing left to do; makes sure that the folder is one that may be added to."""
    path, present = folder / "recording.json", set(find_episodes(folder))
    if path.is_file():
        try:
            found = {"task_version": settings["task_version"], **json.loads(path.read_text())}  # older ones lack it
            differences = [f"{key} {found.get(key)!r}" for key in settings if found.get(key) != settings[key]]
        except (ValueError, TypeError) as error:
            raise DataError(path, "the settings of a recording", error, "Restore the file.") from error
        if differences:
            wanted = ", ".join(f"{key} {settings[key]!r}" for key in settings if found.get(key) != settings[key])
            fix = "Record into another folder, or move this one away."
            raise DataError(folder, f"a recording with {wanted}", ", ".join(differences), fix)
    if set(range(episodes)) <= present:
        return True
    if not path.is_file():
        if present:
            fix = "Record into another folder, or ask for no more episodes than there are."
            got = f"{len(present)} episodes from elsewhere (no recording.json)"
            raise DataError(folder, f"an empty folder or {episodes} episodes", got, fix)
        content = json.dumps({**settings, "package_version": version("ugr-lightning")}, indent=2) + "\n"
        publish_text(path, content)
    return False
