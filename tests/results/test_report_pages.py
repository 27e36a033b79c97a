import csv
import re

from made_up import drawn

from ugr_lightning.results.report import build_report
from ugr_lightning.results.report_pages import to_markdown, write_report


def table2():
    return build_report(
        [
            drawn(policy, rate, n=30, seed=t, training_seed=t)
            for policy, rate in (("base", 0.5), ("uncert", 0.9), ("<b>|", 0.7))
            for t in (0, 1)
        ]
    )


def test_markdown_has_a_row_for_every_rate_and_comparison():
    text = to_markdown(table2(), "Table 2")
    assert text.startswith("# Table 2\n\n## Conclusion\n\n**What may be concluded:**\n\n- `uncert` succeeds")
    rows = [line for line in text.splitlines() if line.startswith("| click")]
    assert len(rows) == 3 + 3
    assert all(len(re.split(r"(?<!\\)\|", row)) == len(re.split(r"(?<!\\)\|", rows[0])) for row in rows[:3])
    assert re.search(r"\| `base` \| \d+/60 = [\d.]+% \| \[[\d.]+%, [\d.]+%\] \| 0: \d+/30, 1: \d+/30 \| 0 \|", text)


def overview(report):
    section = to_markdown(report, "t").split("## Overview\n\n")[1].split("\n\n")[0]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in section.splitlines()]


def test_the_overview_of_one_task_has_a_row_for_every_policy():
    head, _, *rows = overview(table2())
    assert head == ["policy", "click_alarmclock, aggregated chunks"]
    assert [row[0] for row in rows] == ["`base`", "`uncert`", "`<b>\\|`"]
    base = table2().rates[0].total
    assert rows[0][1] == f"{base.successes}/60 [{100 * base.low:.1f}, {100 * base.high:.1f}]"


def test_the_overview_of_one_task_has_a_column_for_every_execution():
    parts = [drawn("a", 0.5, n=20, task="mug"), drawn("b", 1.0, n=20, task="mug", execution="25")]
    head, _, *rows = overview(build_report(parts))
    assert head == ["policy", "mug, aggregated chunks", "mug, 25 steps of each chunk"]
    assert rows[0][2] == rows[1][1] == ""
    assert rows[1] == ["`b`", "", "20/20 [83.9, 100.0]"]


def test_the_overview_keeps_the_order_of_the_policies_in_every_execution():
    parts = [drawn("a", 0.5, task="mug"), drawn("b", 0.5, task="mug", execution="25")]
    parts += [drawn("a", 0.5, task="handover_block", execution="25")]  # in that execution `b` has come first
    rows = overview(build_report(parts))[2:]
    assert [(row[0], row[1]) for row in rows] == [
        ("`a`", "aggregated chunks"),
        ("`a`", "25 steps of each chunk"),
        ("`b`", "25 steps of each chunk"),
    ]


def test_the_overview_adds_up_tasks_only_where_all_have_as_many_episodes():
    even = [drawn("a", 0.5, n=20, seed=task == "handover_block", task=task) for task in ("mug", "handover_block")]
    head, _, row = overview(build_report(even))
    assert head[2:] == ["mug", "handover_block", "all tasks"]
    assert row[4].startswith(f"{sum(int(cell.split('/')[0]) for cell in row[2:4])}/40 [")
    uneven = build_report([even[0], drawn("a", 0.5, n=10, task="handover_block")])
    assert overview(uneven)[2][4] == ""
    missing = overview(build_report([*even, drawn("b", 0.5, n=20, task="mug")]))
    assert missing[3][3:] == ["", ""]


def test_csv_files_hold_the_numbers_unrounded(tmp_path):
    report = table2()
    paths = write_report(report, tmp_path / "new", "t")
    assert [path.name for path in paths] == ["report.md", "rates.csv", "comparisons.csv"]
    rates = list(csv.DictReader(paths[1].open()))
    assert len(rates) == 3 * 3
    assert float(rates[2]["low"]) == report.rates[0].total.low
    contests = list(csv.DictReader(paths[2].open()))
    assert [float(row["p_holm"]) for row in contests] == [contest.p_holm for contest in report.contests]
    assert contests[0]["execution"] == "aggregate"
