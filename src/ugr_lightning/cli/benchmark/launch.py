"""Commands handed to a cluster, or to several GPUs of one machine, through submitit: a benchmark's jobs, or shards."""

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ugr_lightning.errors import ConfigError, require_extra


class _Command:
    """Runs a command in a job, and again in the next one where a time limit has ended it."""

    def __call__(self, command: list[str]) -> int:
        return subprocess.call(command)

    def checkpoint(self, command: list[str]) -> Any:
        """What submitit is to submit in place of a job that has come to its time limit."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, command)


def launch(commands: Sequence[Sequence[str]], folder: Path, options: Mapping[str, Any]) -> int:
    """Submit one job per command, as an array where the cluster has them, and wait for all.

    On a cluster the jobs outlive this process: interrupting it only stops the waiting. One that meets its time limit is
    queued again by submitit, and its command goes on where it was.

    Args:
        commands: program and arguments of each job.
        folder: where submitit keeps its logs.
        options: parameters of `submitit.AutoExecutor`; `cluster` chooses `slurm`, `local` or `debug`.

    Returns:
        Exit code: 0, or 1 when a job failed.

    Raises:
        ConfigError: submitit is not installed, or does not know an option.
    """
    require_extra("--launcher submitit", "cluster", "submitit")
    import submitit

    if not commands:
        print("Nothing is left to do.")
        return 0
    parameters = dict(options)
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=parameters.pop("cluster", None))
        executor.update_parameters(**parameters)
    except (NameError, ValueError, RuntimeError, TypeError) as error:
        fix = "The options are those of submitit's AutoExecutor, such as {cluster: slurm, slurm_partition: gpu}."
        raise ConfigError("--launcher_options", "options of submitit", " ".join(str(error).split()), fix) from error
    jobs = executor.map_array(_Command(), [list(command) for command in commands])
    print(f"submitted {len(jobs)} jobs: {', '.join(job.job_id for job in jobs)}; logs in {folder}", flush=True)
    failed = []
    for job in jobs:
        fault = job.exception()
        if fault is not None or job.result() != 0:
            failed.append(job.job_id)
    if failed:
        print(f"{len(failed)} of {len(jobs)} jobs failed: {', '.join(failed)}")
    return 1 if failed else 0
