"""A report as text: lines of a terminal, and the step summary of GitHub."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from canprobe.fieldbus.bus.files import writing
from canprobe.fieldbus.tools.reports.baseline import ReportChange
from canprobe.fieldbus.tools.reports.report import Report, ReportRow, Verdict, printable

MARKS = {Verdict.PASS: "pass", Verdict.FAIL: "FAIL", Verdict.NOT_APPLICABLE: "n/a", Verdict.ERROR: "ERROR"}
"""Mark of a row on a terminal."""
_WORST_ROWS = 3
"""Rows that the verdict shows."""
_OPTION = re.compile(r"--[a-z]+")
_MAX_SUMMARY_ROWS = 200
"""Rows of a step summary; GitHub refuses summaries of more than 1 MiB."""


def row_text(row: ReportRow) -> str:
    """One row for a terminal: mark and name, and a line of detail where it did not pass."""
    head = f"{MARKS[row.verdict]:5}  {row.group:9} {row.name}"
    detail = f"{row.detail} [{row.clause}]" if row.clause and row.verdict is not Verdict.NOT_APPLICABLE else row.detail
    lines = [head] if row.verdict is Verdict.PASS or not row.detail else [head, f"       {_line(detail)}"]
    return printable("\n".join(lines))


def verdict_text(report: Report, change: ReportChange | None = None) -> str:
    """The verdict in some lines: whether it passes, the counts, the worst rows, and which options examine more."""
    counts = report.counts()
    examined = counts[Verdict.PASS] + counts[Verdict.FAIL]
    points = f"{examined} point{'s' if examined != 1 else ''}"
    if counts[Verdict.FAIL]:
        head = f"{report.title}: {counts[Verdict.FAIL]} of {points} FAIL"
    elif counts[Verdict.ERROR]:
        head = f"{report.title}: not examined to the end"
    else:
        head = f"{report.title}: passes, {points}"
    lines = [head, ", ".join(f"{number} {MARKS[verdict]}" for verdict, number in counts.items() if number)]
    causes: dict[str, list[ReportRow]] = {}
    for row in sorted(report.bad, key=lambda row: row.verdict is not Verdict.FAIL):
        causes.setdefault(row.detail if row.verdict is Verdict.ERROR else f"{row.group} {row.name}", []).append(row)
    for rows in [*causes.values()][:_WORST_ROWS]:
        more = f" (and {len(rows) - 1} more)" if len(rows) > 1 else ""
        clause = f" [{rows[0].clause}]" if rows[0].clause else ""
        lines.append(
            f"{MARKS[rows[0].verdict]:5}  {rows[0].group} {rows[0].name}{more}: {_line(rows[0].detail)}{clause}"
        )
    if len(causes) > _WORST_ROWS:
        lines.append(f"       and {len(causes) - _WORST_ROWS} more")
    options = Counter(
        option for row in report.rows if row.verdict is Verdict.NOT_APPLICABLE for option in _OPTION.findall(row.detail)
    )
    if options:
        lines.append(f"more points with: {', '.join(f'{option} ({number})' for option, number in options.items())}")
    return printable("\n".join([*lines, *_last_lines(report, change)]))


def closing_text(report: Report, change: ReportChange | None = None) -> str:
    """The closing table: a line for each group with its counts, their sum, and what changed since the baseline."""
    counts = {group: Counter(row.verdict for row in rows) for group, rows in report.groups().items()}
    cells = [["", *MARKS.values()]]
    cells += [[group, *(str(row[verdict] or "-") for verdict in MARKS)] for group, row in counts.items()]
    cells.append(["in all", *map(str, report.counts().values())])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = [
        "  ".join([name.ljust(widths[0]), *(one.rjust(width) for one, width in zip(numbers, widths[1:], strict=True))])
        for name, *numbers in cells
    ]
    lines += [f"left out: {what}: {why}" for what, why in report.left_out]
    lines += [f"by hand: {step}" for step in report.manual]
    return printable("\n".join(line.rstrip() for line in [*lines, *_last_lines(report, change)]))


def append_step_summary(report: Report, environ: Mapping[str, str], change: ReportChange | None = None) -> None:
    """Append a summary in Markdown to the file GITHUB_STEP_SUMMARY, where GitHub Actions names one.

    Args:
        report: the report.
        environ: environment of the process.
        change: what changed since the baseline.

    Raises:
        ResultsError: the file cannot be written.
    """
    path = environ.get("GITHUB_STEP_SUMMARY")
    if not path:
        return
    counts = ", ".join(f"{number} {MARKS[verdict]}" for verdict, number in report.counts().items() if number)
    lines = [f"### canprobe {report.tool}: {_cell(report.title)}", "", counts or "nothing was examined", ""]
    lines += [f"- baseline: {_cell(line)}" for line in change.lines()] if change is not None else []
    bad = report.bad
    if bad:
        lines += ["", "| | point | what was wrong | clause |", "| --- | --- | --- | --- |"]
    for row in bad[:_MAX_SUMMARY_ROWS]:
        texts = (MARKS[row.verdict], f"{row.group} {row.name}", row.detail, row.clause)
        lines.append(f"| {' | '.join(map(_cell, texts))} |")
    if len(bad) > _MAX_SUMMARY_ROWS:
        lines += ["", f"{len(bad) - _MAX_SUMMARY_ROWS} more, which the files of the report have"]
    with writing(Path(path)), open(path, "a", encoding="utf-8") as file:
        file.write("\n".join(lines) + "\n\n")


def _last_lines(report: Report, change: ReportChange | None) -> list[str]:
    baseline = [f"baseline: {line}" for line in change.lines()] if change is not None else []
    return baseline if report.log is None else [*baseline, f"log: {report.log}"]


def _line(text: str) -> str:
    """The text on one line."""
    return " ".join(text.split())


def _cell(text: str) -> str:
    """The text in one cell of a table in Markdown."""
    import html

    return html.escape(printable(_line(text)), quote=False).replace("|", "\\|")
