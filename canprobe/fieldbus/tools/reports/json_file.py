"""The JSON document of a report, written and read."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

from canprobe.errors import UsageError, check_schema
from canprobe.fieldbus.bus.files import read_document, write_text
from canprobe.fieldbus.tools.reports.report import Report, ReportRow, Severity, Verdict

SCHEMA = 1
"""Version of the document; it rises when a key goes or changes its meaning."""
_MAX_BYTES = 64 << 20
_KINDS: dict[type, str] = {str: "text", list: "a list", dict: "an object"}
Kind = TypeVar("Kind")


def report_document(report: Report) -> dict[str, Any]:
    """The report as one JSON document: `schema`, `counts`, and the attributes of `Report` and `ReportRow`."""
    counts = {verdict.value: number for verdict, number in report.counts().items()}
    return {"schema": SCHEMA, "counts": counts, **asdict(report)}


def write_json(report: Report, path: Path) -> None:
    """Write the document of a report.

    Raises:
        ResultsError: the file cannot be written.
    """
    write_text(path, json.dumps(report_document(report), indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Report:
    """Read a report from its document, whatever else stands in it.

    Raises:
        UsageError: the file cannot be read, is no report, or is of a newer version; the message says where and why.
    """
    expected = "the JSON report of canprobe conform or judge"
    document = read_document(path, _MAX_BYTES, json.loads, expected)
    if not isinstance(document, dict) or "tool" not in document:
        raise UsageError(f"{path}: expected {expected}, got other JSON")
    check_schema(path, document.get("schema"), SCHEMA, "make the report anew with --json")
    try:
        return _parse_report(document)
    except (KeyError, TypeError, ValueError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise UsageError(f"{path}: not a whole report: {what}; make it anew with --json") from error


def _parse_report(document: dict[str, Any]) -> Report:
    distributions = _typed(document["distributions"], dict)
    return Report(
        tool=_text(document["tool"]),
        title=_text(document["title"]),
        facts={name: _text(value) for name, value in _typed(document["facts"], dict).items()},
        rows=[_parse_row(_typed(row, dict)) for row in _typed(document["rows"], list)],
        left_out=[(_text(what), _text(why)) for what, why in _typed(document["left_out"], list)],
        manual=list(_texts(document["manual"])),
        distributions={name: tuple(map(float, _typed(times, list))) for name, times in distributions.items()},
        log=None if document["log"] is None else _text(document["log"]),
    )


def _parse_row(row: dict[str, Any]) -> ReportRow:
    values = {one.name: _PARSERS.get(one.name, _text)(row[one.name]) for one in fields(ReportRow)}
    if values["severity"] not in ("", *Severity):
        raise ValueError(f"severity: expected one of {', '.join(Severity)}, got {values['severity']!r}")
    return ReportRow(**values)


def _text(value: object) -> str:
    return _typed(value, str)


def _texts(value: object) -> tuple[str, ...]:
    return tuple(map(_text, _typed(value, list)))


_PARSERS: dict[str, Callable[[Any], Any]] = {
    **{"verdict": Verdict, "seconds": float},
    **dict.fromkeys(("sent", "came", "written"), _texts),
}
"""What reads the attributes of `ReportRow` that are no text."""


def _typed(value: object, kind: type[Kind]) -> Kind:
    if not isinstance(value, kind):
        raise TypeError(f"expected {_KINDS[kind]}, got {value!r:.60}")
    return value
