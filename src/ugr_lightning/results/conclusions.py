"""What may be concluded from a report and what may not, in words made from its numbers."""

import math
from dataclasses import dataclass, replace

from ugr_lightning.errors import ConfigError
from ugr_lightning.results.power import LARGEST, paired_episodes
from ugr_lightning.results.report import ALL_TASKS, Contest, Report
from ugr_lightning.results.results import wilson_interval

LEVEL = 0.05
MARGIN = 0.10
"""Comparisons that leave room for a larger difference than this have too few episodes to say that there is none."""
ENOUGH_TRAINING_SEEDS = 3
FEW = 3
"""Up to so many comparisons that show nothing get a sentence each; more of them share one."""


@dataclass(frozen=True)
class Conclusion:
    """Sentences.

    Args:
        may: what the numbers support.
        may_not: what they do not.
    """

    may: list[str]
    may_not: list[str]

    def __str__(self) -> str:
        parts = {"What may be concluded:": self.may, "What may not:": self.may_not}
        lists = {title: "\n".join(f"- {text}" for text in items) for title, items in parts.items() if items}
        return "\n\n".join(f"**{title}**\n\n{items}" for title, items in lists.items())


def conclude(report: Report) -> Conclusion:
    """Put a report into words; where there are several tasks, the comparison over all of them decides.

    Args:
        report: rates and contests; significance is that of the corrected p-values, level 5 %.
    """
    may: list[str] = []
    may_not: list[str] = []
    pooled = {contest.mode for contest in report.contests if contest.task == ALL_TASKS}
    decisive = [c for c in report.contests if (c.task == ALL_TASKS) == (c.mode in pooled)]
    for place in dict.fromkeys((c.mode, c.task) for c in decisive):
        contests = [c for c in decisive if (c.mode, c.task) == place]
        may += [_verdict(c) for c in contests if _differs(c)]
        may += _verdicts([c for c in contests if not _differs(c) and _is_close(c)])
        may_not += _verdicts([c for c in contests if not _differs(c) and not _is_close(c)])
    may += _single_tasks([c for c in report.contests if c not in decisive])
    if not decisive:
        may_not.append(_nothing_to_compare(report))
    else:
        may_not += _scope(decisive)
    return Conclusion(may, may_not)


def _differs(contest: Contest) -> bool:
    return contest.p_holm < LEVEL


def _is_close(contest: Contest) -> bool:
    """Whether a difference of the margin or more is excluded."""
    return _largest(contest) < MARGIN


def _largest(contest: Contest) -> float:
    """The largest difference that is not excluded; never less than where no episode differs, however few there are."""
    return max(-contest.low, contest.high, wilson_interval(0, contest.seeds)[1])


def _verdict(contest: Contest) -> str:
    if _differs(contest):
        won = _from_the_winner(contest)
        return f"`{won.a}` succeeds more often than `{won.b}` {_where(won)}: {_numbers(won)}. {_again(won)}"
    if _is_close(contest):
        return (
            f"`{contest.a}` and `{contest.b}` differ by less than {_bound([contest])} {_where(contest)}, and no "
            f"difference is shown: {_numbers(contest)}."
        )
    return (
        f"Whether `{contest.a}` or `{contest.b}` is better {_where(contest)}: {_numbers(contest)}; anything from "
        f"{contest.low:+.0%} to {contest.high:+.0%} is compatible with these episodes, which are too few."
        f"{_needed(contest)}"
    )


def _verdicts(contests: list[Contest]) -> list[str]:
    """On comparisons of one mode and task that show no difference, either all close or all open."""
    if len(contests) <= FEW:
        return [_verdict(contest) for contest in contests]
    where, count = _where(contests[0]), len(contests)
    pairs = ", ".join(f"`{c.a}` - `{c.b}` {c.difference:+.1%} [{c.low:+.1%}, {c.high:+.1%}]" for c in contests)
    shown = (
        f"{pairs}; n = {', '.join(dict.fromkeys(map(_seeds, contests)))}, no p below "
        f"{min(c.p_holm for c in contests):.3g} after correction."
    )
    if _is_close(contests[0]):
        return [f"{count} pairs differ by less than {_bound(contests)} each {where}, and show no difference: {shown}"]
    return [f"Which is better {where} of {count} pairs that may differ by {MARGIN:.0%} or more: {shown}"]


