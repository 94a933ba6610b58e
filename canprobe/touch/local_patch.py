"""One local patch of a surface: its contact frame, its matrix, and how well every entry of it is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from canprobe.touch._arrays import Array, checked, read_only
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.quadric import UNIT, parameters_of
from canprobe.touch.surface import SurfaceMatrix

WIDE = 10.0
"""Standard deviation of a combination of curvature that was not observed, over the path that the estimate rests on:
±500 1/m for 20 mm, a radius of 2 mm. It only ever widens what is said of heights and normals beside the contact."""
LEAST_LENGTH_M = 1e-3
"""A shorter path counts as this long."""

_SHAPES: dict[str, tuple[int | None, ...]] = {
    "T_base_contact": (4, 4),
    "S": (4, 4),
    "S_covariance": (9, 9),
    "observed": (2,),
    "combinations": (None, 3),
}
_Q_TO_C = UNIT[:, None]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LocalPatch:
    """A quadric that describes the surface round one contact.

    Attributes:
        T_base_contact: (4, 4) contact frame to base, m; z is the inward normal.
        S: (4, 4) in the contact frame, c14 = c24 = c44 = 0, c34 = −½; unobserved combinations nearest to flat.
        K_covariance: (3, 3) of (K11, K12, K22), 1/m²; NaN or infinite where not observed, as in `SurfaceEstimate`.
        S_covariance: (9, 9) of (c14, c24, c44, c13, c23, c33, c11, c12, c22), SI units, always finite: a combination
            that the data did not observe stands in it with `WIDE`, whatever a prior said of it. c44 is the height,
            2 c14 and 2 c24 are the tilt.
        pose_known: the part of `S_covariance` about height and tilt is the estimator's; False from methods that do
            not know it, which leave zeros there.
        observed: (2,) 1 or 0, for each principal curvature.
        combinations: (rank, 3) rows: what was observed, as weights of (K11, √2 K12, K22).
        t_s: instant of the last sample, s.
        travelled_m: path of the contact until then, m.
        distance_m: path that the patch rests on, m; patches nearer than some of it along the path share their data.
        innovation: mean squared whitened residual per degree of freedom; well below 1 where the σ's are generous.
    """

    T_base_contact: Array
    S: Array
    K_covariance: Array
    S_covariance: Array
    pose_known: bool
    observed: Array
    combinations: Array
    t_s: float
    travelled_m: float
    distance_m: float
    innovation: float

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            object.__setattr__(self, name, read_only(checked(name, getattr(self, name), shape)))
        object.__setattr__(self, "K_covariance", read_only(self.K_covariance))
        for name in ("t_s", "travelled_m", "distance_m", "innovation"):
            checked(name, getattr(self, name), ())

    @classmethod
    def of(cls, estimate: SurfaceEstimate, *, t_s: float, travelled_m: float) -> LocalPatch:
        """The patch of one estimate.

        Args:
            estimate: in the base frame, lengths in m.
            t_s: instant of its last sample, s.
            travelled_m: path of the contact until then, m.
        """
        return cls(
            T_base_contact=estimate.T_frame_contact,
            S=estimate.S,
            K_covariance=estimate.covariance,
            S_covariance=_covariance(estimate),
            pose_known=estimate.model_root is not None,
            observed=estimate.observed.astype(np.float64),
            combinations=estimate.combinations,
            t_s=t_s,
            travelled_m=travelled_m,
            distance_m=estimate.distance,
            innovation=estimate.innovation,
        )

    @property
    def rank(self) -> int:
        """How many combinations of curvature were observed, 0–3."""
        return len(self.combinations)

    @property
    def point(self) -> Array:
        """(3,) contact point, base frame, m."""
        return self.T_base_contact[:3, 3]

    @property
    def normal(self) -> Array:
        """(3,) outward unit normal there, base frame."""
        return -self.T_base_contact[:3, 2]

    @property
    def surface(self) -> SurfaceMatrix:
        """`S` with its operations, in the contact frame."""
        return SurfaceMatrix(self.S)

    @property
    def c(self) -> Array:
        """(9,) entries of `S` in the order of `S_covariance`, SI units."""
        return parameters_of(self.S)

    def equals(self, other: LocalPatch) -> bool:
        """Every field is the same, bit by bit (NaN equals NaN)."""
        return all(
            np.array_equal(np.asarray(getattr(self, f.name), float), np.asarray(getattr(other, f.name), float), True)
            for f in fields(self)
        )


def _covariance(estimate: SurfaceEstimate) -> Array:
    """(9, 9) finite covariance of the entries of S, SI units."""
    length = max(estimate.distance, LEAST_LENGTH_M)
    weak = WIDE / length
    V = estimate.combinations.T
    if estimate.model_root is None:
        P = np.zeros((9, 9))
        P[6:, 6:] = _Q_TO_C * _curvature_covariance(estimate, V, weak) * _Q_TO_C.T
        return P
    units = np.array([1.0, 1.0, 1.0 / length] + 6 * [length])
    root = estimate.model_root / units  # dimensionless, or the inverse would lose its digits
    if estimate.rank < 3:
        # noise among the regressors feigns knowledge of what was not observed: taken out, and held wide instead
        open_ = np.eye(3) - V @ V.T
        root = np.concatenate([root, np.zeros((3, 9))])
        root[:-3, 6:] = root[:-3, 6:] @ (_Q_TO_C * (V @ V.T) / _Q_TO_C.T)
        root[-3:, 6:] = open_ / UNIT / WIDE
    if len(root) > 9:
        root = np.linalg.qr(root, mode="r")
    inverse = np.linalg.inv(root)
    result: Array = inverse @ inverse.T / np.outer(units, units)
    return 0.5 * (result + result.T)


def _curvature_covariance(estimate: SurfaceEstimate, V: Array, weak: float) -> Array:
    """(3, 3) covariance of q = (K11, √2 K12, K22), what was not observed held wide, 1/m²."""
    if estimate.rank == 3:
        to_q = np.array([1.0, math.sqrt(2.0), 1.0])
        return estimate.covariance * np.outer(to_q, to_q)
    seen = V @ np.linalg.inv(V.T @ estimate.information @ V) @ V.T
    result: Array = seen + weak**2 * (np.eye(3) - V @ V.T)
    return result
