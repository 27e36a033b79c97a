"""One progress line with the time left: drawn on a terminal, plain lines where the output is piped."""

import sys
import time
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

PLAIN_INTERVAL_S = 5.0


class Progress:
    """Counts episodes towards a total; a context manager.

    Args:
        title: what is being counted.
        total: how many there will be.
        done: how many there were before; they do not enter the estimate of the time left.
        shown: False keeps silent.
        stream: where to write; standard error by default.
    """

    def __init__(
        self, title: str, total: int, *, done: int = 0, shown: bool = True, stream: TextIO | None = None
    ) -> None:
        self._title, self._total, self._done, self._shown = title, total, done, shown
        self._stream = stream if stream is not None else sys.stderr
        self._already, self._note = done, ""
        self._start = self._last_line = time.monotonic()
        self._bar: Bar | None = None

    def __enter__(self) -> Self:
        if self._shown and self._stream.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            console = Console(file=self._stream)
            self._bar = Bar(
                *columns, TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console
            )
            self._task = self._bar.add_task(self._title, total=self._total, completed=self._done, note="")
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, note: str = "") -> None:
        """Count one more.

        Args:
            note: what to say behind the count, for example the success rate so far.
        """
        self._done, self._note = self._done + 1, note
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, note=note)
        elif self._shown:
            now = time.monotonic()
            if self._done >= self._total or now - self._last_line >= PLAIN_INTERVAL_S:
                self._last_line = now
                print(self._line(now), file=self._stream, flush=True)

    def message(self, text: str) -> None:
        """Say something without disturbing the line; said even where the progress itself is not shown."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False)
        else:
            print(text, file=self._stream, flush=True)

    def _line(self, now: float) -> str:
        new = self._done - self._already
        elapsed = now - self._start
        left = elapsed / new * (self._total - self._done) if new else 0.0
        line = f"{self._title}: {self._done}/{self._total}, {clock(elapsed)} elapsed, {clock(left)} left"
        return f"{line}, {self._note}" if self._note else line


def clock(seconds: float) -> str:
    """A time span as `m:ss` or `h:mm:ss`."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}" if minutes >= 60 else f"{minutes}:{seconds:02d}"
