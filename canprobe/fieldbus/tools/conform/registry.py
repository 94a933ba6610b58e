"""All points, in the order in which they are examined."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from canprobe.errors import UsageError, did_you_mean
from canprobe.fieldbus.tools.conform.point import Point
from canprobe.fieldbus.tools.conform.points import (
    drive402,
    emcy,
    heartbeat,
    hostile,
    lss,
    nmt,
    objects,
    pdo,
    pdo_parameters,
    sdo,
    sdo_transfers,
    sync,
    timing,
)

LEFT_OUT: tuple[tuple[str, str], ...] = (
    ("46 store and restore (1010h, 1011h)", "never sent: what a device has stored cannot be restored over the bus"),
    ("program and configuration (1F00h to 1FFFh, 1021h to 1026h)", "never written: a device may not start afterwards"),
    ("71 LSS store, 72 another node id, activate bit timing", "a device that keeps another id or rate is lost"),
    ("61 to 65 tactile array", "somebody has to press it; the tests of the emulated array examine them"),
    ("52, 56 to 60, 74: faults, limits and modes in motion", "they need an axis that is loaded or moves"),
)
"""Points that are never examined, and why."""


_MODULES = objects, sdo, sdo_transfers, nmt, heartbeat, pdo_parameters, pdo, sync, emcy, lss, hostile, drive402, timing
POINTS = tuple(point for module in _MODULES for point in vars(module).values() if isinstance(point, Point))
"""All points, in the order of the modules; those that read come first."""


def chosen_points(points: Sequence[Point], names: Iterable[str]) -> tuple[Point, ...]:
    """The points that are named by group, number, or number and name; all where nothing is named.

    Raises:
        UsageError: a name fits none.
    """
    wanted = [name.strip() for name in names if name.strip()]
    known = sorted({word for point in points for word in (point.group, str(point.number), point.title)})
    for name in wanted:
        if name not in known:
            raise UsageError(f"--points {name}: no such group, number or point{did_you_mean(name, known)}; see --list")
    return tuple(point for point in points if not wanted or {point.group, str(point.number), point.title} & set(wanted))
