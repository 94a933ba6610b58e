"""What a window that cuts the contact patch does to the force.

Where enough of the patch is inside, the cell carries it on beyond the window (`canprobe.touch.patch_beyond`), and the
force errs by a little. Else what lies outside presses unmeasured: the servo holds the measured force, so that the true
one is as much larger as the window misses. The patch is that of `contact_window`, the elastic foundation on a plane:
its pressure falls from the middle to the rim as 1 - r²/a². The window follows the contact and may be off its middle by
`FOLLOWING_TAXELS`; the array's blur, which carries some of the rim back inside, is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from canprobe.planning.contact_window import FOLLOWING_TAXELS, PITCH_M, patch_radius_m
from canprobe.protocol.tactile import WINDOWS
from canprobe.scene_setup import Probe, Setup

TOLERATED = 0.05
"""Share of the force that a window may miss without a warning; the array itself errs by as much."""
CARRIED_SIDE, CARRIED_SHARE = 6, 0.5
"""Smallest window, and share of the force inside, from which the rest of a patch follows."""
CARRIED_ERROR = 0.1
"""Share of the force by which it then errs at the most, on the emulated array with its spread, blur and noise."""
_STEPS = 200
_HALVINGS = 40


def measured_share(force_n: float, probe: Probe, side: int, off_taxels: float = FOLLOWING_TAXELS) -> float:
    """Share of a force that a window feels.

    Args:
        force_n: on a plane.
        probe: the layer on it.
        side: taxels along the window.
        off_taxels: by how much the window's middle is off the contact's, along one of its sides.
    """
    radius = patch_radius_m(force_n, probe) / PITCH_M
    first, last = max(-radius, off_taxels - side / 2), min(radius, off_taxels + side / 2)
    width = max(last - first, 0.0) / _STEPS
    columns = (_column(first + (step + 0.5) * width, radius, side / 2) for step in range(_STEPS))
    return min(width * sum(columns) / (math.pi / 2 * radius**2), 1.0)


def _column(x: float, radius: float, half: float) -> float:
    """Integral of 1 - (x² + y²)/a² over y within the patch and the window."""
    height = min(half, math.sqrt(max(radius**2 - x**2, 0.0)))
    return 2.0 * height * (1.0 - (x / radius) ** 2) - 2.0 / 3.0 * height**3 / radius**2


def true_force_n(force_n: float, probe: Probe, side: int, most_n: float) -> float | None:
    """The force that presses where a window measures `force_n`, at the most; None where it is above `most_n`."""
    if most_n * measured_share(most_n, probe, side) < force_n:
        return None
    low, high = force_n, most_n
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if middle * measured_share(middle, probe, side) < force_n else (low, middle)
    return high


@dataclass(frozen=True, slots=True)
class CutPatch:
    """What a window does that feels too little of the force.

    Attributes:
        text: for people, with the numbers.
        true_n: what presses at the most where the target is measured; None: more than `limits.force_max_n`, which only
            the measured force is held against.
        ways: to feel it.
    """

    text: str
    true_n: float | None
    ways: tuple[str, ...]


def cut_patch(setup: Setup) -> CutPatch | None:
    """What the window of a scene misses; None where it feels nearly all of the force, or nothing is pressed."""
    touch = setup.touch
    if touch is None or touch.array.mode != "window":
        return None
    force, probe, side, most = touch.force, touch.probe, int(touch.array.window), setup.limits.force_max
    share = measured_share(force, probe, side)
    if share >= 1.0 - TOLERATED:
        return None
    across = 2.0 * patch_radius_m(force, probe) / PITCH_M
    cuts = (
        f"sensor.window = {side} cuts the contact patch, which is {across:.1f} taxels across on a plane at "
        f"{force:g} N; as little as {100 * share:.0f} % of that force lies inside"
    )
    if side >= CARRIED_SIDE and share >= CARRIED_SHARE:
        carried = f"the rest is carried on from there, and the force errs by up to {100 * CARRIED_ERROR:.0f} %"
        return CutPatch(f"{cuts}; {carried}", force * (1.0 + CARRIED_ERROR), _ways(force, probe))
    true_n = true_force_n(force, probe, side, most)
    presses = f"more than limits.force_max_n = {most:g} N" if true_n is None else f"up to {true_n:.2g} N"
    unfelt = f"and where the window measures {force:g} N, {presses} can press"
    return CutPatch(f"{cuts}, {unfelt}", true_n, _ways(force, probe))


def _ways(force: float, probe: Probe) -> tuple[str, ...]:
    enough = [side for side in WINDOWS if measured_share(force, probe, side) >= 1.0 - TOLERATED]
    larger = f"sensor.window = {enough[0]}" if enough else 'sensor.mode = "image"'
    return larger, "a smaller task.force_n"
