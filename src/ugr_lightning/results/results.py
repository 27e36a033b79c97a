"""Results of closed-loop episodes: one JSON line each, and what they add up to."""

import fcntl
import json
import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ugr_lightning.errors import DataError
from ugr_lightning.results.tables import as_text
from ugr_lightning.system.lock import flock
from ugr_lightning.system.records import read_record

Z_95 = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


@dataclass
class EpisodeResult:
    """One closed-loop episode, as written to a results file (one JSON line each).

    Args:
        task: task name.
        setting: scene setting, `demo_clean` or `demo_randomized`.
        seed: simulator seed.
        seeds_hash: SHA-256 of the seed list the episode belongs to.
        policy: what acted: a checkpoint's policy class, with the budget where that was chosen, such as
            `ACT(refine_ratio=0.5)`; or `zero`, `random`, `expert`.
        checkpoint: SHA-256 of the checkpoint file, or None.
        execution: `aggregate`, `aggregate-variance` (aggregated with inverse variance), or the number of steps executed
            of each chunk.
        success: whether the task's condition was met before the horizon; a crashed episode has False.
        steps: control steps executed.
        first_success_step: first step at which the condition was met, or None.
        motion_hash: SHA-256 of the measured joints of all steps; equal for episodes that went the same way bit for bit.
        log_variance: summary of s_k over the episode (mean, max), empty where the policy has none.
        seconds: wall-clock seconds by part (`query`, `simulate`).
        video: path of the recorded video, or None.
        crash: why the simulator or the policy failed, or None.
        refine_ratio: share of each chunk that was refined, where it was chosen for the rollout; None where it was that
            of the training, and in files from before there was this field.
        queries: chunks that were predicted; None for an actor without chunks, and in files from before this field.
        disagreement: highest of a chunk with earlier ones, see `rollout.overlap`; 0 where none overlapped, None for an
            actor without chunks and in files from before this field.
        alarm: control step of the first alarm; None where none was raised.
        alarm_rate: share of successes, at most, in which the alarm is raised that watched; None where none did.
        image_size: height and width of the pictures that were looked at; None where nobody looked, and in files from
            before this field.
        refine: class of what chose the steps that were refined, such as `Uncertainty`; None where none were, and in
            files from before this field.
    """

    task: str
    setting: str
    seed: int
    seeds_hash: str
    policy: str
    checkpoint: str | None
    execution: str
    success: bool
    steps: int
    first_success_step: int | None = None
    motion_hash: str | None = None
    log_variance: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    video: str | None = None
    crash: str | None = None
    refine_ratio: float | None = None
    queries: int | None = None
    disagreement: float | None = None
    alarm: int | None = None
    alarm_rate: float | None = None
    image_size: list[int] | None = None
    refine: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain containers, ready for JSON."""
        return asdict(self)


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """95 % Wilson score interval of a success rate.

    Args:
        successes: number of successes.
        n: number of trials.

    Returns:
        lower and upper bound in 0 .. 1; (0, 1) when nothing has been tried.

    Raises:
        ValueError: successes is not within 0 .. n.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes of {n}")
    if n == 0:
        return 0.0, 1.0
    z, rate = Z_95, successes / n
    denominator = 1.0 + z * z / n
    centre = (rate + z * z / (2 * n)) / denominator
    half = z / denominator * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    # the ends are exact at 0 and n, where rounding would leave 1e-17
    return (0.0 if successes == 0 else centre - half), (1.0 if successes == n else centre + half)


class Summary(NamedTuple):
    """What a list of episodes adds up to; a crashed episode counts as a failure.

    Args:
        n: episodes.
        successes: successful episodes.
        rate: successes / n, 0 when there are none.
        low, high: 95 % Wilson interval of the rate.
        crashed: episodes in which the simulator or the policy failed.
    """

    n: int
    successes: int
    rate: float
    low: float
    high: float
    crashed: int

    def __str__(self) -> str:
        text = f"{self.successes}/{self.n} = {self.rate:.0%} [{self.low:.0%}, {self.high:.0%}]"
        return text + (f", {self.crashed} crashed" if self.crashed else "")

    def cells(self) -> tuple[str, str, str]:
        """The rate, its interval and how many crashed, as tables show them."""
        return f"{self.successes}/{self.n} = {self.rate:.1%}", f"[{self.low:.1%}, {self.high:.1%}]", str(self.crashed)


def summarize(results: Iterable[EpisodeResult]) -> Summary:
    """Count the successes of some episodes and put the 95 % Wilson interval beside the rate."""
    outcomes = [(result.success and result.crash is None, result.crash is not None) for result in results]
    n, successes = len(outcomes), sum(success for success, _ in outcomes)
    low, high = wilson_interval(successes, n)
    return Summary(n, successes, successes / n if n else 0.0, low, high, sum(crashed for _, crashed in outcomes))


def success_table(results: Sequence[EpisodeResult]) -> str:
    """A plain-text table, n and interval beside every rate: one row per (task, setting, policy, execution).

    A policy is called by its class and its selector, and by the first digits of its checkpoint where several are called
    alike.
    """
    groups: dict[tuple[str, str, tuple[str, str | None], str], list[EpisodeResult]] = {}
    names: dict[tuple[str, str | None], str] = {}
    for result in results:
        policy = (result.policy, result.checkpoint)
        groups.setdefault((result.task, result.setting, policy, result.execution), []).append(result)
        if result.refine or policy not in names:  # lines of before do not say it
            names[policy] = f"{result.policy} {result.refine or ''}".rstrip()
    called = Counter(names.values())
    rows = [("task", "setting", "policy", "execution", "success", "95 % interval", "crashed")]
    for (task, setting, policy, execution), group in groups.items():
        name = names[policy]
        name = f"{name} {(policy[1] or '')[:8]}".rstrip() if called[name] > 1 else name
        rows.append((task, setting, name, execution, *summarize(group).cells()))
    return as_text(rows)


def append_result(path: str | Path, result: EpisodeResult) -> None:
    """Append one line to a results file and force it onto the disk, so that a crash loses no finished episode."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    line = json.dumps(result.to_dict(), allow_nan=False) + "\n"
    with path.open("ab+") as file:
        flock(file.fileno(), fcntl.LOCK_EX)  # the end of the file is looked at, by `drop_cut_off_line` as well
        _end_last_line(file)
        file.write(line.encode())
        file.flush()
        os.fsync(file.fileno())


def drop_cut_off_line(path: Path) -> None:
    """Remove a last line that a crash has cut off while it was written; its episode is not finished."""
    if not path.is_file():
        return
    with path.open("rb+") as file:
        flock(file.fileno(), fcntl.LOCK_EX)
        _end_last_line(file)


def _end_last_line(file: BinaryIO) -> None:
    """Leave a locked file with whole lines only: one that is no JSON was cut off."""
    file.seek(0)
    content = file.read()
    last = content[content.rfind(b"\n") + 1 :]
    try:
        if last:
            json.loads(last)
            file.write(b"\n")
    except ValueError:
        file.truncate(len(content) - len(last))


def read_results(path: str | Path) -> list[EpisodeResult]:
    """Read a results file.

    Raises:
        DataError: the file is missing, or a line is not a result; names the file and the line.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(path, "a results file", "no such file", "Write one with `ugr rollout`.")
    fix = "Delete this line; the other lines are independent of it."
    lines = [(n, line) for n, line in enumerate(path.read_bytes().splitlines(), start=1) if line.strip()]
    return [read_record(EpisodeResult, line, f"{path}, line {number}", fix) for number, line in lines]
