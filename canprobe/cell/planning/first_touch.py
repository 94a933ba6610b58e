"""The first touch of a plan: the force from which the array shows a contact, and the force until the probe stops.

A taxel counts from a threshold on. The worst place for a contact is the corner of four taxels: each of them shows the
share q² of its force, q = ½ erf(p / (√2 σ)) with p the pitch and σ the blur. So the array shows a contact from the
force threshold · p² / q² on, and less than half of twice that force.

Until an image shows the contact, and the command that follows takes effect, the probe goes on at its speed. The depth δ
on an object of principal curvatures κ asks for the force π k δ² / (2 √(AB)), with A and B = ½ (1/R + κ), and for no
more than k δ times the area of the array.

Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from canprobe.cell.planning.contact import BLUR_TAXELS, half_curvatures, layer_depth
from canprobe.cell.planning.force import highest_known_force
from canprobe.cell.planning.sync import CYCLES_TO_EFFECT
from canprobe.cell.scene.setup import Array, Calibrate, Probe, Setup, Touch
from canprobe.errors import at_least, at_most
from canprobe.mechanics.touch.pad import COUNTS_MAX, THRESHOLD_COUNTS
from canprobe.mechanics.touch.stops import TOUCH_FORCE

MIN_SHOWN_SHARE = 0.5
"""Share of the force that the array must show, whatever the place of the contact between its taxels."""


def first_shown_n(array: Array) -> float:
    """Force (N) from which the array shows a contact, wherever on its grid."""
    pad = array.pad
    if not pad.is_grid:
        return TOUCH_FORCE
    share = 0.5 * math.erf(1.0 / (math.sqrt(2.0) * BLUR_TAXELS))
    threshold_pa = pad.full_scale_pa * THRESHOLD_COUNTS / COUNTS_MAX
    return max(TOUCH_FORCE, threshold_pa * (pad.pitch_m / share) ** 2)


def force_at(depth: float, probe: Probe, array: Array, kappa: Sequence[float]) -> float:
    """Force (N) that presses the layer in by a depth (m) on an object of principal curvatures (2,), 1/m."""
    (a, b), area = half_curvatures(probe, kappa), float(array.pad.areas.sum())
    return probe.stiffness * depth * min(math.pi * depth / (2.0 * math.sqrt(a * b)), area)


def depth_at(force_n: float, probe: Probe, array: Array, kappa: Sequence[float]) -> float:
    """Depth (m) of the layer under a force: the inverse of `force_at`."""
    return max(layer_depth(force_n, probe, kappa), force_n / (probe.stiffness * float(array.pad.areas.sum())))


def blind_s(rate_hz: float, array: Array, lag_s: float) -> float:
    """Longest time from the moment when the array can show the contact to the end of the approach, s.

    Args:
        rate_hz: rate of the cycle.
        array: the array.
        lag_s: lag of the drives behind a ramp.

    The next image comes up to a period later, it arrives a period after its sample (a device of raw frames says how
    much later), and the command of that cycle takes effect `CYCLES_TO_EFFECT` later, behind the lag of the drives.
    """
    period_s = 1.0 / array.rate_hz
    arrives_s = period_s if array.raw is None else array.raw.latency_s
    return period_s + arrives_s + CYCLES_TO_EFFECT / rate_hz + lag_s


def first_touch_problems(setup: Setup, task: Touch | Calibrate, kappa: Sequence[float]) -> Iterator[str]:
    """Why a touch cannot begin: the array does not show its force, or shows it when the probe presses too hard.

    Args:
        setup: the closed setup.
        task: its task.
        kappa: (2,) principal curvatures of the object at the first contact, above -1/R, 1/m.
    """
    array, probe, limit_n = task.array, task.probe, setup.limits.force_max
    shown_n = first_shown_n(array)
    needed_n = shown_n / MIN_SHOWN_SHARE
    if shown_n > TOUCH_FORCE and task.force < needed_n:
        pitch_mm, full_kpa, share = 1e3 * array.pad.pitch_m, 1e-3 * array.pad.full_scale_pa, task.force / needed_n
        ways = [f"task.force_n = {at_least(1.01 * needed_n)}"] if needed_n < 0.9 * limit_n else []
        ways.append(
            f"sensor.pitch_mm = {at_most(0.99 * pitch_mm * math.sqrt(share))} or sensor.full_scale_kpa = "
            f"{at_most(0.99 * full_kpa * share)} of another array"
        )
        yield (
            f"sensor.pitch_mm = {pitch_mm:g}, sensor.full_scale_kpa = {full_kpa:g}: between its taxels the array shows "
            f"a contact from {shown_n:.2g} N on, and less than half of task.force_n = {task.force:g}; take "
            + " or ".join(ways)
        )
        return
    depth, speed = depth_at(shown_n, probe, array, kappa), task.approach.speed
    after_s = blind_s(setup.rate_hz, array, task.lag_s)
    reached_n = force_at(depth + speed * after_s, probe, array, kappa)
    known_n = highest_known_force(array, probe, limit_n, (0.0,))
    if reached_n <= known_n:
        return
    slower = 0.99 * (depth_at(known_n, probe, array, kappa) - depth) / after_s
    yield (
        f"task.approach_mm_s = {1e3 * speed:g}: the array shows a contact from {shown_n:.2g} N on, and the probe stops "
        f"up to {1e3 * after_s:.0f} ms later (sensor.rate_hz = {array.rate_hz:g}), when {reached_n:.2g} N press, "
        f"measured up to {reached_n * limit_n / known_n:.2g} N (2σ), more than limits.force_max_n = {limit_n:g}; lower "
        f"task.approach_mm_s to {at_most(1e3 * slower)}, or raise sensor.rate_hz"
    )
