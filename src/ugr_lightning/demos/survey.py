"""What a task asks for, measured: expert and dummies on fresh seeds, time and size of recordings, determinism."""

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ugr_lightning.demos.noise import Noise
from ugr_lightning.demos.recorder import Recorder, staged_episode
from ugr_lightning.errors import DataError
from ugr_lightning.results.results import EpisodeResult, wilson_interval
from ugr_lightning.results.tables import as_markdown
from ugr_lightning.rollout.evaluate import run_episodes
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.sim.simulator import Simulator
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.progress import Progress
from ugr_lightning.system.spread import spread
from ugr_lightning.system.workers import Worker, start_all

FIRST_SEED = 400_000
"""Fresh seeds for statistics: apart from demonstrations, evaluation and selection."""

IMAGE_SIZES = ((120, 160), (240, 320))


class Performance(NamedTuple):
    """How the expert did on a seed, without noise and to the end of its script.

    Args:
        seed: simulator seed.
        success: whether the task's condition was met.
        steps: control steps of the whole script: the length of a demonstration.
        motion_hash: SHA-256 of the measured joints of all frames, the last one included.
        gave_up: what the expert could not reach, which ended its script; None where there was no such pose.
    """

    seed: int
    success: bool
    steps: int
    motion_hash: str
    gave_up: str | None = None


class Performer:
    """Lets the expert perform seeds; lives in a worker process.

    Args:
        open_task: opens the simulator.
    """

    def __init__(self, open_task: Callable[[], Simulator]) -> None:
        self._simulator = open_task()

    def perform(self, seed: int) -> Performance:
        """One episode of the expert."""
        frame, steps = self._simulator.reset(seed), 0
        motion = hashlib.sha256(np.asarray(frame.measured).tobytes())
        for intention in self._simulator.expert():
            frame, steps = self._simulator.step(intention.action), steps + 1
            motion.update(np.asarray(frame.measured).tobytes())
        return Performance(seed, bool(frame.success), steps, motion.hexdigest(), self._simulator.gave_up)


def perform(task: str, seeds: Sequence[int], *, setting: str = "demo_clean", workers: int = 1) -> list[Performance]:
    """Let the expert perform some seeds, without pictures.

    Returns:
        One item per seed, in order; a simulator that was lost counts as a failure of no steps.
    """
    open_task = partial(open_simulator, task, setting=setting, render=False)
    results: dict[int, Performance] = {}
    with Progress(f"{task}, {setting}: expert", len(seeds)) as line:
        for done in spread(partial(Performer, open_task), "perform", seeds, workers=workers):
            if done.fault is not None:
                line.message(f"Seed {seeds[done.job]} counts as a failure: {done.fault}")
            found = results[done.job] = done.value or Performance(seeds[done.job], False, 0, "")
            if found.gave_up is not None:
                line.message(f"Seed {found.seed}: {found.gave_up}")
            line.advance(f"{sum(item.success for item in results.values())} solved")
    return [results[index] for index in range(len(seeds))]


@dataclass(frozen=True)
class MeasuredRate:
    """Successes of n episodes with their 95 % Wilson interval."""

    successes: int
    n: int
    low: float
    high: float

    @classmethod
    def of(cls, outcomes: Sequence[bool]) -> "MeasuredRate":
        """Count some outcomes."""
        return cls(sum(outcomes), len(outcomes), *wilson_interval(sum(outcomes), len(outcomes)))

    def __str__(self) -> str:
        return f"{self.successes}/{self.n} [{100 * self.low:.1f}, {100 * self.high:.1f}]"


@dataclass(frozen=True)
class RecordingCost:
    """What an episode costs to record in one process, start-up apart.

    Args:
        image_size: (H, W).
        episodes: how many were recorded.
        seconds, megabytes: of one episode, mean; a megabyte has 10^6 bytes.
    """

    image_size: tuple[int, int]
    episodes: int
    seconds: float
    megabytes: float


@dataclass(frozen=True)
class Survey:
    """One row of the table of tasks.

    Args:
        task, setting: what was surveyed.
        task_version: of the task.
        first_seed: the seeds are this one and those after it.
        expert, zero, random: their successes.
        steps: mean, shortest and longest demonstration, control steps.
        failures: seeds that the expert does not solve.
        recordings: cost by picture size.
        package_version: of ugr-lightning.
    """

    task: str
    setting: str
    task_version: int | None
    first_seed: int
    expert: MeasuredRate
    zero: MeasuredRate
    random: MeasuredRate
    steps: tuple[float, int, int]
    failures: tuple[int, ...]
    recordings: tuple[RecordingCost, ...]
    package_version: str


