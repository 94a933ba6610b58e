"""Comparison of a report with an older one of the same device."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from canprobe.errors import UsageError
from canprobe.fieldbus.tools.reports.report import IDENTITY, Report, ReportRow, Verdict

_DEVICE = ("vendor", "product")
"""Facts that are those of another device where they differ; the others tell two versions of one apart."""
_BADNESS = {Verdict.PASS: 0, Verdict.NOT_APPLICABLE: 0, Verdict.ERROR: 1, Verdict.FAIL: 2}


@dataclass(frozen=True, slots=True)
class ReportChange:
    """What changed since an older report; rows stand as ``group name``.

    Attributes:
        device: facts of the device that changed: (name, old, new).
        worse: rows that passed or did not apply and now fail, or that now end with an error.
        better: rows that failed or ended with an error and do so no more.
        new: rows that the older report does not have.
        gone: rows that only the older report has.
    """

    device: tuple[tuple[str, str, str], ...]
    worse: tuple[str, ...]
    better: tuple[str, ...]
    new: tuple[str, ...]
    gone: tuple[str, ...]

    def lines(self) -> list[str]:
        """What changed, a line for each kind of change; one line where nothing did."""
        lines = [f"{name}: {old or 'unknown'} -> {new or 'unknown'}" for name, old, new in self.device]
        for kind, keys in (("worse", self.worse), ("better", self.better), ("new", self.new), ("gone", self.gone)):
            lines += [f"{kind}: {', '.join(keys)}"] if keys else []
        return lines or ["as in the baseline"]


def compare(report: Report, older: Report) -> ReportChange:
    """Compare a report with an older one.

    Raises:
        UsageError: the older report is of another tool or device: baselines are known by vendor and product.
    """
    if older.tool != report.tool:
        raise UsageError(f"baseline: expected a report of canprobe {report.tool}, got one of canprobe {older.tool}")
    for name in _DEVICE:
        old, new = older.facts.get(name, ""), report.facts.get(name, "")
        if old and new and old != new:
            raise UsageError(
                f"baseline: it is of another device: {name} {old}, expected {new}; name a report of this one"
            )
    before, now = _worst(older.rows), _worst(report.rows)
    both = [key for key in now if key in before]
    facts = [(name, older.facts.get(name, ""), report.facts.get(name, "")) for name in IDENTITY]
    return ReportChange(
        device=tuple((name, old, new) for name, old, new in facts if old != new),
        worse=tuple(key for key in both if now[key] > before[key]),
        better=tuple(key for key in both if now[key] < before[key]),
        new=tuple(key for key in now if key not in before),
        gone=tuple(key for key in before if key not in now),
    )


def _worst(rows: Iterable[ReportRow]) -> dict[str, int]:
    """How bad each row is, by its key; of rows with one key the worst counts."""
    worst: dict[str, int] = {}
    for row in rows:
        worst[row.key] = max(worst.get(row.key, 0), _BADNESS[row.verdict])
    return worst
