"""What results add up to: rates per policy, comparisons between policies, and what may be concluded."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ugr_lightning.errors import DataError
from ugr_lightning.results.evaluations import Evaluation
from ugr_lightning.results.pooled import hierarchical_bootstrap, holm, sign_flip_test
from ugr_lightning.results.results import EpisodeResult, Summary, summarize, wilson_interval
from ugr_lightning.results.stats import PairedTable, paired_difference_interval

ALL_TASKS = "all tasks"


class Mode(NamedTuple):
    """What has to be equal for rates to be compared.

    Args:
        setting: scene setting.
        execution: `aggregate`, `aggregate-variance` (aggregated with inverse variance), the number of steps executed
            of each chunk, or the name that a benchmark gives to executions that differ between policies.
    """

    setting: str
    execution: str


@dataclass(frozen=True)
class Rate:
    """How often a policy succeeds in a task.

    Args:
        mode: setting and execution.
        task: task name.
        policy: the policy's name in the comparison.
        total: all episodes, with the Wilson interval; training seeds are not told apart.
        by_training_seed: the same of each training seed.
    """

    mode: Mode
    task: str
    policy: str
    total: Summary
    by_training_seed: dict[int, Summary]


@dataclass(frozen=True)
class Contest:
    """How policy a compares with policy b on the seeds and training seeds that both have.

    Args:
        mode: setting and execution.
        task: task name, or `all tasks`.
        a, b: names of the policies.
        tasks: number of tasks.
        seeds: evaluation seeds, over all tasks.
        training_seeds: how many both have, in the task with the fewest.
        left_out: episodes that were not compared, because the other policy lacks the seed or the training seed.
        rate_a, rate_b: success rates on what is compared, tasks weighing the same.
        only_a, only_b: episodes in which only one of them succeeds.
        low, high: 95 % interval of rate_a - rate_b.
        interval: `Newcombe` (one task, one training seed), `bootstrap` (over training and evaluation seeds), or
            `Wilson` where no episode differs: how many of the seeds could, had there been more of them.
        p_value: exact McNemar test; with several training seeds its generalisation, the sign-flip test by seed.
        p_holm: corrected for all contests of the mode, single tasks and `all tasks` apart.
    """

    mode: Mode
    task: str
    a: str
    b: str
    tasks: int
    seeds: int
    training_seeds: int
    left_out: int
    rate_a: float
    rate_b: float
    only_a: int
    only_b: int
    low: float
    high: float
    interval: str
    p_value: float
    p_holm: float = 1.0

    @property
    def difference(self) -> float:
        """Success rate of a minus that of b."""
        return self.rate_a - self.rate_b


@dataclass(frozen=True)
class Report:
    """Policies in the order in which they were given, their rates and contests, and remarks on the results."""

    policies: list[str]
    rates: list[Rate]
    contests: list[Contest]
    remarks: list[str]


Outcomes = dict[tuple[Mode, str], dict[str, dict[int, dict[int, bool]]]]
"""By mode and task, by policy, by training seed, by evaluation seed: whether the episode succeeded."""


def build_report(evaluations: Sequence[Evaluation], *, baseline: str | None = None) -> Report:
    """Count, compare and correct.

    Args:
        evaluations: any number of policies, tasks and training seeds.
        baseline: compare the others with this policy only; None compares all pairs.

    Raises:
        DataError: two evaluations claim the same policy, training seed, task and mode; or no such baseline.
    """
    remarks: list[str] = []
    episodes = _sort(_numbered(evaluations, remarks))
    policies = list(dict.fromkeys(item.policy for item in evaluations))
    if baseline is not None and baseline not in policies:
        raise DataError("--baseline", f"one of {', '.join(policies)}", baseline, "Correct the name.")
    rates = [
        Rate(
            mode,
            task,
            policy,
            summarize(item for part in seeds.values() for item in part),
            {seed: summarize(part) for seed, part in sorted(seeds.items())},
        )
        for (mode, task), found in episodes.items()
        for policy, seeds in found.items()
    ]
    remarks += [f"No episodes of `{p}` yet." for p in policies if p not in {rate.policy for rate in rates}]
    crashed = sum(rate.total.crashed for rate in rates)
    if crashed:
        remarks.append(f"{crashed} episodes crashed; each counts as a failure.")
    outcomes: Outcomes = {
        place: {
            policy: {seed: {e.seed: e.success and e.crash is None for e in part} for seed, part in seeds.items()}
            for policy, seeds in found.items()
        }
        for place, found in episodes.items()
    }
    contests = _contests(outcomes, policies, baseline)
    left = sum(contest.left_out for contest in contests if contest.task != ALL_TASKS)
    if left:
        remarks.append(f"{left} episodes have no counterpart in a comparison and are left out of it, not of the rates.")
    return Report(policies, rates, contests, remarks)


def _numbered(evaluations: Sequence[Evaluation], remarks: list[str]) -> list[Evaluation]:
    """Give checkpoints of unknown training seed a number of their own: the first that their tasks have not had."""
    numbered, unknown = [], dict[str, dict[str, int]]()
    known: dict[tuple[str, str | None], int] = {}  # by policy and checkpoint
    for item in evaluations:
        if item.training_seed is None:
            had, tasks = unknown.setdefault(item.policy, {}), {episode.task for episode in item.results}
            number = max((had.get(task, 0) for task in tasks), default=0)
            for sha in {episode.checkpoint for episode in item.results} - {None}:
                number = known.setdefault((item.policy, sha), number)
            had |= {task: max(had.get(task, 0), number + 1) for task in tasks}
            numbered.append(replace(item, training_seed=number))
        else:
            numbered.append(item)
    if unknown:
        names = ", ".join(f"`{name}`" for name in unknown)
        remarks.append(f"The training seeds of {names} are not known; the files are numbered in their order.")
    return numbered


def _sort(evaluations: Sequence[Evaluation]) -> dict[tuple[Mode, str], dict[str, dict[int, list[EpisodeResult]]]]:
    """Episodes by mode and task, by policy, by training seed."""
    found: dict[tuple[Mode, str], dict[str, dict[int, list[EpisodeResult]]]] = {}
    owners: dict[tuple[Mode, str, str, int], Evaluation] = {}
    for evaluation in evaluations:
        seed = evaluation.training_seed
        assert seed is not None
        for item in evaluation.results:
            mode = Mode(item.setting, evaluation.modes.get(item.execution, item.execution))
            owner = owners.setdefault((mode, item.task, evaluation.policy, seed), evaluation)
            if owner is not evaluation:
                what = f"{evaluation.policy}, {item.task}, training seed {seed}"
                got = f"{owner.source} and {evaluation.source}"
                raise DataError(what, "one results file", got, "Give each run once, or another name to one of them.")
            found.setdefault((mode, item.task), {}).setdefault(evaluation.policy, {}).setdefault(seed, []).append(item)
    _check_seed_lists(found)
    return found


def _check_seed_lists(found: dict[tuple[Mode, str], dict[str, dict[int, list[EpisodeResult]]]]) -> None:
    for (_, task), policies in found.items():
        hashes = {item.seeds_hash for seeds in policies.values() for part in seeds.values() for item in part}
        if len(hashes) > 1:
            got = ", ".join(sorted(text[:12] for text in hashes))
            fix = "Give results of the evaluation seeds alone, or of the same others. If all are of the evaluation "
            fix += "seeds, that list has changed: evaluate again with one version of the package."
            raise DataError(f"results of {task}", "episodes from one list of seeds", f"the hashes {got}", fix)


def _contests(outcomes: Outcomes, policies: Sequence[str], baseline: str | None) -> list[Contest]:
    pairs = [(p, baseline) for p in policies if p != baseline] if baseline else list(combinations(policies, 2))
    pairs = [(b, a) for a, b in pairs] if baseline is None else pairs  # later policies against earlier ones
    contests: list[Contest] = []
    for mode in dict.fromkeys(mode for mode, _ in outcomes):
        tasks = [task for other, task in outcomes if other == mode]
        single = [c for task in tasks for pair in pairs if (c := _contest(mode, [task], pair, outcomes))]
        pooled = [c for pair in pairs if len(tasks) > 1 and (c := _contest(mode, tasks, pair, outcomes))]
        for family in (single, pooled):
            corrected = holm([contest.p_value for contest in family])
            contests += [replace(c, p_holm=p) for c, p in zip(family, corrected, strict=True)]
    return contests


def _contest(mode: Mode, tasks: Sequence[str], pair: tuple[str, str], outcomes: Outcomes) -> Contest | None:
    """Compare two policies on some tasks; None where a task lacks episodes of either on the same seeds."""
    tables_a, tables_b, left_out = [], [], 0
    for task in tasks:
        a, b = (outcomes[mode, task].get(name, {}) for name in pair)
        common = sorted(a.keys() & b.keys())
        parts = [part for policy in (a, b) for seed, part in policy.items() if seed in common]
        seeds = sorted(set.intersection(*(set(part) for part in parts))) if parts else []
        if not seeds:
            return None
        tables_a.append(np.array([[a[t][e] for e in seeds] for t in common], int))  # (training, evaluation seeds)
        tables_b.append(np.array([[b[t][e] for e in seeds] for t in common], int))
        left_out += sum(len(part) for policy in (a, b) for part in policy.values())
        left_out -= tables_a[-1].size + tables_b[-1].size
    only_a = sum(int((x > y).sum()) for x, y in zip(tables_a, tables_b, strict=True))
    only_b = sum(int((x < y).sum()) for x, y in zip(tables_a, tables_b, strict=True))
    by_seed = [int(d) for x, y in zip(tables_a, tables_b, strict=True) for d in (x - y).sum(0)]
    fewest = min(len(table) for table in tables_a)
    if len(tasks) == 1 and fewest == 1:
        interval, (low, high) = "Newcombe", paired_difference_interval(_table(tables_a[0], tables_b[0]))
    else:
        interval, (low, high) = "bootstrap", hierarchical_bootstrap(tables_a, tables_b)
    if only_a == only_b == 0 and interval == "bootstrap":  # resampling cannot show what no episode has shown
        high = wilson_interval(0, len(by_seed))[1]
        interval, low = "Wilson", -high
    return Contest(
        mode,
        tasks[0] if len(tasks) == 1 else ALL_TASKS,
        *pair,
        tasks=len(tasks),
        seeds=len(by_seed),
        training_seeds=fewest,
        left_out=left_out,
        rate_a=float(np.mean([table.mean() for table in tables_a])),
        rate_b=float(np.mean([table.mean() for table in tables_b])),
        only_a=only_a,
        only_b=only_b,
        low=low,
        high=high,
        interval=interval,
        p_value=sign_flip_test(by_seed),
    )


def _table(a: np.ndarray, b: np.ndarray) -> PairedTable:
    counts: Iterable[np.ndarray] = (a & b, a & ~b & 1, ~a & b & 1, ~a & ~b & 1)
    return PairedTable(*(int(count.sum()) for count in counts))
