"""`ugr benchmark`: train and evaluate a grid, one job after another, going on wherever it was stopped."""

import csv
import hashlib
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml

from ugr_lightning.cli.benchmark.grid import Grid, Job, fingerprint, identity, read_grid, resolved_config
from ugr_lightning.cli.benchmark.subprocesses import Failure, run_and_watch
from ugr_lightning.cli.parsing.call import call
from ugr_lightning.errors import ConfigError, UGRError
from ugr_lightning.results.evaluations import RESULTS_FILE, RUN_FILE, RunInfo
from ugr_lightning.results.results import drop_cut_off_line, read_results
from ugr_lightning.system.files import publish_text, remove_unfinished
from ugr_lightning.system.lock import Lock, locked
from ugr_lightning.system.progress import clock
from ugr_lightning.training.runs import resolve_checkpoint, versions_of

PROGRAM = (sys.executable, "-m", "ugr_lightning.cli.main")


def _benchmark(
    grid: str,
    out: str,
    dry_run: bool = False,
    job: int | None = None,
    launcher: Literal["submitit"] | None = None,
    launcher_options: dict[str, Any] = {},  # noqa: B006 - jsonargparse copies it
) -> int:
    """Record, train and evaluate policies x tasks x training seeds; skips what is done, goes on with what is not.

    Args:
        grid: YAML file with the policies, tasks and training seeds.
        out: folder of the benchmark: `runs` for TensorBoard, `results` with JSONL, configs and hashes, `logs`.
        dry_run: only list the jobs and what is done.
        job: run only this one, by its number in the list; several of them may run at the same time.
        launcher: hand the jobs to a cluster instead of running them here; needs submitit.
        launcher_options: parameters of submitit's executor, such as `{cluster: slurm, slurm_partition: gpu}`.
    """
    plan, folder = read_grid(grid), Path(out)
    jobs = plan.jobs()
    if job is not None and not 0 <= job < len(jobs):
        raise ConfigError("--job", f"0 to {len(jobs) - 1}", job, "`--dry_run` lists the jobs.")
    chosen = jobs if job is None else [jobs[job]]
    configs = {item.name: resolved_config(item) for item in chosen}
    if dry_run:
        print("\n".join(f"{item.index:>4}  {item.name:<48}{state_of(item, plan, folder)}" for item in chosen))
        return 0
    if launcher is not None:
        from ugr_lightning.cli.benchmark.launch import launch

        left = [item for item in chosen if not state_of(item, plan, folder).done]
        command = [*PROGRAM, "benchmark", str(Path(grid).resolve()), "--out", str(folder.resolve()), "--job"]
        return launch([[*command, str(item.index)] for item in left], folder / "submitit", launcher_options)
    with locked(folder / "benchmark.lock", str(folder), shared=job is not None) as lock:
        if job is None:
            publish_text(folder / "results" / "grid.yaml", Path(grid).read_text())
        return Benchmark(plan, folder, chosen, configs, lock).run()


run = partial(call, _benchmark, leading=["grid"])


class State(NamedTuple):
    """How far a job has come.

    Args:
        trained: whether its training has ended.
        step: optimiser steps so far.
        episodes: evaluation episodes so far.
        wanted: evaluation episodes in all.
    """

    trained: bool
    step: int
    episodes: int
    wanted: int

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""
        return self.trained and self.episodes >= self.wanted

    def __str__(self) -> str:
        if self.done:
            return "done"
        if self.trained:
            return f"trained, {self.episodes} of {self.wanted} episodes"
        return f"trained for {self.step} steps" if self.step else "to do"


def state_of(job: Job, grid: Grid, folder: Path) -> State:
    """Read from the benchmark's folder how far a job has come.

    Raises:
        DataError: a results file is damaged; names file and line.
    """
    from ugr_lightning.sim.seeds import evaluation_seeds

    results = folder / "results" / job.name
    seeds = set(evaluation_seeds(job.task)[: grid.episodes])
    wanted = len(seeds) * len(job.executions)
    step = trained_steps(folder / "runs" / job.name)
    if not (results / RUN_FILE).is_file():
        return State(False, step, 0, wanted)
    info = RunInfo.read(results)
    executions = {str(value) for value in job.executions.values()}
    path = results / RESULTS_FILE
    found = read_results(path) if path.is_file() else []
    episodes = {(item.execution, item.seed) for item in found if item.execution in executions and item.seed in seeds}
    return State(info.checkpoint is not None, step, len(episodes), wanted)


def trained_steps(run: Path) -> int:
    """The last step in the log of a run's newest version, 0 where there is none."""
    for version in reversed(versions_of(run)):
        log = version / "metrics.csv"
        if log.is_file():
            with log.open(newline="") as file:
                steps = [row["step"] or "" for row in csv.DictReader(file) if "step" in row]
            return max((int(step) for step in steps if step.isdigit()), default=0)
    return 0


