"""`ugr report`: results to Markdown and CSV, and how many episodes a comparison needs."""

from functools import partial
from pathlib import Path

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.errors import ConfigError


def _report(
    paths: list[str] = [],  # noqa: B006 - jsonargparse copies it
    runs: list[str] = [],  # noqa: B006
    baseline: str | None = None,
    out: str | None = None,
    title: str = "Results",
    power: list[float] | None = None,
    discordance: float | None = None,
) -> int:
    """Compare policies: success with intervals, paired tests, and what may be concluded from them.

    Args:
        paths: folders of `ugr benchmark`, or of earlier reports.
        runs: single results files, each `NAME=FILE`; one name may occur for several training seeds. `NAME=FILE@WHICH`
            is one policy of several in a file, by its name or by how its checkpoint's SHA-256 begins.
        baseline: compare the others with this policy only; null compares all pairs.
        out: folder for `report.md`, `rates.csv`, `comparisons.csv` and `summary.jsonl`, of which
            the same report can be made again; null prints Markdown.
        title: heading of the report.
        power: instead of a report, the episodes needed to tell two success rates apart, such as `0.90 0.95`.
        discordance: with `power`, the share of shared seeds on which exactly one policy succeeds; null for a table.
    """
    if power is not None:
        return _plan(power, discordance)
    if not paths and not runs:
        fix = "Give a results folder of `ugr benchmark`, or --runs base=runs/base/version_0/evaluation.jsonl ..."
        raise ConfigError("ugr report", "results", "none", fix)
    from ugr_lightning.results.evaluations import read_labelled
    from ugr_lightning.results.report import build_report
    from ugr_lightning.results.report_pages import to_markdown, write_report
    from ugr_lightning.results.summaries import SUMMARY_FILE, read_evaluations, write_summary

    evaluations = [item for path in paths for item in read_evaluations(path)]
    for text in runs:
        label, separator, path = text.partition("=")
        if not separator or not label or not path:
            raise ConfigError(
                "--runs", "NAME=FILE", text, "For example --runs base=runs/base/version_0/evaluation.jsonl"
            )
        evaluations.append(read_labelled(label, Path(path).expanduser()))
    if not any(item.results for item in evaluations):
        raise ConfigError("ugr report", "episodes", f"none in {', '.join(paths)}", "Let `ugr benchmark` end first.")
    report = build_report(evaluations, baseline=baseline)
    if out is None:
        print(to_markdown(report, title), end="")
    else:
        written = write_report(report, Path(out), title)
        write_summary(evaluations, Path(out) / SUMMARY_FILE)
        print(*written, Path(out) / SUMMARY_FILE, sep="\n")
    return 0


run = partial(call, _report, leading=["paths"])


def _plan(power: list[float], discordance: float | None) -> int:
    from ugr_lightning.results.power import plan

    if len(power) != 2:
        raise ConfigError("--power", "two success rates, such as 0.90 0.95", power, "Give both.")
    a, b = power
    largest = a * (1 - b) + b * (1 - a)
    shares = (
        {"as given": discordance}
        if discordance is not None
        else {
            "the outcomes are independent": largest,
            "half as many seeds differ": max(abs(a - b), largest / 2),
            "the worse one never wins": abs(a - b),
        }
    )
    rows = [("each on seeds of its own", plan(a, b, discordance=discordance).unpaired)]
    for name, share in shares.items():
        rows.append((f"shared seeds, {share:.1%} of them differ ({name})", plan(a, b, discordance=share).paired))
    width = max(len(row[0]) for row in rows)
    print(f"Episodes of each policy to tell {a:.1%} from {b:.1%}: two-sided level 5 %, power 80 %\n")
    print("\n".join(f"{what:<{width}}{count:>8}" for what, count in rows))
    return 0
