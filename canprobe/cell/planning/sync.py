"""The cycle in CANopen's objects: the SYNC period, and the SYNCs of one tactile frame."""

from __future__ import annotations

from canprobe.cell.planning.model import (
    SYNC_OVERFLOW,
    SyncPlan,
)
from canprobe.cell.scene.setup import Setup

CYCLES_TO_EFFECT = 2
"""Cycles from a SYNC until its command begins to take effect; the lag of the drives comes on top."""
_TOLERANCE = 1e-5  # of a rate written with six digits


def plan_sync(setup: Setup) -> tuple[SyncPlan, bool]:
    """The SYNC of a scene, in whole µs, and whether it has exactly the rate of the scene.

    Source: CiA 301 object 1006h (period in µs).
    """
    period_us = max(1, round(1e6 / setup.rate_hz))
    exact = abs(period_us * setup.rate_hz / 1e6 - 1) < _TOLERANCE
    return SyncPlan(1e6 / period_us, period_us * 1000, period_us, SYNC_OVERFLOW), exact


def plan_ratio(setup: Setup) -> tuple[int, str | None, list[float]]:
    """Number of SYNCs for one tactile frame (18xxh:02), why the rate is not possible, and the possible ones, Hz.

    The possible rates are listed where the rate is not, the nearest first.
    """
    array = setup.array
    if array is None or (array.raw is not None and array.raw.sampling == "free"):
        return 1, None, []
    exact = setup.rate_hz / array.rate_hz
    ratio = max(1, round(exact))
    if abs(exact / ratio - 1) < _TOLERANCE and (SYNC_OVERFLOW % ratio == 0 or array.raw is not None):
        return ratio, None, []
    counts = [count for count in range(1, SYNC_OVERFLOW + 1) if array.raw is not None or SYNC_OVERFLOW % count == 0]
    rates = [setup.rate_hz / count for count in sorted(counts, key=lambda count: abs(count - exact))]
    what = f"sensor.rate_hz = {array.rate_hz:g}: "
    if array.raw is not None:
        return ratio, f"{what}an image every {exact:.4g} cycles cannot be asked for", rates
    what += f"a frame every {exact:.4g} SYNCs cannot be triggered; the SYNC counter runs to {SYNC_OVERFLOW}, so"
    return min(ratio, SYNC_OVERFLOW), f"{what} cycle.rate_hz must be 1, 2, 3, 4, 5, 6, 8, … times it", rates
