"""A report as one HTML file for people. It loads nothing from anywhere, so it can be kept and mailed."""

from __future__ import annotations

import html
import statistics
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path

from canprobe.fieldbus.bus.files import write_text
from canprobe.fieldbus.tools.reports.baseline import ReportChange
from canprobe.fieldbus.tools.reports.report import Report, ReportRow, Verdict, printable

NO_CERTIFICATE = (
    "This is a report of canprobe. It is no CiA certificate, and no proof of safety: it states what was sent, what"
    " came, and what the cited clauses accept."
)
_CLASSES = {Verdict.PASS: "pass", Verdict.FAIL: "fail", Verdict.NOT_APPLICABLE: "na", Verdict.ERROR: "error"}
_STYLE = files(__package__).joinpath("page.css").read_text(encoding="utf-8")
_WORST_ROWS = 10
"""Rows of each verdict that the page begins with."""
_BARS = 40
"""Number of bars of a distribution."""


def write_html(report: Report, path: Path, change: ReportChange | None = None) -> None:
    """Write a report as one HTML file; rows that failed are open.

    Args:
        report: the report.
        path: path of the file.
        change: what changed since the baseline; None where there is none.

    Raises:
        ResultsError: the file cannot be written.
    """
    title = _text(f"canprobe {report.tool}: {report.title}")
    counts = "".join(
        f'<span class="{_CLASSES[verdict] if number else "none"}">{number} {_text(verdict.lower())}</span>'
        for verdict, number in report.counts().items()
    )
    facts = [(name, _text(value)) for name, value in report.facts.items()]
    facts += [("log", _text(report.log))] if report.log is not None else []
    body = [
        f'<h1>{title}</h1><p class="counts">{counts}</p>',
        *_worst(report),
        *_section("Device and bench", _facts(facts)),
        *_section("Since the baseline", _list([] if change is None else change.lines())),
        *(line for group, rows in report.groups().items() for line in _group(group, rows)),
        *_section("Measured times", _times(report.distributions) if report.distributions else ""),
        *_section("Left out", _facts((what, _text(why)) for what, why in report.left_out)),
        *_section("Steps by hand", _list(report.manual)),
        f"<footer>{_text(NO_CERTIFICATE)}</footer>",
    ]
    head = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>\n{_STYLE}</style></head><body>"
    )
    write_text(path, "\n".join([head, *body, "</body></html>\n"]))


def _worst(report: Report) -> Iterable[str]:
    """What failed, before everything else."""
    for verdict in (Verdict.FAIL, Verdict.ERROR):
        for row in [row for row in report.rows if row.verdict is verdict][:_WORST_ROWS]:
            mark = f'<b class="{_CLASSES[verdict]}">{_text(verdict)}</b>'
            yield f"<p>{mark} {_text(row.group)} {_text(row.name)}: {_text(row.detail)}</p>"


def _group(group: str, rows: Sequence[ReportRow]) -> Iterable[str]:
    """One group: a line for each row, which opens."""
    yield f"<h2>{_text(group)}</h2>"
    for row in rows:
        opened = " open" if row.verdict in (Verdict.FAIL, Verdict.ERROR) else ""
        mark = f'<b class="{_CLASSES[row.verdict]}">{_text(row.verdict)}</b>'
        beside = row.detail if row.verdict is Verdict.NOT_APPLICABLE else row.severity
        entries = [
            ("found", _text(row.detail)),
            ("expected", _text(row.expected)),
            ("clause", _text(row.clause)),
            ("sent", _pre(row.sent)),
            ("came", _pre(row.came)),
            ("written", _pre(row.written)),
            ("hint", _text(row.hint)),
            ("time", f"{row.seconds:.3f} s"),
        ]
        table = _facts([(name, value) for name, value in entries if value])
        summary = f"<summary>{mark} {_text(row.name)} <small>{_text(beside)}</small></summary>"
        yield f"<details{opened}>{summary}{table}</details>"


def _section(name: str, content: str) -> list[str]:
    """A heading and what stands below it, if there is anything."""
    return [f"<h2>{name}</h2>", content] if content else []


def _times(distributions: dict[str, tuple[float, ...]]) -> str:
    """A table of distributions: quantiles, and bars from the least to the greatest time."""
    names = ("count", "least", "median", "95 %", "99 %", "greatest")
    header = "".join(f'<th class="number">{name}</th>' for name in names)
    lines = [f"<table><tr><th>ms</th>{header}<th>from least to greatest</th></tr>"]
    for name, times in distributions.items():
        if not times:
            continue
        cuts = statistics.quantiles(times, n=100, method="inclusive") if len(times) > 1 else [times[0]] * 99
        figures = (min(times), cuts[49], cuts[94], cuts[98], max(times))
        cells = "".join(f'<td class="number">{one:.3f}</td>' for one in figures)
        lines.append(
            f'<tr><th>{_text(name)}</th><td class="number">{len(times)}</td>{cells}<td>{_histogram(times)}</td></tr>'
        )
    return "\n".join([*lines, "</table>"])


def _histogram(times: Sequence[float]) -> str:
    """Bars of how often each time came."""
    least, span = min(times), max(times) - min(times)
    bars = [0] * _BARS
    for one in times:
        bars[min(int((one - least) / span * _BARS), _BARS - 1) if span > 0 else 0] += 1
    height = 28 / max(bars)
    rects = "".join(
        f'<rect x="{4 * number}" y="{30 - height * bar:.1f}" width="3" height="{height * bar:.1f}"/>'
        for number, bar in enumerate(bars)
        if bar
    )
    return f'<svg width="{4 * _BARS}" height="30" role="img" aria-label="histogram">{rects}</svg>'


def _facts(entries: Iterable[tuple[str, str]]) -> str:
    """A table of two columns; the values are HTML."""
    rows = "".join(f"<tr><th>{_text(name)}</th><td>{value}</td></tr>" for name, value in entries)
    return f'<table class="facts">{rows}</table>' if rows else ""


def _list(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{_text(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def _pre(lines: Sequence[str]) -> str:
    return f"<pre>{_text(chr(10).join(lines))}</pre>" if lines else ""


def _text(text: str) -> str:
    return html.escape(printable(text))
