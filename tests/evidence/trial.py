"""What a piece of evidence is made of: trials, commands in processes of their own, and folders that are compared."""

import hashlib
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ugr_lightning.cli.main import main

TIMEOUT_S = 900.0


class NotHereError(Exception):
    """This machine does not allow what a trial needs; the message says what that is."""


@dataclass(frozen=True)
class Piece:
    """One row of the table.

    Args:
        name: for `--only`.
        does: what is done to the package.
        holds: what has to come out.
        count: how many trials.
        trial: one of them, given an empty folder and its number, which seeds its choices; returns a note, and raises
            an AssertionError where the promise does not hold.
    """

    name: str
    does: str
    holds: str
    count: int
    trial: Callable[[Path, int], str]


def chance(name: str, number: int) -> np.random.Generator:
    """The random numbers of one trial."""
    return np.random.default_rng([number, *name.encode()])


class Command:
    """`ugr` at work in a folder, in a process of its own that is forked: nothing has to be imported again.

    Args:
        words: its arguments.
        folder: the working folder; what the command says goes into a file beside it.
    """

    def __init__(self, words: list[str], folder: Path) -> None:
        self.words = words
        self._said = folder.with_name(f"{folder.name}.{time.monotonic_ns()}.log")
        self.process = get_context("fork").Process(target=_run, args=(words, folder, self._said))
        self.process.start()

    def end(self, *codes: int) -> str:
        """Wait for it; what it said.

        Raises:
            AssertionError: another exit code than these (0 where none is given), a traceback, or no end.
        """
        self.process.join(TIMEOUT_S)
        if self.process.exitcode is None:
            self.process.kill()
        said = self._said.read_text(errors="replace") if self._said.is_file() else ""
        about = f"ugr {' '.join(self.words)}: exit code {self.process.exitcode}, said ...{said[-1500:]}"
        assert self.process.exitcode in (codes or (0,)), about
        assert "Traceback" not in said, about
        return said

    def kill_after(self, begun: Callable[[], bool], seconds: float) -> bool:
        """SIGKILL it some time after its work has begun; whether it was still at it."""
        while self.process.exitcode is None and not begun():
            time.sleep(0.002)
        self.process.join(seconds)
        self.process.kill()
        self.process.join()
        return self.process.exitcode == -signal.SIGKILL


def _run(words: list[str], folder: Path, said: Path) -> None:
    os.chdir(folder)
    with said.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    code = 1
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)


def ugr(words: list[str], folder: Path, *codes: int) -> str:
    """Run `ugr` in a folder to its end, see `Command.end`."""
    return Command(words, folder).end(*codes)


def content(folder: Path) -> dict[str, str]:
    """The hash of every file of a folder but locks, by its path within it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock")
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def size_of(folder: Path) -> int:
    """Bytes that the files of a folder take on a disk, links counted once."""
    found = {stat.st_ino: stat.st_blocks * 512 for stat in map(Path.stat, folder.rglob("*"))}
    return sum(found.values())


def assert_same(expected: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Compare two outcomes by name.

    Raises:
        AssertionError: names what differs.
    """
    names = sorted(expected.keys() | found.keys())
    differ = [name for name in names if name not in expected or name not in found or expected[name] != found[name]]
    assert not differ, f"not as in the undisturbed run: {', '.join(differ[:8])}"


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Callable[[str], None]]:
    """A disk of a few bytes in memory, mounted on a folder; yields what mounts it again with other options."""
    folder.mkdir(parents=True, exist_ok=True)

    def mount(*words: str) -> None:
        done = subprocess.run(["mount", *words, str(folder)], capture_output=True, text=True, check=False)
        if done.returncode:
            raise NotHereError(f"mounting needs root: {done.stderr.strip()}")

    mount("-t", "tmpfs", "-o", f"size={size}", "tmpfs")
    try:
        yield lambda options: mount("-o", f"remount,{options}")
    finally:
        subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False)