def _bound(contests: list[Contest]) -> str:
    return f"{math.ceil(100 * max(map(_largest, contests)) - 1e-9)}%"  # rounding down would claim too much


def _from_the_winner(c: Contest) -> Contest:
    """The same contest with the more successful policy first."""
    if c.difference >= 0:
        return c
    swapped = {"a": c.b, "b": c.a, "rate_a": c.rate_b, "rate_b": c.rate_a, "only_a": c.only_b, "only_b": c.only_a}
    return replace(c, **swapped, low=-c.high, high=-c.low)  # type: ignore[arg-type]


def _where(contest: Contest) -> str:
    place = f"over {contest.tasks} tasks" if contest.task == ALL_TASKS else f"in {contest.task}"
    return f"{place} ({contest.mode.setting}, {described_execution(contest.mode.execution)})"


def described_execution(execution: str) -> str:
    """An execution in words; a name that a benchmark has given stays as it is."""
    known = {
        "aggregate": "aggregated chunks",
        "aggregate-variance": "chunks aggregated with inverse variance",
    }
    return known.get(execution, f"{execution} steps of each chunk" if execution.isdecimal() else execution)


def _numbers(contest: Contest) -> str:
    return (
        f"{contest.rate_a:.1%} against {contest.rate_b:.1%}, difference {contest.difference:+.1%} "
        f"[{contest.low:+.1%}, {contest.high:+.1%}], n = {_seeds(contest)}, {contest.only_a} against {contest.only_b} "
        f"episodes, p = {contest.p_holm:.3g} after correction"
    )


def _seeds(contest: Contest) -> str:
    several = f" x {contest.training_seeds} training seeds" if contest.training_seeds > 1 else ""
    return f"{contest.seeds} seeds{several}"


def _again(contest: Contest) -> str:
    """Whether a difference between checkpoints is one between ways of training."""
    n = contest.training_seeds
    if n == 1:
        return "That is said of these checkpoints: with one training seed nothing is known about training again."
    if contest.low <= 0 <= contest.high:
        return f"Over its {n} training seeds the difference varies so much that another training could show none."
    if n < ENOUGH_TRAINING_SEEDS:
        return f"{n} training seeds are too few to know how much training again would vary."
    return f"It holds over the {n} training seeds, in the sense of the interval."


def _needed(contest: Contest) -> str:
    differing = (contest.only_a + contest.only_b) / (contest.seeds * contest.training_seeds)
    size = abs(contest.difference)
    if size < 0.005 or differing < size - 1e-9:  # tasks of unequal size weigh the same in one and not in the other
        return ""
    try:
        count = f"about {paired_episodes(size, max(size, differing))}"
    except ConfigError:
        count = f"more than {LARGEST}"
    return f" A difference of the size seen takes {count} shared seeds to be found with 80 % power."


def _single_tasks(contests: list[Contest]) -> list[str]:
    """One sentence on the tasks that show a difference by themselves."""
    found = [c for c in contests if _differs(c)]
    if not found:
        return []
    named = [f"`{c.a}` over `{c.b}` {_where(c)} (p = {c.p_holm:.3g})" for c in map(_from_the_winner, found)]
    return [f"By themselves these tasks show a difference between the checkpoints: {'; '.join(named)}."]


def _nothing_to_compare(report: Report) -> str:
    if not report.rates:
        return "Anything: there are no episodes."
    return "Which policy is better: no two policies were evaluated in the same task, mode, seeds and training seeds."


def _scope(contests: list[Contest]) -> list[str]:
    fewest = min(contest.training_seeds for contest in contests)
    sentences = []
    if fewest == 1:
        sentences.append(
            "That one way of training is better than another: one training seed shows one checkpoint each, and the "
            "intervals say nothing about how training again would vary."
        )
    elif fewest < ENOUGH_TRAINING_SEEDS:
        sentences.append(
            f"How much the rates vary from training to training: {fewest} training seeds underestimate it, and the "
            "intervals are too narrow by an unknown amount."
        )
    if max(contest.tasks for contest in contests) == 1:
        sentences.append("Anything about other tasks: each comparison is of one.")
    else:
        sentences.append("Anything about other tasks: the tasks are taken as given, not as a sample.")
    return sentences
