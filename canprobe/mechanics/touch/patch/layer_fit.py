"""Fits the stiffness of the layer, and the arm's compliance, to the arm's way into the object."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from canprobe.mechanics.touch.contact import indentation_from_force
from canprobe.mechanics.touch.patch.image_fit import Dwell, Shown


def stiffness_by_depth(
    dwells: Sequence[Dwell],
    shown: Sequence[Shown],
    forces: Sequence[float],
    radius: float,
    by_images: tuple[float, float],
) -> tuple[float, float, float, float]:
    """Stiffness by the arm's way between touches of one place with different forces, and the arm's compliance.

    On a stiff arm the way between two forces at one place is that of the layer, `δ = √(2 F √det A / (π k))`. The part
    of the way beyond the stiffness that the images show grows with the force: it is the arm's compliance. Its σ is that
    of the scatter of the ways and of the images' stiffness.

    Args:
        dwells, shown: the touches.
        forces: their forces, N.
        radius: radius of the probe, m.
        by_images: stiffness K/h from the images and its σ, N/m³.

    Returns:
        K/h and its σ (N/m³), compliance and its σ (m/N); NaN where no place was touched with two forces.
    """
    stiffness, stiffness_sigma = by_images
    rows = []
    for name, place, turn in sorted({(d.name, d.place, d.turn) for d in dwells}):
        group = [i for i, d in enumerate(dwells) if (d.name, d.place, d.turn) == (name, place, turn)]
        if len(group) < 2:
            continue
        unit = np.array([indentation_from_force(forces[i], 1.0, radius, dwells[i].kappa) for i in group])
        push, force = np.array([shown[i].push for i in group]), np.array([forces[i] for i in group])
        rows += list(zip(unit - unit.mean(), force - force.mean(), push - push.mean(), strict=True))
    if not rows:
        return (math.nan,) * 4
    unit, force, push = np.array(rows).T
    root = float(unit @ push / (unit @ unit))
    sigma = math.sqrt(float(np.mean((push - root * unit) ** 2)) / float(unit @ unit))
    more = push - unit / math.sqrt(stiffness)
    compliance = float(force @ more / (force @ force))
    scatter = math.sqrt(float(np.mean((more - compliance * force) ** 2)) / float(force @ force))
    of_stiffness = 0.5 * stiffness_sigma * stiffness**-1.5 * abs(float(force @ unit)) / float(force @ force)
    compliance_sigma = math.hypot(scatter, of_stiffness)
    if root <= 0.0:
        return math.nan, math.nan, compliance, compliance_sigma
    return root**-2, 2.0 * sigma / root**3, compliance, compliance_sigma
