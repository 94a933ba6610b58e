"""Which window the plan chooses: the smallest that always holds the contact patch at the target force, if it fits.

The patch is that on a plane, the widest that a surface makes which is nowhere hollow. The layer on the probe is a bed
of springs: a sphere of radius R with stiffness k a volume, pressed in by d, has the force F = π k R d² and a patch of
radius a = √(2 R d). The window follows the centroid in steps of a taxel and lets it be off its middle by so much
before it moves, which has to be room on both sides.
Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.
"""

from __future__ import annotations

import math

from canprobe.protocol.tactile import WINDOWS
from canprobe.scene_setup import Probe, Setup

PITCH_M = 1.5875e-3
FOLLOWING_TAXELS = 0.75
"""By how much the contact's centroid may be off the middle of the window before the window moves."""


def patch_radius_m(force_n: float, probe: Probe) -> float:
    """Radius of the contact patch on a plane, m."""
    depth = math.sqrt(force_n / (math.pi * probe.stiffness * probe.radius))
    return math.sqrt(2.0 * probe.radius * depth)


def patch_across_taxels(force_n: float, probe: Probe) -> float:
    """Diameter of the contact patch on a plane, in taxels."""
    return 2.0 * patch_radius_m(force_n, probe) / PITCH_M


def taxels_needed(force_n: float, probe: Probe) -> float:
    """Taxels along a window that always holds the patch."""
    return patch_across_taxels(force_n, probe) + 2.0 * FOLLOWING_TAXELS


def window_choices(setup: Setup) -> tuple[tuple[int, str], ...]:
    """Windows by preference, with the reason; without a force to hold the largest first."""
    touch = setup.touch
    if touch is None:
        return tuple((side, "the largest that fits; nothing is pressed") for side in reversed(WINDOWS))
    needed = taxels_needed(touch.force, touch.probe)
    patch = (
        f"at {touch.force:g} N the patch on a plane has {2e3 * patch_radius_m(touch.force, touch.probe):.1f} mm across"
        f" and asks for {needed:.1f} taxels with {FOLLOWING_TAXELS:g} on each side for following it"
    )
    enough = [side for side in WINDOWS if side >= needed]
    less = [side for side in reversed(WINDOWS) if side < needed]
    return (
        *((side, f"{patch}: the smallest that holds it") for side in enough[:1]),
        *((side, f"{patch}: the largest that fits, cutting its rim") for side in less),
        *((side, f"{patch}: no smaller one can be had") for side in enough[1:]),
    )
