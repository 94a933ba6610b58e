"""A ring with a round section."""

from __future__ import annotations

from math import hypot, sqrt

import numpy.typing as npt

from canprobe.touch.placed import Array, Foot, PlacedShape, osculating_matrix, require_positive


class Torus(PlacedShape):
    """Ring lying flat: axis along z through x = -ring_radius, the origin on its crown, x outward from the axis.

    Round the tube the curvature is 1/radius everywhere; along the ring it is positive outside, 0 on the crown and
    negative inside, where the hollow is ring_radius - radius wide.

    Args:
        T_base_object: (4, 4) pose, m.
        ring_radius: of the tube's centre line, m.
        radius: of the tube, m; smaller than the ring's.
    """

    def __init__(self, T_base_object: npt.ArrayLike, ring_radius: float, radius: float) -> None:
        super().__init__(T_base_object)
        require_positive(ring_radius=ring_radius, radius=radius)
        if radius >= ring_radius:
            raise ValueError(f"a torus needs ring_radius > radius, in m; got {ring_radius!r} and {radius!r}")
        self.ring_radius, self.radius = ring_radius, radius

    def _foot(self, x: float, y: float, z: float) -> Foot:
        ring, radius = self.ring_radius, self.radius
        out, zc = hypot(x + ring, y), z + radius
        ux, uy = ((x + ring) / out, y / out) if out > 0.0 else (1.0, 0.0)
        side = out - ring
        rho = sqrt(side * side + zc * zc)
        nr, nz = (side / rho, zc / rho) if rho > 0.0 else (0.0, 1.0)
        nx, ny = nr * ux, nr * uy
        return (
            *(ring * ux + radius * nx - ring, ring * uy + radius * ny, radius * (nz - 1.0)),
            *(nx, ny, nz, rho - radius, 1.0 / radius, nr / (ring + radius * nr), -nz * ux, -nz * uy, nr),
        )

    def _matrix(self) -> Array:
        return osculating_matrix((0.5 / self.radius, 0.0, 0.0))

    def _tightest_anywhere(self) -> float:
        return self.ring_radius - self.radius
