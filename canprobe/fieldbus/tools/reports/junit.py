"""JUnit XML of a report, as CI servers read it.

GitLab takes class name, name, time, the text of a failure or an error, and system-out; it ignores properties and drops
cases with equal names. Jenkins reads `[[ATTACHMENT|path]]` from system-out. GitHub shows none by itself; actions do.
So all that matters stands in names, failure texts and system-out.

Source: GitLab, unit test reports; Jenkins, junit-plugin and its attachments; the schema `junit-10.xsd` of its
xunit-plugin.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from canprobe.fieldbus.bus.files import write_text
from canprobe.fieldbus.tools.reports.report import Report, ReportRow, Verdict, printable

_MAX_FRAMES = 200
"""Frames of a row that are written; GitLab refuses files of more than 30 MB. The JSON document has all."""


def write_junit(report: Report, path: Path) -> None:
    """Write a report as JUnit XML: a suite ``canprobe.<tool>.<group>`` for each group, a case for each row.

    A failed row is a failure of the type of its clause, one that does not apply or is known is skipped, and an error is
    an error.

    Raises:
        ResultsError: the file cannot be written.
    """
    rows = [_skipped(row) if row.verdict is Verdict.FAIL and row.key in report.known else row for row in report.rows]
    report = replace(report, rows=rows)
    root = ElementTree.Element("testsuites", {"name": f"canprobe {report.tool}", **_totals(report.rows)})
    del root.attrib["skipped"]  # the schema of Jenkins has it at a suite only
    for group, rows in report.groups().items():
        suite_name = f"canprobe.{report.tool}.{printable(group)}"
        suite = ElementTree.SubElement(root, "testsuite", {"name": suite_name, **_totals(rows)})
        seen: Counter[str] = Counter()
        for row in rows:
            seen[row.name] += 1
            name = row.name if seen[row.name] == 1 else f"{row.name} ({seen[row.name]})"
            _add_case(suite, row, suite_name, printable(name), report)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode", xml_declaration=False)
    write_text(path, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')


def _skipped(row: ReportRow) -> ReportRow:
    return replace(row, verdict=Verdict.NOT_APPLICABLE, detail=f"known, it failed in the baseline too: {row.detail}")


def _totals(rows: Sequence[ReportRow]) -> dict[str, str]:
    counts = Counter(row.verdict for row in rows)
    return {
        "tests": str(len(rows)),
        "failures": str(counts[Verdict.FAIL]),
        "errors": str(counts[Verdict.ERROR]),
        "skipped": str(counts[Verdict.NOT_APPLICABLE]),
        "time": f"{sum(row.seconds for row in rows):.3f}",
    }


def _add_case(suite: ElementTree.Element, row: ReportRow, class_name: str, name: str, report: Report) -> None:
    test = ElementTree.SubElement(suite, "testcase", classname=class_name, name=name, time=f"{row.seconds:.3f}")
    clause, detail = printable(row.clause), printable(row.detail)
    match row.verdict:
        case Verdict.NOT_APPLICABLE:
            ElementTree.SubElement(test, "skipped", message=detail)
        case Verdict.FAIL | Verdict.ERROR:
            tag = "failure" if row.verdict is Verdict.FAIL else "error"
            ElementTree.SubElement(test, tag, type=clause or "canprobe", message=detail).text = _text_of(row)
    lines = [*_frames("sent", row.sent), *_frames("came", row.came), *(f"written: {one}" for one in row.written)]
    if row.verdict is Verdict.FAIL and report.log is not None:
        lines.append(f"[[ATTACHMENT|{os.path.abspath(report.log)}]]")
    if lines:
        ElementTree.SubElement(test, "system-out").text = printable("\n".join(lines))


def _text_of(row: ReportRow) -> str:
    """The text of a failure, which is what GitLab and Jenkins show of it."""
    severity = f" ({row.severity})" if row.severity else ""
    lines = [f"{row.detail}{severity}", f"clause: {row.clause}", f"expected: {row.expected}"]
    lines += [*_frames("sent", row.sent), *_frames("came", row.came), f"hint: {row.hint}"]
    return printable("\n".join(line for line in lines if not line.endswith(": ")))


def _frames(kind: str, frames: Sequence[str]) -> list[str]:
    rest = len(frames) - _MAX_FRAMES
    more = [f"{kind}: {rest} more frames, which the JSON report has"] if rest > 0 else []
    return [f"{kind}: {frame}" for frame in frames[:_MAX_FRAMES]] + more
