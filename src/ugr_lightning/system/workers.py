"""A fresh Python process that holds one object and answers calls to its methods, and that may crash or hang.

Simulators live in processes of their own: rendering is single-threaded, and a fault in it takes its process along.
Started as `python -c`, not through `multiprocessing`: that would run the caller's main module again in every worker.
"""

import os
import pickle
import signal
import subprocess
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing import Pipe, connection
from pathlib import Path
from typing import Any, Self

from ugr_lightning.errors import SimulationError, UGRError

START_TIMEOUT_S = 300.0
"""Imports and the first picture take about five seconds on a free machine; far longer on a crowded one."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Without it a simulator's small tensor operations spend 20 ms a step on waking threads."""

_PACKAGED = (str(Path(__file__).parents[1]), sysconfig.get_path("stdlib"), "<")
"""How the paths of files begin that are not the user's, nor are those of installed packages."""


class WorkerLostError(Exception):
    """The process of a worker has died or no longer answers; the message says which."""


class Worker:
    """A process with one object in it; a context manager. It answers calls in the order in which they were sent.

    Args:
        build: called in the process to make the object; must be importable there (a module-level class or function,
            or a `functools.partial` of one).
        name: how to call it in messages.
    """

    def __init__(self, build: Callable[[], Any], name: str = "worker") -> None:
        self.name = name
        self._build = pickle.dumps(build)
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: connection.Connection | None = None
        self.outstanding = 0
        """Calls that have not been answered."""

    def __enter__(self) -> Self:
        self.launch()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int | None:
        """Process id, None when it does not run."""
        return self._process.pid if self._process else None

    def launch(self) -> None:
        """Start the process, without waiting for it; the first reply to `receive` says that the object exists."""
        self.kill()
        ours, theirs = Pipe()
        fd = theirs.fileno()
        code = f"import sys; sys.path[:] = {sys.path!r}; from ugr_lightning.system.workers import serve; serve({fd})"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            stdout=2,  # what a simulator prints is not the result of the program
            pass_fds=[fd],
            env=os.environ | ONE_THREAD,
            process_group=0,  # Ctrl-C reaches the parent only, which ends its workers in order
        )
        theirs.close()
        self._connection, self.outstanding = ours, 1
        ours.send_bytes(self._build)

    def send(self, method: str, *args: Any) -> None:
        """Call a method of the object, without waiting for it."""
        try:
            self._open().send((method, args))
            self.outstanding += 1
        except OSError as error:
            raise self._lost() from error

    def receive(self, timeout_s: float = START_TIMEOUT_S) -> Any:
        """The return value of the oldest call without one, or None as the first reply after a launch.

        Raises:
            WorkerLostError: the process has died, or did not answer in time and was killed.
            UGRError: what the method raised; an exception of another kind arrives as a SimulationError.
        """
        link = self._open()
        try:
            if not link.poll(timeout_s):
                raise self.hung(timeout_s)
            value, error = link.recv()
            self.outstanding -= 1
        except (OSError, EOFError) as failure:
            raise self._lost() from failure
        if error is not None:
            raise error
        return value

    def hung(self, timeout_s: float) -> WorkerLostError:
        """Kill the process because it has not answered in time; returns the error that says so."""
        self.kill()
        return WorkerLostError(f"{self.name} did not answer within {timeout_s:.0f} s and was killed")

    def kill(self) -> None:
        """End the process at once and reap it; files that it writes appear by rename, so none is left half-written."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process = self._connection = None

    def _open(self) -> connection.Connection:
        if self._connection is None:
            raise WorkerLostError(f"{self.name} does not run")
        return self._connection

    def _lost(self) -> WorkerLostError:
        status = None
        if self._process is not None:
            try:  # the pipe closes a moment before the process can be reaped
                status = self._process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                status = None
        self.kill()
        if status is not None and status < 0:
            name = signal.Signals(-status).name
            reason = ", as the system does when memory runs out" if name == "SIGKILL" else ""
            return WorkerLostError(f"{self.name} was ended by {name}{reason}")
        return WorkerLostError(f"{self.name} ended with exit code {status}")


def wait_for_any(workers: Sequence[Worker], timeout_s: float) -> list[Worker]:
    """Those workers that have answered or died; empty when none has within the time."""
    links = {worker._open(): worker for worker in workers}
    return [links[link] for link in connection.wait(list(links), timeout_s)]  # type: ignore[index]


def start_all(workers: Sequence[Worker]) -> None:
    """Start workers side by side and wait until each has built its object; one that does not is started once more.

    Raises:
        SimulationError: one died or hung both times.
        UGRError: what building the object raised.
    """
    for worker in workers:
        worker.launch()
    for worker in workers:
        for last in (False, True):
            try:
                worker.receive(START_TIMEOUT_S)
                break
            except WorkerLostError as error:
                if last:
                    fix = "Run `ugr doctor`: it tests rendering apart and says what to install."
                    raise SimulationError(worker.name, "a simulator process that starts", error, fix) from error
                worker.launch()


def serve(fd: int) -> None:
    """Body of the worker process: build the object, then answer calls until the parent closes the pipe or dies."""
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    link = connection.Connection(fd)
    try:
        served = _answer(link, lambda: (pickle.loads(link.recv_bytes())(), None))
        while served is not None:
            method, args = link.recv()
            _answer(link, lambda method=method, args=args: (None, getattr(served, method)(*args)))  # type: ignore[misc]
    except (EOFError, OSError):
        pass  # the parent has closed the pipe: this is how a worker is told to end
    os._exit(0)  # the teardown of a renderer may hang


def _answer(link: connection.Connection, call: Callable[[], tuple[Any, Any]]) -> Any:
    try:
        kept, value = call()
    except UGRError as error:
        link.send((None, error))
        return None
    except Exception as error:
        where, fix = "simulator process", "Report this with its command."
        if line := _users_line(error):
            where, fix = line.filename, "Correct the file."
        link.send((None, SimulationError(where, "no fault", describe_error(error), fix)))
        return None
    link.send((value, None))
    return kept


def describe_error(error: Exception) -> str:
    """One line on an exception: a user's error as it is, another one with its kind and place, the user's if any."""
    if isinstance(error, UGRError):
        return str(error)
    told = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):  # says its place itself
        return told
    place = _users_line(error) or traceback.extract_tb(error.__traceback__)[-1]
    return f"{told} ({os.path.basename(place.filename)}, line {place.lineno})"


def _users_line(error: Exception) -> traceback.FrameSummary | None:
    """The innermost line of a file of the user's that an exception went through; None where it is all in packages."""
    frames = traceback.extract_tb(error.__traceback__)
    return next((frame for frame in reversed(frames) if not _is_packaged(frame.filename)), None)


def _is_packaged(file: str) -> bool:
    return file.startswith(_PACKAGED) or not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)


def _end_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
