"""Independent jobs over worker processes; a process that dies or hangs costs one job."""

from collections.abc import Callable, Generator, Iterable
from itertools import islice
from typing import Any, NamedTuple

from ugr_lightning.system.workers import Worker, WorkerLostError, start_all, wait_for_any

JOB_TIMEOUT_S = 600.0


class Done(NamedTuple):
    """A job that has ended.

    Args:
        job: its place among the jobs.
        value: what the method returned; None where the process was lost.
        fault: why the process was lost, or None.
    """

    job: int
    value: Any
    fault: str | None = None


def spread(
    build: Callable[[], Any],
    method: str,
    jobs: Iterable[Any],
    *,
    workers: int = 1,
    timeout_s: float = JOB_TIMEOUT_S,
) -> Generator[Done, None, None]:
    """Call a method once per job, on objects in processes of their own.

    Args:
        build: makes the object of a process; see `workers.Worker`.
        method: its method, called with one job.
        jobs: the arguments; those behind the first `workers` are asked for when a process is free.
        workers: processes.
        timeout_s: a process that takes longer for a job counts as hung.

    Yields:
        The jobs in the order in which they end. Closing the generator ends the processes.

    Raises:
        UGRError: what building the object or the method raised.
    """
    waiting, busy = enumerate(jobs), dict[Worker, int]()
    first = list(islice(waiting, workers))
    pool = [Worker(build, f"process {index + 1}") for index, _ in first]

    def give(worker: Worker, index: int, job: Any) -> None:
        busy[worker] = index
        worker.send(method, job)

    try:
        start_all(pool)
        for worker, numbered in zip(pool, first, strict=True):
            give(worker, *numbered)
        while busy:
            for worker in wait_for_any(list(busy), timeout_s) or list(busy):  # nobody: each has hung
                index = busy.pop(worker)
                try:
                    yield Done(index, worker.receive(0.0))
                except WorkerLostError as error:
                    yield Done(index, None, str(error))
                    start_all([worker])
                for numbered in islice(waiting, 1):
                    give(worker, *numbered)
    finally:
        for worker in pool:
            worker.kill()
