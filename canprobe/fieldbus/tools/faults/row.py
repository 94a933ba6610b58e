"""How a row of the registry of faults is written."""

from __future__ import annotations

from collections.abc import Callable

from canprobe.fieldbus.tools.faults.fault import FOREVER_NS, Effect, Fault, FaultKind, Host, Parameter

SHORT_NS = 100_000_000
"""Duration of a power failure and of bus-off where none is given."""
UNANSWERED, MOST = "unanswered", "most"
"""In the place of points: the device does not answer, so that none is examined; most of those examined fail."""
LOST = "pdo_missed drive_late drive_silent"
"""Conditions of a drive whose TPDOs do not come."""


def make_kind(
    name: str,
    effect: Callable[[Fault, Host], Effect],
    what: str,
    clause: str,
    reaction: str,
    *,
    trips: str = "",
    fails: str = "",
    incoming: bool | None = None,
    needs: str = "node",
    lasts_ns: int = FOREVER_NS,
    **parameters: Parameter,
) -> FaultKind:
    """A row; `trips` are keys of conditions and `fails` points, with blanks; `parameters` are the kind's numbers."""
    keys, points = frozenset(trips.split()), frozenset(fails.split())
    return FaultKind(name, what, clause, reaction, effect, keys, points, parameters, incoming, needs, lasts_ns)


def in_ms(default: float, what: str) -> Parameter:
    """A time in milliseconds, up to an hour."""
    return Parameter(default, 0.001, 3_600_000, what)


def error_code(default: int, what: str) -> Parameter:
    """An emergency error code."""
    return Parameter(default, 0, 0xFFFF, what)
