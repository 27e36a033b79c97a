"""The workloads whose speed `ugr speed` reports; what is compared is measured in turns, in one process."""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from ugr_lightning.contract import ACTION_DIM, CAMERAS, STATE_DIM, Batch, Statistics
from ugr_lightning.data.chunks import ChunkDataset
from ugr_lightning.data.episode import Episode
from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.data.storage.cache import Cache, open_frames
from ugr_lightning.models.act import ACT
from ugr_lightning.models.precision import autocast
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.sim.registry import open_simulator
from ugr_lightning.speed.made_up import TASK, write_made_up
from ugr_lightning.speed.reference_act import ReferenceACT
from ugr_lightning.system.workers import Worker, start_all

EPISODE_TIMEOUT_S = 600.0


class Size(NamedTuple):
    """How large the measured workloads are.

    Args:
        act: sizes of the network, as arguments of `ACT`.
        batch: samples in a training step and in a fetched batch.
        image_size: (H, W) of training and data path.
        control_sizes: (H, W) of the simulated cameras.
        rounds: how often each workload is timed; the median counts.
        frames: frames of each of the two episodes of the data path.
        control_steps: simulated control steps timed per round.
        episodes: simulated episodes per process.
    """

    act: dict[str, int]
    batch: int
    image_size: tuple[int, int]
    control_sizes: tuple[tuple[int, int], ...]
    rounds: int
    frames: int
    control_steps: int
    episodes: int


PAPER = Size({}, 8, (240, 320), ((120, 160), (240, 320)), 7, 200, 30, 4)
QUICK = Size(
    {"dim": 32, "feedforward": 32, "heads": 2, "encoder_layers": 1, "cvae_layers": 1, "backbone_width": 8},
    *(2, (64, 64), ((30, 40),), 2, 6, 2, 1),
)


COMPACT: dict[str, Any] = {
    **{"dim": 256, "feedforward": 1024, "decoder_layers": 2, "cvae_layers": 2, "dropout": 0.0, "backbone_width": 32},
    **{"backbone_stem": "unshuffle", "backbone_norm": "batch", "camera_embedding": True, "position_in_values": True},
    **{"keypoints": 32, "state_dropout": 0.5, "image_shift": 2},
}
"""The network of `configs/compact.yaml`."""


class Pace(NamedTuple):
    """How long a workload takes.

    Args:
        seconds: median wall-clock time.
        cpu_seconds: median processor time, all threads together; with one thread, what an idle machine would take.
    """

    seconds: float
    cpu_seconds: float


class Measurement(NamedTuple):
    """One line of the report.

    Args:
        name: what was measured.
        value: the median, in `unit`.
        unit: of all that follow, but for the ratio.
        cpu: the same by processor time instead of wall-clock time; None where several processes work.
        arithmetic: how long its floating-point operations take in large matrix products, measured in turns with it:
            about what no exact change of the program undercuts; None where they are not counted.
        reference: the median of what it is compared with, measured in turns with it; None where there is nothing.
        ratio: how many times better than the reference; None without one.
        aim: what the project promises, as a sentence fragment.
    """

    name: str
    value: float
    unit: str
    cpu: float | None = None
    arithmetic: float | None = None
    reference: float | None = None
    ratio: float | None = None
    aim: str = ""


def take_turns(workloads: dict[str, Callable[[], Any]], rounds: int) -> dict[str, Pace]:
    """Time workloads one after the other in every round, so that a busy machine slows all alike.

    Args:
        workloads: by name; each is called once more beforehand, to warm up.
        rounds: how many times each is timed; the median counts.
    """
    for run in workloads.values():
        run()
    wall: dict[str, list[float]] = {name: [] for name in workloads}
    processor: dict[str, list[float]] = {name: [] for name in workloads}
    for _ in range(rounds):
        for name, run in workloads.items():
            start, start_processor = time.perf_counter(), time.process_time()
            run()
            wall[name].append(time.perf_counter() - start)
            processor[name].append(time.process_time() - start_processor)
    return {name: Pace(statistics.median(wall[name]), statistics.median(processor[name])) for name in workloads}


def measure_training(size: Size) -> Iterator[Measurement]:
    """A training step, losses to optimiser, against the original arithmetic."""
    policy, reference = _networks(size)
    batch = _batch(size)
    pixels = (batch.images / 255).contiguous()  # (B, V, 3, H, W), as the original's data set delivers them
    ours = torch.optim.AdamW(policy.parameters(), lr=1e-5, weight_decay=1e-4, fused=True)
    theirs = torch.optim.AdamW(reference.parameters(), lr=1e-5, weight_decay=1e-4)

    def step() -> None:
        ours.zero_grad()
        policy.losses(batch)["loss"].backward()
        ours.step()

    def reference_step() -> None:
        theirs.zero_grad()
        reference.loss(pixels, batch.state, batch.actions, batch.valid).backward()
        theirs.step()

    yield _measure(f"training step, {_describe(size)}", step, reference_step, size.rounds, "at least 3.3 times faster")


