"""How start-up, step and memory grow: with demonstrations, cameras, pictures, chunk and simulator processes."""

import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ugr_lightning.contract import CAMERAS
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.sampling import Sampling
from ugr_lightning.data.storage.cache import Cache
from ugr_lightning.errors import UGRError
from ugr_lightning.models.act import ACT
from ugr_lightning.speed.made_up import write_many
from ugr_lightning.speed.measurements import COMPACT, QUICK, Stopwatch, compact_optimizer, compact_step, take_turns
from ugr_lightning.system.limits import PROC
from ugr_lightning.system.workers import Worker, WorkerLostError, start_all

HEAD = ("varied", "value", "start-up", "step", "peak", "own", "validation", "")
WIDTHS = (30, 8, 8, 8, 8, 8, 10, 0)
CURVES = {"start_s": "start-up, s of CPU", "step_ms": "step, ms of CPU", "peak_gb": "most memory, GB"}
TIMEOUT_S = 7200.0


class TrainingSize(NamedTuple):
    """What a training is given; the defaults are those of `configs/base.yaml`.

    Args:
        demonstrations: how many.
        cache: where their decoded pictures are.
        cameras: how many.
        image_size: (H, W).
        chunk_length: K.
        steps: control steps of each demonstration.
        batch: samples in a step.
        quick: a tiny network.
    """

    demonstrations: int = 50
    cache: Cache = "ram"
    cameras: int = 3
    image_size: tuple[int, int] = (120, 160)
    chunk_length: int = 50
    steps: int = 90
    batch: int = 16
    quick: bool = False


class Growth(NamedTuple):
    """What one size costs.

    Args:
        varied: what is varied.
        value: its value; all else is as in `configs/base.yaml`.
        start_s: processor time before the first step, imports included, s.
        step_ms: processor time of a training step with its batch, or of a simulator's control step, ms.
        peak_gb: most memory, the pages of mapped files included, GB.
        own_gb: memory at the end that the system could not take back, GB.
        validation: batches of one validation.
        refused: why it does not run.
    """

    varied: str
    value: str
    start_s: float | None = None
    step_ms: float | None = None
    peak_gb: float | None = None
    own_gb: float | None = None
    validation: int | None = None
    refused: str = ""