def survey(
    task: str,
    *,
    setting: str = "demo_clean",
    episodes: int = 200,
    dummy_episodes: int = 50,
    recordings: int = 5,
    image_sizes: Sequence[tuple[int, int]] = IMAGE_SIZES,
    first_seed: int = FIRST_SEED,
    workers: int = 2,
) -> Survey:
    """Measure a task in a setting.

    Args:
        task: a name from `ugr tasks`.
        setting: how the surroundings vary.
        episodes: seeds for the expert.
        dummy_episodes: seeds for `zero` and for `random`, which run to the horizon.
        recordings: episodes that are recorded, with the default noise, at each picture size; 0 renders nothing.
        image_sizes: (H, W) each.
        first_seed: of all of these.
        workers: simulator processes; recording is timed in one.
    """
    from ugr_lightning.sim.tasks import all_task_names, task_version

    seeds = list(range(first_seed, first_seed + episodes))
    performances = perform(task, seeds, setting=setting, workers=workers)
    dummies: dict[str, list[EpisodeResult]] = {}
    if dummy_episodes:
        spec = RolloutSpec(task, seeds[:dummy_episodes], setting, workers=workers)
        dummies = {name: run_episodes(name, spec) for name in ("zero", "random")}
    lengths = [item.steps for item in performances if item.success]
    return Survey(
        task=task,
        setting=setting,
        task_version=task_version(task) if task in all_task_names() else None,
        first_seed=first_seed,
        expert=MeasuredRate.of([item.success for item in performances]),
        zero=MeasuredRate.of([item.success for item in dummies.get("zero", [])]),
        random=MeasuredRate.of([item.success for item in dummies.get("random", [])]),
        steps=(round(float(np.mean(lengths)), 1), min(lengths), max(lengths)) if lengths else (0.0, 0, 0),
        failures=tuple(item.seed for item in performances if not item.success),
        recordings=tuple(
            _time_recording(task, setting, size, seeds[:recordings]) for size in (image_sizes if recordings else ())
        ),
        package_version=version("ugr-lightning"),
    )


def _time_recording(task: str, setting: str, image_size: tuple[int, int], seeds: Sequence[int]) -> RecordingCost:
    open_task = partial(open_simulator, task, setting=setting, image_size=image_size)
    seconds, sizes = [], []
    title = f"{task}, {setting}: recording at {image_size[1]}x{image_size[0]}"
    with tempfile.TemporaryDirectory() as scratch, Progress(title, len(seeds)) as line:
        staging = Path(scratch)
        with Worker(partial(Recorder, open_task, Noise(), staging), "recording process") as worker:
            start_all([worker])
            for seed in seeds:
                start = time.perf_counter()
                worker.send("record", seed)
                if worker.receive().failure is None:
                    seconds.append(time.perf_counter() - start)
                    sizes.append(staged_episode(staging, seed).stat().st_size / 1e6)
                line.advance()
    mean = [round(float(np.mean(values)), 3) if values else 0.0 for values in (seconds, sizes)]
    return RecordingCost((image_size[0], image_size[1]), len(sizes), mean[0], mean[1])


def survey_table(rows: Sequence[dict[str, Any]]) -> str:
    """The surveys of `read_surveys` as a Markdown table, with a line on how to read it."""
    sizes = sorted({tuple(cost["image_size"]) for row in rows for cost in row["recordings"]})
    heads = ["task", "setting", "expert", "steps (range)", "`zero`", "`random`"]
    heads += [f"{unit} at {width}x{height}" for height, width in sizes for unit in ("s", "MB")]
    table = [heads]
    for row in rows:
        mean, shortest, longest = row["steps"]
        expert = str(MeasuredRate(**row["expert"]))
        cells = [row["task"], row["setting"], expert, f"{mean:.0f} ({shortest} to {longest})"]
        cells += [str(MeasuredRate(**row[name])) for name in ("zero", "random")]
        costs = {tuple(cost["image_size"]): cost for cost in row["recordings"]}
        for size in sizes:
            cost = costs.get(size)
            cells += ["", ""] if cost is None else [f"{cost['seconds']:.1f}", f"{cost['megabytes']:.2f}"]
        table.append(cells)
    starts = ", ".join(sorted({str(row["first_seed"]) for row in rows}))
    return as_markdown(table) + (
        f"\n\nSuccesses with 95 % Wilson intervals in per cent, seeds from {starts} upward. Steps are those of the "
        "expert's successful episodes at 25 Hz. Seconds and megabytes are those of one recorded episode, one process.\n"
    )


def read_surveys(path: Path) -> list[dict[str, Any]]:
    """The rows written so far; none where there is no file.

    Raises:
        DataError: not a file of surveys.
    """
    if not path.is_file():
        return []
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        survey_table(rows)
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(path, "a file of `ugr tasks measure`", repr(error), "Move it away.") from error
    return rows


def write_survey(stem: Path, row: Survey) -> str:
    """Put one row into `<stem>.json` and `<stem>.md`, in place of an older one of the same task and setting.

    Returns:
        The whole table.
    """
    path = stem.with_name(stem.name + ".json")
    rows = {(old["task"], old["setting"]): old for old in read_surveys(path)}
    rows[row.task, row.setting] = json.loads(json.dumps(asdict(row)))
    ordered = [rows[key] for key in sorted(rows)]
    table = survey_table(ordered)
    publish_text(stem.with_name(stem.name + ".md"), table)
    publish_text(path, json.dumps(ordered, indent=1) + "\n")
    return table
