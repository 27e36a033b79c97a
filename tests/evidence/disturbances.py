"""What is done to a command that writes: it is killed, its disk is full or cannot be written, another does the same."""

import functools
import itertools
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jobs import DECODED, EVALUATED, RECORDED, TRAINED, Job, converted, fit, trained
from trial import Command, Piece, assert_same, chance, content, size_of, small_disk, ugr

KILLED = {"training": TRAINED, "recording": RECORDED, "evaluation": EVALUATED, "conversion": converted("lerobot")}
WRITING = [TRAINED, DECODED, RECORDED, EVALUATED, *map(converted, ("robotwin", "act", "original-act", "lerobot"))]
MOMENTS = 5
PAGE = 4096


@functools.cache
def _undisturbed(job: Job, folder: Path) -> tuple[dict[str, Any], float, int]:
    """What a job comes to when nobody disturbs it, the seconds of its work, and the bytes that it writes."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    job.prepare(folder)
    before = size_of(folder)
    command, start = Command(job.words(folder), folder), 0.0
    while command.process.exitcode is None:
        if not start and job.begun(folder):
            start = time.monotonic()
        time.sleep(0.002)
    seconds = time.monotonic() - start
    command.end()
    return job.outcome(folder), seconds, size_of(folder) - before


def undisturbed(job: Job, trial: Path) -> tuple[dict[str, Any], float, int]:
    """The same for all trials of one run of this program; `trial` is the folder of one, `WORK/KIND/JOB/NUMBER`."""
    return _undisturbed(job, trial.parents[2] / "undisturbed" / job.name)


def killed(job: Job, folder: Path, number: int) -> str:
    """SIGKILL at a random moment of the work, then the command that goes on; earlier where the work had ended."""
    expected, seconds, _ = undisturbed(job, folder)
    moment = float(chance(job.name, number).uniform(0, seconds))
    for place in (folder / str(attempt) for attempt in itertools.count()):
        place.mkdir()
        job.prepare(place)
        if Command(job.words(place), place).kill_after(functools.partial(job.begun, place), moment):
            break
        moment /= 2
    ugr(job.again(place), place)
    assert_same(expected, job.outcome(place))
    return f"{moment:.2f} of {seconds:.2f} s"


def full_disk(job: Job, folder: Path, number: int) -> str:
    """A disk with room for a random part of what is written; then room, and the command that goes on."""
    expected, _, size = undisturbed(job, folder)
    share = float(chance(job.name, number).uniform(0.05, 0.95))
    with small_disk(folder, 1 << 30) as mount:
        job.prepare(folder)
        before = content(folder)
        room = size_of(folder) + int(share * size) // PAGE * PAGE
        mount(f"size={room}")
        said = ugr(job.words(folder), folder, 2)
        assert before.items() <= content(folder).items(), "what was there before is no longer as it was"
        mount(f"size={1 << 30}")
        ugr(job.again(folder), folder)
        assert_same(expected, job.outcome(folder))
    return f"{share:.0%} fit: {said.strip().splitlines()[-1][:160]}"


def read_only(job: Job, folder: Path, number: int) -> str:
    """A folder that nothing can be written to, at the start."""
    with small_disk(folder, 1 << 30) as mount:
        job.prepare(folder)
        before = content(folder)
        mount("ro")
        said = ugr(job.words(folder), folder, 2)
        assert content(folder) == before
    return said.strip().splitlines()[-1][:160]


def twice_at_once(job: Job, folder: Path, number: int) -> str:
    """The same command twice at once; the one that is refused, if one is, is told so in a sentence."""
    expected, _, _ = undisturbed(job, folder)
    job.prepare(folder)
    both = [Command(job.words(folder), folder) for _ in range(2)]
    said = [command.end(0, 2) for command in both]
    codes = sorted(command.process.exitcode or 0 for command in both)
    assert codes[0] == 0, f"both were refused: {said}"
    assert_same(expected, job.outcome(folder))
    return "both ended with 0" if codes == [0, 0] else "one was refused"


def two_trainings_at_once(folder: Path, number: int) -> str:
    """Two trainings of one name: each has a folder of its own and is the one it would be alone."""
    expected = undisturbed(TRAINED, folder)[0]
    TRAINED.prepare(folder)
    for command in [Command(fit()(folder), folder) for _ in range(2)]:
        command.end()
    for version in (0, 1):
        assert_same(expected, trained(folder, version))
    return "a folder each"


def one_run_gone_on_with_twice_at_once(folder: Path, number: int) -> str:
    """Two processes go on with one run: one does, the other is refused."""
    expected = undisturbed(TRAINED, folder)[0]
    TRAINED.prepare(folder)
    ugr(fit("--trainer.max_steps", "3")(folder), folder)
    both = [Command(TRAINED.again(folder), folder) for _ in range(2)]
    said = [command.end(0, 2) for command in both]
    assert_same(expected, trained(folder, 0))
    refused = [command.process.exitcode for command in both].count(2)
    assert refused == 1, said
    return "one was refused"


def _pieces(
    what: str, does: str, holds: str, trial: Callable[[Job, Path, int], str], jobs: dict[str, Job], count: int
) -> Iterator[Piece]:
    for name, job in jobs.items():
        yield Piece(f"{what}/{name}", f"{does}: {name}", holds, count, functools.partial(trial, job))


PIECES = [
    *_pieces(
        "killed", "SIGKILL at a random moment", "gone on with, all that it writes is the same, bit for bit",
        killed, KILLED, MOMENTS,
    ),
    *_pieces(
        "full", "the disk runs full", "exit code 2 and a sentence; nothing lost; with room again, the same bit for bit",
        full_disk, {job.name: job for job in WRITING}, 3,
    ),
    *_pieces(
        "read-only", "a folder that is read-only", "exit code 2 and a sentence; nothing changed",
        read_only, {job.name: job for job in WRITING}, 1,
    ),
    *_pieces(
        "twice", "the same command twice at once", "both, or one and a refusal; the outcome as of one",
        twice_at_once, {job.name: job for job in WRITING}, 2,
    ),
    Piece("twice/run", "two trainings of a name at once", "a folder each, each as if alone", 2, two_trainings_at_once),
    Piece(
        "twice/resumed run", "a run gone on with by two at once", "one does, one is refused", 2,
        one_run_gone_on_with_twice_at_once,
    ),
]  # fmt: skip