def measure_compact_step(size: Size) -> Iterator[Measurement]:
    """A whole training step of `configs/uncert.yaml`."""
    size = size._replace(batch=2 * size.batch, image_size=(size.image_size[0] // 2, size.image_size[1] // 2))
    torch.manual_seed(0)
    policy = ACT(refine=Uncertainty(), **{**COMPACT, **size.act})
    policy.set_statistics(_statistics())
    step = partial(compact_step, policy, compact_optimizer(policy), _batch(size))
    yield _measure(f"compact training step, {_describe(size)}", step, None, size.rounds, "")


def compact_optimizer(policy: ACT) -> torch.optim.Optimizer:
    """The optimiser of `configs/compact.yaml`."""
    return torch.optim.AdamW(policy.parameters(), lr=3e-4, weight_decay=1e-4, fused=True)


def compact_step(policy: ACT, optimizer: torch.optim.Optimizer, batch: Batch) -> None:
    """A training step as `configs/compact.yaml` takes it."""
    optimizer.zero_grad()
    policy.losses(batch)["loss"].backward()
    torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
    optimizer.step()


def measure_query(size: Size) -> Iterator[Measurement]:
    """One query of one observation, against the original arithmetic."""
    policy, reference = _networks(size)
    policy.eval()
    reference.eval()
    batch = _batch(size._replace(batch=1))
    observation, pixels = batch.observation, (batch.images / 255).contiguous()
    latent = torch.zeros(1, policy.latent_dim)

    @torch.no_grad()
    def reference_query() -> None:
        reference(pixels, batch.state, latent)

    query = partial(policy.for_inference().predict, observation)  # as rollouts query it
    name = f"one query, {_describe(size._replace(batch=1))}"
    yield _measure(name, query, reference_query, 3 * size.rounds, "at most 50 ms")


def measure_data(size: Size) -> Iterator[Measurement]:
    """Samples per second and thread that reach the policy, from each cache, against decoding every time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            paths = [write_made_up(Path(folder), index, size.frames, size.image_size) for index in range(2)]
            episodes = list(map(read_episode, paths))
            caches: tuple[Cache, ...] = ("ram", "memmap", "none")
            fetch: dict[str, Callable[[], None]] = {cache: _fetch(episodes, cache, size) for cache in caches}
            paces = take_turns(fetch, size.rounds)
    finally:
        torch.set_num_threads(threads)
    samples = 8 * size.batch
    reference = samples / paces["none"].seconds
    for cached in ("ram", "memmap"):
        name = f"data path, one thread, cache {cached}, {_dimensions(size.image_size)}"
        rate, cpu_rate = samples / paces[cached].seconds, samples / paces[cached].cpu_seconds
        yield Measurement(name, rate, "samples/s", cpu_rate, None, reference, rate / reference, "at least 2500")


def measure_simulation(size: Size, processes: int) -> Iterator[Measurement]:
    """A control step with its three pictures, and episodes per minute: of the expert, and of holding still.

    Args:
        size: what to simulate.
        processes: simulators that run episodes side by side; compared with one, in turns.

    Raises:
        RenderError: SAPIEN cannot render here.
        SimulationError: a simulator does not start.
    """
    for image_size in size.control_sizes[1:]:
        with Worker(partial(Stopwatch, image_size), "benchmark process") as worker:
            worker.receive()
            yield _control_step(worker, image_size, size)
    image_size = size.control_sizes[0]
    workers = [Worker(partial(Stopwatch, image_size), f"benchmark process {i + 1}") for i in range(processes)]
    try:
        start_all(workers)
        yield _control_step(workers[0], image_size, size)
        yield _episode_rate(workers, "expert", image_size, size)
        yield _episode_rate(workers, "zero", image_size, size)
    finally:
        for worker in workers:
            worker.kill()


class Stopwatch:
    """A simulator in a process of its own that times itself.

    Args:
        image_size: (H, W).
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self._simulator = open_simulator(TASK, image_size=image_size)

    def control_step(self, steps: int, rounds: int) -> Pace:
        """How long a control step takes: median over the rounds of the mean over the steps."""
        action = self._simulator.reset(0).commanded
        hold = {"hold": lambda: [self._simulator.step(action) for _ in range(steps)]}
        pace = take_turns(hold, rounds)["hold"]
        return Pace(pace.seconds / steps, pace.cpu_seconds / steps)

    def episodes(self, policy: Literal["expert", "zero"], count: int, first_seed: int) -> int:
        """Run episodes, each step with its pictures; returns the control steps they took."""
        steps = 0
        for seed in range(first_seed, first_seed + count):
            home = self._simulator.reset(seed).commanded
            held = (home for _ in range(self._simulator.horizon))
            for action in held if policy == "zero" else (planned.action for planned in self._simulator.expert()):
                self._simulator.step(action)
                steps += 1
        return steps


def _networks(size: Size) -> tuple[ACT, ReferenceACT]:
    torch.manual_seed(0)
    policy = ACT(decoder_readout="first", reconstruction="l1", **size.act)  # type: ignore[arg-type]
    policy.backbone.pretrained.fill_(True)  # random weights are as fast as trained ones
    policy.set_statistics(_statistics())
    return policy, ReferenceACT(**size.act)


def _statistics() -> Statistics:
    zeros, ones = torch.zeros(STATE_DIM), torch.ones(STATE_DIM)
    return Statistics(*(zeros, ones, -ones, ones) * 2)


def _batch(size: Size) -> Batch:
    generator = torch.Generator().manual_seed(0)
    pixels = (size.batch, len(CAMERAS), *size.image_size, 3)
    images = torch.randint(256, pixels, generator=generator, dtype=torch.uint8).permute(0, 1, 4, 2, 3)
    state = torch.randn(size.batch, STATE_DIM, generator=generator)
    actions = torch.randn(size.batch, 50, ACTION_DIM, generator=generator)
    index = torch.arange(size.batch)
    return Batch(images, state, actions, torch.ones(size.batch, 50, dtype=torch.bool), index, index)


def _fetch(episodes: list[Episode], cache: Cache, size: Size) -> Callable[[], None]:
    """Eight batches of random frames."""
    data = ChunkDataset(episodes, open_frames(episodes, cache))
    generator = np.random.default_rng(0)

    def fetch() -> None:
        for _ in range(8):
            data.__getitems__(generator.integers(len(data), size=size.batch).tolist())

    return fetch


def _control_step(worker: Worker, image_size: tuple[int, int], size: Size) -> Measurement:
    worker.send("control_step", size.control_steps, size.rounds)
    pace = worker.receive(EPISODE_TIMEOUT_S)
    aim = "at most 12 ms" if image_size == (120, 160) else ""
    name = f"control step, 3 cameras {_dimensions(image_size)}"
    return Measurement(name, 1e3 * pace.seconds, "ms", 1e3 * pace.cpu_seconds, aim=aim)


def _episode_rate(
    workers: list[Worker], policy: Literal["expert", "zero"], image_size: tuple[int, int], size: Size
) -> Measurement:
    """Episodes per minute of all processes, against those of the first alone."""
    steps: list[int] = []

    def play(crew: list[Worker]) -> None:
        for index, worker in enumerate(crew):
            worker.send("episodes", policy, size.episodes, index * size.episodes)
        steps[:] = [worker.receive(EPISODE_TIMEOUT_S) for worker in crew]

    crews = {"one": workers[:1]} | ({"all": workers} if len(workers) > 1 else {})
    paces = take_turns({name: partial(play, crew) for name, crew in crews.items()}, -(-size.rounds // 3))
    length = sum(steps) / (len(steps) * size.episodes)
    rates = {name: 60 * len(crew) * size.episodes / paces[name].seconds for name, crew in crews.items()}
    count = "1 process" if len(workers) == 1 else f"{len(workers)} processes"
    name = f"{policy}: episodes of {length:.0f} steps, {_dimensions(image_size)}, {count}"
    if len(workers) == 1:
        return Measurement(name, rates["one"], "episodes/min")
    aim = "at least 1.8 times one's" if len(workers) == 2 else ""
    ratio = rates["all"] / rates["one"]
    return Measurement(name, rates["all"], "episodes/min", reference=rates["one"], ratio=ratio, aim=aim)


def _measure(
    name: str, ours: Callable[[], Any], reference: Callable[[], Any] | None, rounds: int, aim: str
) -> Measurement:
    """Time a workload of the network in turns with the reference and with its floating-point operations alone."""
    side = 1024
    factor = torch.randn(side, side)

    def multiply() -> None:
        with torch.no_grad(), autocast("auto", factor.device):
            _ = factor @ factor

    with FlopCounterMode(display=False) as counter:
        ours()
    products = counter.get_total_flops() / (2 * side**3)
    workloads = {"ours": ours, "product": multiply} | ({"reference": reference} if reference else {})
    paces = take_turns(workloads, rounds)
    took, alone = paces["ours"], 1e3 * products * paces["product"].seconds
    measured = Measurement(name, 1e3 * took.seconds, "ms", 1e3 * took.cpu_seconds, alone, aim=aim)
    if reference is None:
        return measured
    compared = paces["reference"].seconds
    return measured._replace(reference=1e3 * compared, ratio=compared / took.seconds)


def _describe(size: Size) -> str:
    return f"batch {size.batch}, {len(CAMERAS)} cameras {_dimensions(size.image_size)}"


def _dimensions(image_size: tuple[int, int]) -> str:
    return f"{image_size[1]}x{image_size[0]}"
