"""What a policy predicted in an episode, step by step, kept beside the results for analysis."""

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ugr_lightning.contract import EpisodeResult
from ugr_lightning.data.folder import publish
from ugr_lightning.errors import DataError
from ugr_lightning.rollout.lockstep import EpisodeTrace


class UncertaintyTrace(NamedTuple):
    """The uncertainty of one episode over time.

    Args:
        seed: simulator seed.
        success: whether the task was done.
        steps: control steps executed.
        query: (Q,) control steps at which a chunk was predicted.
        log_variance: (Q, K) s_k of those chunks.
        contacts: (steps + 1, 2) bool, left and right fingers touch something.
    """

    seed: int
    success: bool
    steps: int
    query: np.ndarray
    log_variance: np.ndarray
    contacts: np.ndarray


def trace_path(folder: Path, result: EpisodeResult) -> Path:
    """Where the trace of an episode goes."""
    checkpoint = (result.checkpoint or result.policy)[:8]
    return folder / f"{result.task}-{checkpoint}-{result.policy}-{result.execution}-{result.seed}.npz"


def write_trace(folder: Path, result: EpisodeResult, trace: EpisodeTrace) -> None:
    """Keep the uncertainty of one episode, complete or not at all; an episode without any, or a crashed one, has none.

    Args:
        folder: made if missing.
        result: how the episode ended.
        trace: what happened in it.
    """
    known = [(step, values) for step, values in enumerate(trace.log_variance) if values is not None]
    if not known or result.crash is not None:
        return
    arrays = {
        "seed": np.int64(result.seed),
        "success": np.bool_(result.success),
        "steps": np.int64(result.steps),
        "query": np.array([step for step, _ in known]),
        "log_variance": np.stack([values for _, values in known]),
        "contacts": np.stack([frame.contacts for frame in trace.frames]),
    }

    def write(partial: Path) -> None:
        with partial.open("wb") as file:  # a name would get another ending
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    publish(trace_path(folder, result), write)


def read_traces(paths: Iterable[Path]) -> list[UncertaintyTrace]:
    """Read traces, in the order of their seeds.

    Raises:
        DataError: a file that is no trace.
    """
    traces = []
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as found:
                values = {name: found[name] for name in UncertaintyTrace._fields}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise DataError(path, "a trace from `ugr rollout --traces`", error, "Remove the file.") from error
        scalars = {name: values[name].item() for name in ("seed", "success", "steps")}
        traces.append(UncertaintyTrace(**{**values, **scalars}))
    return sorted(traces, key=lambda trace: trace.seed)