class Benchmark:
    """Runs the jobs of a grid, each step in a process of its own, so that a crash costs one job.

    Args:
        grid: what to evaluate.
        folder: where everything goes.
        jobs: those to run.
        configs: their resolved configs by name.
        lock: held by this process and handed on to the processes it starts.
    """

    def __init__(self, grid: Grid, folder: Path, jobs: Sequence[Job], configs: dict[str, Any], lock: Lock) -> None:
        self.grid, self.folder, self.jobs, self.configs, self.lock = grid, folder, jobs, configs, lock

    def run(self) -> int:
        """Run what is left; returns 1 when a job failed, after the others had their turn."""
        failures: dict[str, str] = {}
        for number, job in enumerate(self.jobs, start=1):
            title = f"[{number}/{len(self.jobs)}] {job.name}"
            results = self.folder / "results" / job.name
            try:
                with locked(results / "job.lock", job.name) as own:
                    drop_cut_off_line(results / RESULTS_FILE)
                    remove_unfinished(results)
                    self._run(job, title, own)
            except (UGRError, Failure) as error:
                failures[job.name] = str(error)
                print(f"{title}: FAILED. {error}", flush=True)
        for name, why in failures.items():
            print(f"failed: {name}: {why.splitlines()[0]}", file=sys.stderr)
        done = len(self.jobs) - len(failures)
        compare = f" Compare them:  ugr report {self.folder}" if done else ""
        print(f"{done} of {len(self.jobs)} jobs are done.{compare}", flush=True)
        return 1 if failures else 0

    def _run(self, job: Job, title: str, own: Lock) -> None:
        state = state_of(job, self.grid, self.folder)
        info = self._begin(job)
        if state.done:
            print(f"{title}: done before", flush=True)
            return
        if not state.trained:
            self._step("fit", job, info, self._fit(job), title, own)
            run = self.folder / "runs" / job.name
            checkpoint = resolve_checkpoint(self.grid.checkpoint, str(versions_of(run)[-1]), self.folder / "runs")
            info.run, info.checkpoint = (str(p.relative_to(self.folder)) for p in (checkpoint.parent, checkpoint))
            with checkpoint.open("rb") as file:
                info.checkpoint_sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            info.write(self.folder / "results" / job.name)
        self._step("test", job, info, self._test(job, info), title, own)
        state = state_of(job, self.grid, self.folder)
        if not state.done:
            raise Failure(f"After the evaluation {state.episodes} of {state.wanted} episodes are there.")

    def _begin(self, job: Job) -> RunInfo:
        """The job's record; a new one for a new job, together with its resolved config."""
        place, config = self.folder / "results" / job.name, self.configs[job.name]
        path = place / "config.yaml"
        if (place / RUN_FILE).is_file():
            info = RunInfo.read(place)
            _require_same(path, yaml.safe_load(path.read_text()), config)
        else:
            info = RunInfo(job.policy, job.task, job.training_seed, fingerprint(config))
            text = yaml.safe_dump(config, sort_keys=False)
            publish_text(path, text)
        info.modes, info.job = job.modes, job.index
        info.write(place)
        return info

    def _fit(self, job: Job) -> list[str]:
        root = self.folder / "runs"
        words = ["fit", *job.fit_arguments(), "--run", job.name, "--trainer.default_root_dir", str(root)]
        begun = any((version / "last.ckpt").is_file() for version in versions_of(root / job.name))
        return [*words, "--checkpoint", "last"] if begun else words

    def _test(self, job: Job, info: RunInfo) -> list[str]:
        executions = f"[{','.join(str(value) for value in job.executions.values())}]"
        words = ["test", "--checkpoint", str(self.folder / str(info.checkpoint)), "--executions", executions]
        words += ["--episodes", str(self.grid.episodes), "--workers", str(self.grid.workers), "--resume"]
        return [*words, "--out", str(self.folder / "results" / job.name / RESULTS_FILE)]

    def _step(self, part: str, job: Job, info: RunInfo, words: list[str], title: str, own: Lock) -> None:
        """Run `ugr fit` or `ugr test`, say how far it is, and add its time to the record."""
        log = self.folder / "logs" / f"{job.name}.log"
        doing = {"fit": "training", "test": "evaluating"}[part]
        again = " goes on" if "--checkpoint" in words and part == "fit" else ""
        print(f"{title}: {doing}{again}{self._left()}; log {log}", flush=True)
        began = time.monotonic()

        def started(pid: int) -> None:
            for lock in (self.lock, own):
                lock.describe(child=pid)

        def tell() -> None:
            print(f"{title}: {doing}, {state_of(job, self.grid, self.folder)}", flush=True)

        try:
            run_and_watch([*PROGRAM, *words], log, (self.lock.file, own.file), started, tell)
        finally:
            info.seconds[part] = info.seconds.get(part, 0.0) + time.monotonic() - began
            info.write(self.folder / "results" / job.name)
        print(f"{title}: {doing} took {clock(time.monotonic() - began)}", flush=True)

    def _left(self) -> str:
        """About how long the jobs that are left will take, once one has shown how long a part takes."""
        spent: dict[str, list[float]] = {"fit": [], "test": []}
        missing = {"fit": 0, "test": 0}
        for job in self.jobs:
            state = state_of(job, self.grid, self.folder)
            place = self.folder / "results" / job.name
            seconds = RunInfo.read(place).seconds if (place / RUN_FILE).is_file() else {}
            for part, finished in (("fit", state.trained), ("test", state.done)):
                if finished and part in seconds:
                    spent[part].append(seconds[part])
                missing[part] += not finished
        if any(missing[part] and not spent[part] for part in missing):
            return ""
        left = sum(missing[part] * sum(spent[part]) / len(spent[part]) for part in missing if missing[part])
        return f", about {clock(left)} left for all"


def _require_same(path: Path, before: dict[str, Any], now: dict[str, Any]) -> None:
    """A job goes on with the config it began with; keys that a newer version of the package adds do not matter.

    Raises:
        ConfigError: names the keys that differ.
    """
    old, new = identity(before), identity(now)
    changed = [f"{key}: {value} before, {new.get(key)} now" for key, value in old.items() if new.get(key) != value]
    if changed:
        fix = "Choose another --out, or undo the change."
        raise ConfigError(path, "the config that this job began with", "; ".join(changed[:5]), fix)
