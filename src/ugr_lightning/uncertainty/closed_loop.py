"""One checkpoint used in several ways, in closed loop on the same seeds: budgets, and how chunks become actions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ugr_lightning.results.conclusions import LEVEL, described_execution
from ugr_lightning.results.pooled import holm
from ugr_lightning.results.results import EpisodeResult, Summary, summarize
from ugr_lightning.results.stats import Comparison, compare
from ugr_lightning.results.tables import Cells
from ugr_lightning.uncertainty.budgets import BudgetError


class Use(NamedTuple):
    """One way of using a checkpoint, and how often it succeeded.

    Args:
        name: the way, in words.
        total: its episodes, with the Wilson interval.
        queries: chunks that were predicted in an episode, on average; NaN where episodes do not say.
        against: compared with the first way on the same seeds; None for the first itself.
        p_holm: exact McNemar test of no difference to the first, corrected for the number of ways.
    """

    name: str
    total: Summary
    queries: float
    against: Comparison | None = None
    p_holm: float = 1.0


def compare_uses(episodes: dict[str, Sequence[EpisodeResult]]) -> list[Use]:
    """Count the successes of each way, and compare it with the first by seed.

    Args:
        episodes: by name of the way; the first is what the others are compared with.

    Raises:
        DataError: the ways were not tried on the same seeds.
    """
    (_, first), *rest = episodes.items()
    found = [compare(results, first) for _, results in rest]
    corrected = holm([one.p_value for one in found])
    columns = zip(episodes.items(), [None, *found], [1.0, *corrected], strict=True)
    return [Use(name, summarize(of), _queries(of), against, p) for (name, of), against, p in columns]


def _queries(results: Sequence[EpisodeResult]) -> float:
    """Chunks predicted in an episode, on average."""
    return float(np.mean([np.nan if result.queries is None else result.queries for result in results]))


HEAD = ("success", "95 % interval", "crashed", "difference", "only here / only first", "p", "p corrected")


def use_cells(use: Use) -> tuple[str, ...]:
    """What `HEAD` names, for one way."""
    cells, against = use.total.cells(), use.against
    if against is None:
        return (*cells, "", "", "", "")
    difference = f"{against.difference:+.1%} [{against.low:+.1%}, {against.high:+.1%}]"
    differing = f"{against.table.only_a} / {against.table.only_b}"
    return (*cells, difference, differing, f"{against.p_value:.3g}", f"{use.p_holm:.3g}")


def budget_table(uses: Sequence[Use], steps: Sequence[int], errors: Sequence[BudgetError] | None) -> Cells:
    """Success by budget beside the error on validation episodes, heading first.

    Args:
        uses: one for each budget, the coarse policy first.
        steps: refined steps of a chunk, likewise.
        errors: mean error of the executed actions, likewise; None where it was not asked for.
    """
    offline = ("offline error", "error - coarse") if errors else ()
    table: Cells = [("refined", "steps", *offline, *HEAD)]
    for i, use in enumerate(uses):
        measured = (f"{errors[i].error.value:.4f}", errors[i].signed()) if errors else ()
        table.append((use.name, str(steps[i]), *measured, *use_cells(use)))
    return table


def execution_table(uses: Sequence[Use]) -> Cells:
    """Success and queries by execution, heading first."""
    rows = [(use.name, f"{use.queries:.1f}", *use_cells(use)) for use in uses]
    return [("execution", "queries an episode", *HEAD), *rows]


def execution_verdict(uses: Sequence[Use], what: str) -> str:
    """One sentence on whether any way differs from the first.

    Args:
        uses: the first is what the others are compared with.
        what: what they are, such as `budget`.
    """
    first, *others = uses
    start = f"{_short(first)} ({first.total})"
    differing = [use for use in others if use.p_holm < LEVEL]
    n = f"n = {first.total.n} seeds"
    if not others:
        return f"There is only one {what}: {start}."
    if differing:
        found = "; ".join(f"{_short(use)}: {use.against}, {use.p_holm:.3g} after correction" for use in differing)
        return f"Success differs from that with {start} for this checkpoint: {found}."
    low = min(use.against.low for use in others if use.against)
    high = max(use.against.high for use in others if use.against)
    return (
        f"No {what} can be told apart from {start} on {n}: the smallest p is "
        f"{min(use.p_holm for use in others):.3g} after correction for {len(others)}, and differences from {low:+.0%} "
        f"to {high:+.0%} are compatible with these episodes."
    )


def _short(use: Use) -> str:
    """A name without its explanation."""
    return use.name.partition(":")[0]


def use_records(uses: Sequence[Use]) -> list[dict[str, Any]]:
    """Numbers of each way in plain containers."""
    return [
        {
            "name": use.name,
            **use.total._asdict(),
            "queries": use.queries,
            "against_first": None if use.against is None else use.against._asdict(),
            "p_holm": use.p_holm,
        }
        for use in uses
    ]


def budget_name(ratio: float, trained: float | None) -> str:
    """A budget as tables name it.

    Args:
        ratio: share of a chunk that is refined.
        trained: that of the training.
    """
    name = "0%, coarse policy" if ratio == 0 else f"{100 * ratio:g}%"
    return f"{name}, as trained" if ratio == trained else name


def execution_name(execution: str | int) -> str:
    """An execution as tables name it: its setting, and what that means."""
    return f"`{execution}`: {described_execution(str(execution))}"


def budget_figure(uses: Sequence[Use], ratios: Sequence[float], errors: Sequence[BudgetError] | None) -> Any:
    """Success, with Wilson intervals, and the error on validation episodes over the budget."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axis = figure.subplots()
    totals = [use.total for use in uses]
    spread = [[max(0.0, t.rate - t.low) for t in totals], [max(0.0, t.high - t.rate) for t in totals]]
    axis.errorbar(ratios, [total.rate for total in totals], spread, fmt="o-", capsize=3, color="C0")
    axis.set(xlabel="share of the chunk that is refined", ylim=(-0.03, 1.03))
    axis.set_ylabel(f"success of {totals[0].n} episodes, 95 % Wilson", color="C0")
    if errors:
        other = axis.twinx()
        other.plot(ratios, [one.error.value for one in errors], ".--", color="C1")
        other.set_ylabel("mean offline error (standard deviations)", color="C1")
    return figure
