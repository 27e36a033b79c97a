"""Errors of the system and of libraries that a user can solve, as sentences."""

import errno
import os
import traceback
from collections.abc import Iterator

from ugr_lightning.cli.parsing.config import explain
from ugr_lightning.errors import ConfigError, UGRError

_DISK = {
    errno.ENOSPC: "Make room, or choose another folder; what was complete is whole, and the same command goes on.",
    errno.EDQUOT: "Make room within your quota, or choose another folder; what was complete is whole.",
    errno.EROFS: "Choose another folder.",
    errno.EACCES: "Correct the permissions, or choose another folder.",
    errno.EPERM: "Correct the permissions, or choose another folder.",
    errno.EMFILE: "Raise the limit of open files: `ulimit -n 4096`.",
    errno.ENOTDIR: "Choose another path: a part of it is a file.",
    errno.EEXIST: "Choose another path: a part of it is a file.",
    errno.EISDIR: "Name a file, not a folder.",
    errno.ENOTEMPTY: "Choose another name.",
    errno.ENAMETOOLONG: "Choose a shorter name.",
    errno.ELOOP: "Choose another path: a link in it leads to itself.",
    errno.EIO: "Look at the system's log: the disk may be failing.",
}


def explain_disk(error: OSError | RuntimeError) -> UGRError | None:
    """The error for a disk that is full or a place that is none, whatever was being done; None for others.

    Args:
        error: as the system raised it, and nobody nearer has explained; or pathlib, of a link that leads to itself.
    """
    if isinstance(error, RuntimeError):
        looping = str(error).startswith("Symlink loop")  # an OSError from Python 3.13 on
        return ConfigError("the path", "a file or folder", error, _DISK[errno.ELOOP]) if looping else None
    if error.errno not in _DISK:
        return None
    where, got = error.filename2 or error.filename or "the disk", os.strerror(error.errno)
    return ConfigError(where, "a file that can be read and written", got, _DISK[error.errno])


def explain_training(error: Exception) -> UGRError | None:
    """The error for what ends a training and is no fault in it; None for others.

    Args:
        error: as PyTorch or Lightning raised it.
    """
    from torch import OutOfMemoryError

    if isinstance(error, UGRError):
        return None
    got = " ".join(str(error).split())[:600]
    if isinstance(error, RuntimeError) and got.startswith("DataLoader worker"):
        fix = "Memory has run out, or in a container shared memory (`docker run --shm-size 8g`): give fewer, or 0."
        return ConfigError("data.num_workers", "loader processes that stay alive", got, fix)
    if isinstance(error, (OutOfMemoryError, MemoryError)) or "can't allocate memory" in got:
        fix = "Give a smaller batch or `--data.image_size`; frames need none with `--data.cache memmap`."
        return ConfigError("data.batch_size", "a training that fits into memory", got, fix)
    ours = next((cause for cause in _causes(error.__cause__) if isinstance(cause, UGRError)), None)
    if ours is not None:  # a class refused its arguments, and its name in a config or a union was all that was told
        return ours
    missing = next((cause for cause in _causes(error) if isinstance(cause, ImportError)), None)
    if missing is not None:
        fix = "Install it, or leave out what needs it."
        return ConfigError("ugr fit", "the packages that its config needs", missing, fix)
    if _raised_by(error, "jsonargparse."):  # what it says of a class whose constructor refused
        return explain(error, None)
    if _raised_by(error, "lightning.", "lightning_"):
        fix = "Correct what it names, in the config or behind `--trainer`."
        return ConfigError("ugr fit", "settings that Lightning can work with", got, fix)
    return None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it was raised from."""
    while error is not None:
        yield error
        error = error.__cause__


def _raised_by(error: Exception, *names: str) -> bool:
    """Whether a package itself has raised an error, and not what it called."""
    if isinstance(error, OSError) or error.__traceback__ is None:
        return False
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).startswith(names)
