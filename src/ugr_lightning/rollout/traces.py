"""What a policy predicted in an episode, step by step, kept beside the results for analysis."""

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ugr_lightning.errors import DataError
from ugr_lightning.results.results import EpisodeResult
from ugr_lightning.rollout.trajectory import EpisodeTrace
from ugr_lightning.system.files import publish

_DAMAGED = (OSError, ValueError, TypeError, KeyError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error)
_KINDS = {
    "seed": "iu",
    "success": "b",
    "steps": "iu",
    "query": "iu",
    "chunks": "f",
    "log_variance": "f",
    "contacts": "b",
}


class PredictionTrace(NamedTuple):
    """What was predicted in one episode, over time.

    Args:
        seed: simulator seed.
        success: whether the task was done.
        steps: control steps executed.
        query: (Q,) control steps at which a chunk was predicted.
        chunks: (Q, K, A) float16, robot units.
        log_variance: (Q, K) s_k of those chunks; (Q, 0) for a policy without.
        contacts: (steps + 1, 2) bool, left and right fingers touch something.
    """

    seed: int
    success: bool
    steps: int
    query: np.ndarray
    chunks: np.ndarray
    log_variance: np.ndarray
    contacts: np.ndarray


def trace_path(folder: Path, result: EpisodeResult) -> Path:
    """Where the trace of an episode goes."""
    checkpoint = (result.checkpoint or result.policy)[:8]
    return folder / f"{result.task}-{checkpoint}-{result.policy}-{result.execution}-{result.seed}.npz"


def write_trace(folder: Path, result: EpisodeResult, trace: EpisodeTrace) -> None:
    """Keep the predictions of one episode, complete or not at all; an episode without any, or a crashed one, has none.

    Args:
        folder: made if missing.
        result: how the episode ended.
        trace: what happened in it.
    """
    chunks = {step: chunk for step, chunk in enumerate(trace.chunks) if chunk is not None}
    if not chunks or result.crash is not None:
        return
    uncertainty = [() if trace.log_variance[step] is None else trace.log_variance[step] for step in chunks]
    arrays = {
        "seed": np.int64(result.seed),
        "success": np.bool_(result.success),
        "steps": np.int64(result.steps),
        "query": np.array(list(chunks)),
        "chunks": np.stack(list(chunks.values())).astype(np.float16),
        "log_variance": np.array(uncertainty, np.float32),
        "contacts": np.stack([frame.contacts for frame in trace.frames]),
    }

    def write(partial: Path) -> None:
        with partial.open("wb") as file:  # a name would get another ending
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    publish(trace_path(folder, result), write)


def read_traces(paths: Iterable[Path]) -> list[PredictionTrace]:
    """Read traces, in the order of their seeds.

    Raises:
        DataError: a file that is no trace.
    """
    traces = []
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as found:
                traces.append(_checked({name: found[name] for name in PredictionTrace._fields}))
        except _DAMAGED as error:
            fix = "Remove the file, and run the episode again."
            raise DataError(path, "a trace from `ugr rollout --traces`", error, fix) from error
    return sorted(traces, key=lambda trace: trace.seed)


def _checked(values: dict[str, np.ndarray]) -> PredictionTrace:
    """The arrays as a trace; a ValueError where they are none together."""
    if odd := [name for name, kinds in _KINDS.items() if values[name].dtype.kind not in kinds]:
        raise ValueError(f"{odd[0]} of type {values[odd[0]].dtype}")
    trace = PredictionTrace(**{**values, **{name: values[name].item() for name in ("seed", "success", "steps")}})
    queries, chunk = len(np.atleast_1d(trace.query)), trace.chunks.shape[1:2]
    shapes = [(queries,), (queries, *chunk, *trace.chunks.shape[2:3]), (trace.steps + 1, 2)]
    found = [trace.query.shape, trace.chunks.shape, trace.contacts.shape]
    if found != shapes or trace.log_variance.shape not in ((queries, *chunk), (queries, 0)):
        raise ValueError(f"query, chunks, contacts and log_variance of {[*found, trace.log_variance.shape]}")
    return trace
