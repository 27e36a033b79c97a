"""Signals that end a process in order: what it has started is ended, what it has written aside is removed."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(KeyboardInterrupt):
    """A signal has asked this process to end.

    Args:
        number: of the signal.
        note: what is worth knowing about how far it came.
    """

    def __init__(self, number: int, note: str = "") -> None:
        super().__init__(signal.Signals(number).name)
        self.signal, self.note = signal.Signals(number), note

    def __str__(self) -> str:
        return f"{self.signal.name} {self.note}".strip()

    @property
    def exit_code(self) -> int:
        """128 and the signal's number, as shells have it."""
        return 128 + self.signal


@contextmanager
def stoppable() -> Iterator[None]:
    """Within this context SIGINT, SIGTERM and SIGHUP raise `Stopped`; once one has, only SIGINT can press further.

    SIGINT also where it was ignored at the start, as a script's `&` has it: `kill -INT` is meant. An ignored SIGHUP is
    `nohup`, and stays ignored.
    """
    stopping = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopping
        if stopping and number != signal.SIGINT:
            return
        stopping = True
        raise Stopped(number)

    with handled(stop):
        yield


@contextmanager
def handled(handler: Any) -> Iterator[None]:
    """Within this context the three signals go to a handler, except a SIGHUP that is ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number, previous in before.items():
        if number != signal.SIGHUP or previous != signal.SIG_IGN:
            signal.signal(number, handler)
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, signal.SIG_DFL if previous is None else previous)


def deaf_to_signals(worker: int = 0) -> None:
    """Leave the signals of a terminal or a cluster to the process that started this one, and ends it in its time."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
