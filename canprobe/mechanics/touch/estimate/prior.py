"""The prior: what is assumed of a surface before it is touched. It is always stated, and named in the estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import checked, positive
from canprobe.mechanics.types import Floats

NUISANCE_SIGMA = (0.15, 0.15, 0.5)
"""Standard deviations of c13, c23, c33 times the length of the path: 7.5, 7.5, 25 per m on a path of 20 mm.

On a short path these three are nearly unobservable (on a plane exactly so). They are of the order of a surface's
curvature; stated relative to the path they stay weak at every size, and the answer does not depend on the unit of
length.
"""


@dataclass(frozen=True, slots=True)
class Prior:
    """Independent normal priors on entries of the normalised surface matrix in its contact frame.

    Attributes:
        name: name of the prior, which the estimate carries.
        sigma_c13, sigma_c23, sigma_c33: standard deviations of these entries about 0, 1/m.
        curvature: mean κ of the shape operator, which is κ I, 1/m.
        sigma_curvature: standard deviation of K11 and K22 (of K12 its √½), 1/m; infinite, the default, for no prior on
            curvature. With one every combination has a finite answer; `observed` still says what the data alone
            observed.
    """

    name: str
    sigma_c13: float
    sigma_c23: float
    sigma_c33: float
    curvature: float = 0.0
    sigma_curvature: float = math.inf

    def __post_init__(self) -> None:
        checked("curvature", self.curvature, ())
        for field in ("sigma_c13", "sigma_c23", "sigma_c33", "sigma_curvature"):
            value = getattr(self, field)
            if not (isinstance(value, Real) and float(value) > 0.0):  # may be infinite
                raise UsageError(f"prior.{field}: expected a number above 0, got {value!r}")

    @classmethod
    def weak(cls, length: float) -> Prior:
        """The default: `NUISANCE_SIGMA / length` on c13, c23, c33, and nothing on curvature."""
        return cls("weak on c13, c23, c33", *(s / positive("length", length) for s in NUISANCE_SIGMA))

    @classmethod
    def flat(cls, length: float, sigma_curvature: float) -> Prior:
        """Weak on c13, c23, c33, and curvature 0 ± sigma_curvature (1/m) in every direction."""
        sigma = positive("sigma_curvature", sigma_curvature)
        name = f"curvature 0 ± {sigma:.4g} per unit length"
        return replace(cls.weak(length), name=name, sigma_curvature=sigma)

    def rows(self, length: float) -> tuple[Floats, Floats]:
        """Whitened rows (6, 9) and right-hand side (6,) on the parameters of `quadric`, in units of `length`."""
        A, inverse = np.zeros((6, 9)), 1.0 / (self.sigma_curvature * length)
        nuisance = [1.0 / (sigma * length) for sigma in (self.sigma_c13, self.sigma_c23, self.sigma_c33)]
        A[:, 3:] = np.diag([*nuisance, 2.0 * inverse, 2.0 * math.sqrt(2.0) * inverse, 2.0 * inverse])
        mean = self.curvature * length * inverse
        return A, np.array([0.0, 0.0, 0.0, mean, 0.0, mean])
