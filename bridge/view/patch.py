"""The estimated patch as a disc on its quadric, and how uncertain its height is: shells at ±2 standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from canprobe.bridge.sample import SurfacePatch
from canprobe.bridge.view.meshes import Array, Faces

RADIUS_M, RINGS, SECTORS = 0.012, 6, 36
EXAGGERATION = 20.0
"""The shells stand this many times too far apart: 0.5 1/m is 36 µm at the disc's rim."""
LIFT_M = 3e-4
"""Off the true surface, outward, so that the two do not flicker through each other."""
MOST_M = 0.006
"""Farthest that a shell is drawn from the patch: where curvature was not observed it would be nowhere."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchShape:
    """One estimate to draw, in the contact frame.

    Attributes:
        surface: (n, 3) points of the disc, m, lifted by `LIFT_M`.
        above, below: (n, 3) the shells outside and inside the object, exaggerated and cut off, m, lifted too.
        sigma: (n,) standard deviation of the height, m, as stated; infinite where not observed.
    """

    surface: Array
    above: Array
    below: Array
    sigma: Array


def disc_points(radius: float = RADIUS_M) -> Array:
    """(n, 2) points of the disc in the tangent plane, ring by ring from the middle, m."""
    radii = np.linspace(0.0, radius, RINGS + 1)[1:, None]
    angles = np.linspace(0.0, 2.0 * math.pi, SECTORS, endpoint=False)[None]
    rings = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1).reshape(-1, 2)
    points: Array = np.vstack([np.zeros((1, 2)), rings])
    return points


def disc_faces() -> Faces:
    """(m, 3) triangles between the points of the disc; front side towards −z, out of the object."""
    index = 1 + np.arange(RINGS * SECTORS).reshape(RINGS, SECTORS)
    turned = np.roll(index, -1, axis=1)
    middle = np.stack([np.zeros(SECTORS, np.int64), turned[0], index[0]], axis=1)
    a, b, c, d = (x.ravel() for x in (index[:-1], turned[:-1], turned[1:], index[1:]))
    return np.concatenate([middle, np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def patch_shape(patch: SurfacePatch, xy: Array) -> PatchShape:
    """What is drawn of an estimate.

    Args:
        patch: of the estimator.
        xy: (n, 2) from :func:`disc_points`.
    """
    x, y = xy.T
    height, sigma = patch.heights(x, y)
    shift = np.minimum(2.0 * EXAGGERATION * sigma, MOST_M)
    drawn = height - LIFT_M
    surface, above, below = (np.column_stack([x, y, z]) for z in (drawn, drawn - shift, drawn + shift))
    return PatchShape(surface, above, below, sigma)