def sizes(quick: bool = False) -> dict[str, dict[str, TrainingSize]]:
    """The sizes of a training, by what is varied and its value.

    Args:
        quick: tiny ones.
    """
    base = (
        TrainingSize(2, image_size=(64, 64), chunk_length=4, steps=6, batch=2, quick=True) if quick else TrainingSize()
    )
    counts = [base.demonstrations * factor for factor in (1, 10, 100)]
    caches: dict[Cache, Sequence[int]] = {"ram": counts[:2], "memmap": counts[:2], "none": counts}
    height, width = base.image_size
    pictures = [(height // 2, width // 2), base.image_size, (2 * height, 2 * width)]
    chunks = [base.chunk_length * factor for factor in (1, 2, 4)]
    varied: dict[str, dict[str, TrainingSize]] = {
        f"demonstrations, cache {cache}": {str(n): base._replace(demonstrations=n, cache=cache) for n in some}
        for cache, some in caches.items()
    }
    return varied | {
        "cameras": {str(count): base._replace(cameras=count) for count in (1, 3, 6)},
        "picture": {f"{size[1]}x{size[0]}": base._replace(image_size=size) for size in pictures},
        "chunk": {str(length): base._replace(chunk_length=length) for length in chunks},
    }


def measure_growth(*, quick: bool = False, rounds: int | None = None) -> Iterator[Growth]:
    """Measure while it is iterated over, each size in processes of its own with one thread each.

    Args:
        quick: tiny sizes, to see that everything runs; the numbers then mean nothing.
        rounds: times that a step is timed; None for the default.
    """
    rounds = rounds or (1 if quick else 3)
    known: dict[TrainingSize, Growth] = {}
    for varied, values in sizes(quick).items():
        for value, size in values.items():
            if size not in known:
                known[size] = _measured(varied, value, partial(_train, size, rounds))
            yield known[size]._replace(varied=varied, value=value)
    for count in (1, 2, 4):
        yield _measured("simulator processes", str(count), partial(_simulate, count, quick, rounds))


class Trainee:
    """A training in a process of its own that times itself.

    Args:
        folder: of its demonstrations.
        size: what it is given.
    """

    def __init__(self, folder: Path, size: TrainingSize) -> None:
        self._folder, self._size = folder, size

    def run(self, rounds: int) -> tuple[float, float, int]:
        """Processor time before the first step and of a step, s, and the batches of a validation."""
        size, cameras = self._size, camera_names(self._size.cameras)
        data = ChunkDataModule(
            folder=str(self._folder),
            episodes=size.demonstrations,
            cameras=cameras,
            chunk_length=size.chunk_length,
            batch_size=size.batch,
            cache=size.cache,
            after_end="hold",
            sampling=Sampling(samples_per_epoch=100 * size.batch, first_frame_share=0.15),
        )
        data.prepare_data()
        data.setup("fit")
        network: dict[str, Any] = COMPACT | (QUICK.act if size.quick else {})
        policy = ACT(cameras=cameras, chunk_length=size.chunk_length, **network)
        policy.set_statistics(data.statistics)
        optimizer, batches = compact_optimizer(policy), iter(data.train_dataloader())
        start = time.process_time()
        step = take_turns({"step": lambda: compact_step(policy, optimizer, next(batches))}, rounds)["step"]
        self._kept = data, policy, optimizer  # until somebody has looked at the memory
        return start, step.cpu_seconds, len(data.val_dataloader())


def camera_names(count: int) -> tuple[str, ...]:
    """Names of so many cameras, ours first."""
    return (*CAMERAS, *(f"camera_{number}" for number in range(len(CAMERAS), count)))[:count]


def memory_of(pids: Iterable[int | None]) -> dict[str, float]:
    """`peak_gb` and `own_gb` of some processes together, see `Growth`; empty where the system does not say it."""
    sums = {"peak_gb": 0.0, "own_gb": 0.0}
    for pid in pids:
        try:
            said = dict(line.split(":", 1) for line in (PROC / str(pid) / "status").read_text().splitlines())
        except OSError:
            return {}
        for key, name in (("peak_gb", "VmHWM"), ("own_gb", "RssAnon")):
            sums[key] += int(said[name].split()[0]) * 1024 / 1e9
    return sums


def cells_of_growth(row: Growth) -> tuple[str, ...]:
    """A measured size under `HEAD`."""
    numbers = ((row.start_s, "s", 1), (row.step_ms, "ms", 0), (row.peak_gb, "GB", 2), (row.own_gb, "GB", 2))
    cells = ("" if number is None else f"{number:.{digits}f} {unit}" for number, unit, digits in numbers)
    validation = "" if row.validation is None else str(row.validation)
    return row.varied, row.value, *cells, validation, row.refused


def scale_figure(rows: Sequence[Growth]) -> Any:
    """The curves: a column for each thing that is varied; start-up, step and peak of memory below each other.

    Args:
        rows: what `measure_growth` gave.
    """
    from matplotlib.figure import Figure

    columns: dict[str, dict[str, list[Growth]]] = {}
    for row in rows:
        varied, _, line = row.varied.partition(", ")
        columns.setdefault(varied, {}).setdefault(line, []).append(row)
    figure = Figure(figsize=(2.4 * len(columns), 6), layout="constrained")
    grid = figure.subplots(3, len(columns), squeeze=False)
    for axes, (varied, lines) in zip(grid.T, columns.items(), strict=True):
        for axis, (name, label) in zip(axes, CURVES.items(), strict=True):
            for line, points in lines.items():
                heights = [getattr(point, name) for point in points]
                known = [math.nan if height is None else height for height in heights]
                axis.plot([point.value for point in points], known, marker=".", label=line)
            axis.set_ylim(0, 1.1 * axis.get_ylim()[1])
            axis.set_visible(any(getattr(point, name) is not None for points in lines.values() for point in points))
            axis.set_ylabel(label if axis in grid[:, 0] else "")
        shown = [axis for axis in axes if axis.get_visible()]
        (shown or axes)[0].set_title(varied, fontsize=10)
        if len(lines) > 1:
            axes[0].legend(fontsize=8)
    return figure


def _measured(varied: str, value: str, run: Callable[[], dict[str, Any]]) -> Growth:
    try:
        return Growth(varied, value, **run())
    except (UGRError, WorkerLostError) as error:
        return Growth(varied, value, refused=str(error))


def _train(size: TrainingSize, rounds: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_many(folder, size.demonstrations, size.steps, size.image_size, camera_names(size.cameras))
        with Worker(partial(Trainee, folder, size), "training process") as worker:
            worker.receive()
            worker.send("run", rounds)
            start, step, validation = worker.receive(TIMEOUT_S)
            return {"start_s": start, "step_ms": 1e3 * step, "validation": validation, **memory_of([worker.pid])}


def _simulate(count: int, quick: bool, rounds: int) -> dict[str, Any]:
    image_size, steps = ((30, 40), 2) if quick else ((120, 160), 30)
    workers = [Worker(partial(Stopwatch, image_size), f"simulator {number + 1}") for number in range(count)]
    try:
        start_all(workers)
        for worker in workers:
            worker.send("control_step", steps, rounds)
        paces = [worker.receive(TIMEOUT_S) for worker in workers]
        seconds = sum(pace.cpu_seconds for pace in paces) / count
        return {"step_ms": 1e3 * seconds, **memory_of([worker.pid for worker in workers])}
    finally:
        for worker in workers:
            worker.kill()
