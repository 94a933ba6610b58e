"""The cases of study `bound`, and the region in which a local quadratic bound means something.

The thresholds of the region were fixed before any run of this table, from what a local quadric can mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from canprobe.studies.ground import PATHS, SURFACES, Array, Ground, make_ground

SIZES_M, LONGEST_M, SAMPLES = (0.005, 0.04, 1.0), 0.02, 160
NOISES = ((5e-6, 2e-4), (20e-6, 1e-3), (100e-6, 5e-3))
LARGEST_BOUND, LEAST_SIZE = 0.2, 50.0
"""Inside, the bound on each entry of K is at most so much of ‖K‖, or of a least size, 1/m."""
LARGEST_TILT = 5e-3
"""Largest κσ_p: the turn of the normal over the noise of a point, rad."""
LARGEST_BIAS = 1.0 / 3.0
"""Largest error of the quadric without noise (its prior, and cubic terms of the surface) over the bound."""


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the study, m and rad."""

    surface: str
    path: str
    size: float
    length: float
    sigma_point: float
    sigma_normal: float

    @property
    def ground(self) -> Ground:
        """The path over the exact surface."""
        return make_ground(self.surface, self.size, self.path, self.length, SAMPLES)


def all_cases() -> Iterator[Case]:
    """Weaves and circles over every surface and size with every noise, and weaves of 1.5 radii."""
    for surface in SURFACES:
        for size in SIZES_M[:2] if surface == "plane" else SIZES_M:
            for path, noise in product(PATHS, NOISES):
                yield Case(surface, path, size, min(size, LONGEST_M), *noise)
        if surface != "plane":
            for noise in NOISES[1:]:
                yield Case(surface, "weave", SIZES_M[0], 1.5 * SIZES_M[0], *noise)


def quick_cases() -> Iterator[Case]:
    """Every surface once, and sizes, paths and noises in turn."""
    for i, surface in enumerate(SURFACES):
        size = SIZES_M[i % 2]
        yield Case(surface, PATHS[i % 2], size, min(size, LONGEST_M), *NOISES[i % 3])


def reasons_outside(case: Case, ground: Ground, C: Array, model_bias: float) -> list[str]:
    """Why a local quadratic bound means little in a case; empty inside the region."""
    size = float(np.linalg.norm(ground.K))
    tightest = float(np.abs(np.linalg.eigvalsh(ground.K)).max())
    entry = math.sqrt(float(np.diag(C).max()))
    tests = {
        "path": case.surface != "plane" and case.length > case.size * (1.0 + 1e-9),
        "bound": not entry <= LARGEST_BOUND * max(size, LEAST_SIZE),
        "κσ": tightest * case.sigma_point > LARGEST_TILT * (1.0 + 1e-9),
        "cubic": not model_bias <= LARGEST_BIAS,
    }
    return [name for name, outside in tests.items() if outside]
