"""Can the cycle be said in CANopen's objects: SYNC period, interpolation period, tactile trigger."""

from __future__ import annotations

from canprobe.planning.model import SYNC_OVERFLOW, SyncPlan
from canprobe.scene_setup import Setup

INTERPOLATION_US = 100  # 60C2h with index −4
INTERPOLATION_MAX = 255  # 60C2h:01 is an UNSIGNED8
_TOLERANCE = 1e-5  # of a rate written with six digits


def plan_sync(setup: Setup) -> tuple[SyncPlan, list[str]]:
    """The SYNC of a scene, and why its period cannot be had.

    Source: CiA 301 object 1006h (period in µs), CiA 402 object 60C2h (interpolation period, here n·10⁻⁴ s).
    """
    step_us = 1 if setup.arm is None else INTERPOLATION_US
    period_us = max(1, round(1e6 / setup.rate_hz / step_us)) * step_us
    exact = abs(period_us * setup.rate_hz / 1e6 - 1) < _TOLERANCE
    units = period_us // INTERPOLATION_US
    problems = []
    if not exact:
        problems.append(_not_representable(setup.rate_hz, step_us))
    if setup.arm is not None and units > INTERPOLATION_MAX:
        slowest = 1e6 / (INTERPOLATION_MAX * INTERPOLATION_US)
        problems.append(
            f"cycle.rate_hz = {setup.rate_hz:g}: 60C2h holds at most {INTERPOLATION_MAX}·10⁻⁴ s; "
            f"take {slowest:.1f} Hz or more"
        )
    interpolation = None if setup.arm is None else units
    return SyncPlan(1e6 / period_us, period_us * 1000, period_us, SYNC_OVERFLOW, interpolation), problems


def _not_representable(rate_hz: float, step_us: int) -> str:
    what = "1006h counts µs" if step_us == 1 else "1006h counts µs and 60C2h n·10⁻⁴ s"
    below = int(1e6 / rate_hz / step_us)
    near = sorted(1e6 / (count * step_us) for count in (below, below + 1) if count > 0)
    return (
        f"cycle.rate_hz = {rate_hz:g}: a SYNC period of {1e6 / rate_hz:.3f} µs cannot be set ({what}); "
        f"take {' or '.join(f'{rate:.6g}' for rate in near)} Hz"
    )


def plan_ratio(setup: Setup) -> tuple[int, list[str]]:
    """How many SYNCs make one tactile frame (18xxh:02), and why the rate cannot be had."""
    if setup.array is None:
        return 1, []
    exact = setup.rate_hz / setup.array.rate_hz
    ratio = max(1, round(exact))
    if abs(exact / ratio - 1) < _TOLERANCE and SYNC_OVERFLOW % ratio == 0:
        return ratio, []
    fitting = [count for count in range(1, SYNC_OVERFLOW + 1) if SYNC_OVERFLOW % count == 0]
    near = sorted(fitting, key=lambda count: abs(count - exact))[:2]
    rates = " or ".join(f"{setup.rate_hz / count:.6g}" for count in sorted(near))
    return min(ratio, SYNC_OVERFLOW), [
        f"sensor.rate_hz = {setup.array.rate_hz:g}: a frame every {exact:.4g} SYNCs cannot be triggered; the SYNC "
        f"counter runs to {SYNC_OVERFLOW}, so cycle.rate_hz must be 1, 2, 3, 4, 5, 6, 8, … times it; take {rates} Hz"
    ]
