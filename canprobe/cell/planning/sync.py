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


def plan_ratio(setup: Setup) -> tuple[int, list[str]]:
    """Number of SYNCs for one tactile frame (18xxh:02), and why the rate is not possible."""
    array = setup.array
    if array is None or (array.raw is not None and array.raw.sampling == "free"):
        return 1, []
    exact = setup.rate_hz / array.rate_hz
    ratio = max(1, round(exact))
    if abs(exact / ratio - 1) < _TOLERANCE and (SYNC_OVERFLOW % ratio == 0 or array.raw is not None):
        return ratio, []
    if array.raw is not None:
        rates = f"{setup.rate_hz / ratio:.6g} or {setup.rate_hz / (ratio + 1):.6g}"
        what = f"an image every {exact:.4g} cycles cannot be asked for; take {rates} Hz"
        return ratio, [f"sensor.rate_hz = {array.rate_hz:g}: {what}"]
    fitting = [count for count in range(1, SYNC_OVERFLOW + 1) if SYNC_OVERFLOW % count == 0]
    near = sorted(fitting, key=lambda count: abs(count - exact))[:2]
    rates = " or ".join(f"{setup.rate_hz / count:.6g}" for count in sorted(near))
    return min(ratio, SYNC_OVERFLOW), [
        f"sensor.rate_hz = {array.rate_hz:g}: a frame every {exact:.4g} SYNCs cannot be triggered; the SYNC "
        f"counter runs to {SYNC_OVERFLOW}, so cycle.rate_hz must be 1, 2, 3, 4, 5, 6, 8, … times it; take {rates} Hz"
    ]
