"""A report as Markdown and as CSV."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from ugr_lightning.results.conclusions import conclude, described_execution
from ugr_lightning.results.report import ALL_TASKS, Contest, Mode, Rate, Report
from ugr_lightning.results.results import Summary, wilson_interval
from ugr_lightning.results.tables import Cells, as_markdown
from ugr_lightning.system.files import publish_text

METHOD = (
    "Rates carry n and the 95 % Wilson interval over all episodes. Policies are compared on the seeds and training "
    "seeds that both have, with the exact McNemar test; where there are several training seeds or tasks, with its "
    "generalisation in which every evaluation seed counts once (signs of the summed differences are flipped). p-values "
    "are corrected by Holm's method within each execution mode, single tasks and all tasks apart. Intervals of "
    "differences are Newcombe's for one task and one training seed, otherwise from a hierarchical bootstrap over "
    "training seeds and evaluation seeds, or, where no episode differs, Wilson's for the share of seeds that could; "
    "they are not corrected, so that one may leave out zero where the corrected p shows no difference."
)


def write_report(report: Report, folder: Path, title: str) -> list[Path]:
    """Write `report.md`, `rates.csv` and `comparisons.csv` into a folder; returns their paths."""
    contests = [(*c.mode, *(getattr(c, name) for name in CONTEST_HEAD[2:])) for c in report.contests]
    texts = {
        "report.md": to_markdown(report, title),
        "rates.csv": _csv(RATE_HEAD, _rate_records(report.rates)),
        "comparisons.csv": _csv(CONTEST_HEAD, contests),
    }
    for name, text in texts.items():
        publish_text(folder / name, text)
    return [folder / name for name in texts]


def to_markdown(report: Report, title: str) -> str:
    """The report as Markdown: conclusion, overview, rates and comparisons by mode, method.

    Args:
        report: what is told.
        title: its heading.
    """
    parts = [f"# {title}", "## Conclusion", str(conclude(report)), *report.remarks]
    if report.rates:
        parts += ["## Overview", as_markdown(_overview_table(report))]
    for mode in dict.fromkeys(rate.mode for rate in report.rates):
        rates = [rate for rate in report.rates if rate.mode == mode]
        contests = [contest for contest in report.contests if contest.mode == mode]
        parts += [f"## Success: {_described(mode)}", as_markdown(_rate_table(rates))]
        if contests:
            parts += [f"## Comparisons: {_described(mode)}", as_markdown(_contest_table(contests))]
    return "\n\n".join([*parts, "## Method", METHOD]) + "\n"


def _described(mode: Mode) -> str:
    return f"{mode.setting}, {described_execution(mode.execution)}"


def _overview_table(report: Report) -> Cells:
    """A row per policy and a column per mode; of several tasks, a row per mode too and a column per task."""
    one_setting = len({rate.mode.setting for rate in report.rates}) == 1
    totals: dict[str, dict[str, dict[str, Summary]]] = {}  # by mode, by policy, by task
    for rate in report.rates:
        mode = described_execution(rate.mode.execution) if one_setting else _described(rate.mode)
        totals.setdefault(mode, {}).setdefault(rate.policy, {})[rate.task] = rate.total
    tasks = list(dict.fromkeys(rate.task for rate in report.rates))
    if len(tasks) > 1:
        head = ("policy", "execution" if one_setting else "setting and execution", *tasks, ALL_TASKS)
        return [head, *_overview_of_tasks(totals, report.policies, tasks)]
    rows: Cells = [("policy", *(f"{tasks[0]}, {mode}" for mode in totals))]
    for policy in report.policies:
        found = [by_policy.get(policy, {}).get(tasks[0]) for by_policy in totals.values()]
        if any(found):
            rows.append(
                (f"`{policy}`", *("" if total is None else _counted(total.successes, total.n) for total in found))
            )
    return rows


def _overview_of_tasks(
    totals: dict[str, dict[str, dict[str, Summary]]], policies: Sequence[str], tasks: Sequence[str]
) -> Iterator[tuple[str, ...]]:
    """A row per mode and policy: each task, and their sum where each has as many episodes."""
    for mode, policy in product(totals, policies):
        by_task = totals[mode].get(policy)
        if by_task is None:
            continue
        sizes = [total.n for total in by_task.values()]
        whole = len(by_task) == len(tasks) and len(set(sizes)) == 1
        cells = [_counted(by_task[task].successes, by_task[task].n) if task in by_task else "" for task in tasks]
        cells.append(_counted(sum(t.successes for t in by_task.values()), sum(sizes)) if whole else "")
        yield (f"`{policy}`", mode, *cells)


def _counted(successes: int, n: int) -> str:
    low, high = wilson_interval(successes, n)
    return f"{successes}/{n} [{100 * low:.1f}, {100 * high:.1f}]"


def _rate_table(rates: Sequence[Rate]) -> Cells:
    rows: Cells = [("task", "policy", "success", "95 % interval", "by training seed", "crashed")]
    for rate in rates:
        seeds = ", ".join(f"{seed}: {part.successes}/{part.n}" for seed, part in rate.by_training_seed.items())
        success, interval, crashed = rate.total.cells()
        rows.append((rate.task, f"`{rate.policy}`", success, interval, seeds, crashed))
    return rows


def _contest_table(contests: Sequence[Contest]) -> Cells:
    head = ("task", "policies", "difference", "95 % interval", "n", "only first / second", "p", "p corrected")
    rows: Cells = [head]
    for c in contests:
        interval = f"[{c.low:+.1%}, {c.high:+.1%}] {c.interval}"
        n = f"{c.seeds} seeds x {c.training_seeds}"
        wins = f"{c.only_a} / {c.only_b}"
        names = f"`{c.a}` - `{c.b}`"
        rows.append((c.task, names, f"{c.difference:+.1%}", interval, n, wins, f"{c.p_value:.3g}", f"{c.p_holm:.3g}"))
    return rows


RATE_HEAD = (
    *("setting", "execution", "task", "policy", "training_seed"),
    *("n", "successes", "rate", "low", "high", "crashed"),
)
CONTEST_HEAD = (
    *("setting", "execution", "task", "a", "b", "tasks", "seeds", "training_seeds", "left_out", "rate_a", "rate_b"),
    *("only_a", "only_b", "difference", "low", "high", "interval", "p_value", "p_holm"),
)


def _rate_records(rates: Iterable[Rate]) -> list[tuple[Any, ...]]:
    """One row per training seed, and one with `all` for their sum."""
    return [
        (*rate.mode, rate.task, rate.policy, seed, *part)
        for rate in rates
        for seed, part in [*rate.by_training_seed.items(), ("all", rate.total)]
    ]


def _csv(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return buffer.getvalue()
