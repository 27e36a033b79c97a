"""Files that are complete under their name or absent: written aside, flushed, renamed."""

import errno
import os
import platform
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

FULL_BYTES = 2**16
"""A disk with less room than this is full: libraries raise errors of many kinds then, few of which say so."""


def publish(path: Path, write: Callable[[Path], object], *, keep_ending: bool = False) -> None:
    """Write a file so that it is either complete under its name or absent, also if the power fails.

    Two processes that publish the same file do not disturb each other; the later one wins.

    Args:
        path: final file; its folder is made.
        write: writes the whole content to the path it is given, `<path>.<machine>-<process>.partial`.
        keep_ending: give it `<stem>.<machine>-<process>.partial<suffix>` instead, for writers that look at the ending.

    Raises:
        OSError: the disk is full or the folder cannot be written to, whatever `write` itself raises then.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = f"{platform.node()}-{os.getpid()}.partial"
    partial = path.with_name(f"{path.stem}.{aside}{path.suffix}" if keep_ending else f"{path.name}.{aside}")
    try:
        write(partial)
        with open(partial, "rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        full = isinstance(error, Exception) and shutil.disk_usage(path.parent).free < FULL_BYTES
        partial.unlink(missing_ok=True)
        if full and not isinstance(error, OSError):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
        raise
    flush_folder(path.parent)


def flush_folder(folder: Path) -> None:
    """Make the names in a folder last through a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def publish_text(path: Path, text: str, mode: int = 0o644) -> None:
    """Write a text file in UTF-8, complete or not at all.

    Args:
        path: final file; its folder is made.
        text: its content.
        mode: its permissions.
    """

    def write(partial: Path) -> None:
        partial.write_text(text, encoding="utf-8")
        partial.chmod(mode)

    publish(path, write)


def publish_folder(folder: Path, write: Callable[[Path], object]) -> None:
    """Write a folder so that it is either complete under its name or absent.

    Args:
        folder: absent or empty; the one above it is made.
        write: fills the empty folder it is given.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", suffix=".partial", dir=folder.parent))
    try:
        aside.chmod(0o755)
        write(aside)
        os.replace(aside, folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    flush_folder(folder.parent)


def remove_unfinished(folder: Path, pattern: str = "*") -> None:
    """Remove what processes that were killed have left of files in a folder that nobody else writes now.

    Args:
        folder: only its own files, not those of its subfolders.
        pattern: of the final names.
    """
    for leftover in folder.glob(f"{pattern}.*partial"):
        leftover.unlink(missing_ok=True)
