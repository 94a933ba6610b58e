"""The cases of study `bound`, and the region in which a local quadratic bound has a meaning."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from canprobe.lab.studies.ground import PATHS, SURFACES, Ground, make_ground
from canprobe.mechanics.types import Floats

SIZES_M, LONGEST_M, SAMPLES = (0.005, 0.04, 1.0), 0.02, 160
NOISES = ((5e-6, 2e-4), (20e-6, 1e-3), (100e-6, 5e-3))
LEAST_SIZE = 50.0
"""Least ‖K‖ that counts, 1/m: a smaller one counts as this."""
REGION: Mapping[str, float] = MappingProxyType(
    {"path": 1.0, "bound": 0.2, "κσ": 5e-3, "cubic": 1.0 / 3.0, "spread": 0.25}
)
"""Largest path over the radius, bound on an entry of K over its size, κσ_p (turn of the normal over the noise of a
point, rad), error of the quadric without noise (its prior, and cubic terms of the surface) over the bound, and noise of
a point over the spread of the points where that is narrowest: beyond, a path is not well excited.
"""


@dataclass(frozen=True, slots=True)
class BoundCase:
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


def all_cases() -> Iterator[BoundCase]:
    """Weaves and circles over every surface and size with every noise, and weaves of 1.5 radii."""
    for surface in SURFACES:
        for size in SIZES_M[:2] if surface == "plane" else SIZES_M:
            for path, noise in product(PATHS, NOISES):
                yield BoundCase(surface, path, size, min(size, LONGEST_M), *noise)
        if surface != "plane":
            for noise in NOISES[1:]:
                yield BoundCase(surface, "weave", SIZES_M[0], 1.5 * SIZES_M[0], *noise)


def quick_cases() -> Iterator[BoundCase]:
    """Every surface once, and sizes, paths and noises in turn."""
    for i, surface in enumerate(SURFACES):
        size = SIZES_M[i % 2]
        yield BoundCase(surface, PATHS[i % 2], size, min(size, LONGEST_M), *NOISES[i % 3])


def criteria(case: BoundCase, ground: Ground, C: Floats, model_bias: float) -> dict[str, float]:
    """The figures of a case that `REGION` limits."""
    size = float(np.linalg.norm(ground.K))
    return {
        "path": 0.0 if case.surface == "plane" else case.length / case.size,
        "bound": math.sqrt(float(np.diag(C).max())) / max(size, LEAST_SIZE),
        "κσ": float(np.abs(np.linalg.eigvalsh(ground.K)).max()) * case.sigma_point,
        "cubic": model_bias,
        "spread": case.sigma_point / math.sqrt(float(np.linalg.eigvalsh(np.cov(ground.points[:, :2].T))[0])),
    }
