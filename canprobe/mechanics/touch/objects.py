"""True objects: all touchable surfaces by name (`make_object`), and those that are quadrics; frames as in `shapes`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import atan2, cos, hypot, inf, pi, sin, sqrt

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.touch.heights import Heights
from canprobe.mechanics.touch.mesh_fit import MeshHeights
from canprobe.mechanics.touch.shapes import (
    Bowl,
    Cylinder,
    Fillet,
    Foot,
    PlacedShape,
    RoundShape,
    Torus,
    Wave,
    require_positive,
    tangent_of,
)
from canprobe.mechanics.types import Vec


class Plane(PlacedShape):
    """The plane z = 0 of the object's frame, solid below."""

    def _foot(self, x: float, y: float, z: float) -> Foot:
        return x, y, 0.0, 0.0, 0.0, 1.0, z, 0.0, 0.0, 1.0, 0.0, 0.0


class Sphere(RoundShape):
    """Ball of a given radius, centre at z = -radius."""

    def _foot(self, x: float, y: float, z: float) -> Foot:
        radius = self.radius
        zc = z + radius
        rho = sqrt(x * x + y * y + zc * zc)
        nx, ny, nz = (x / rho, y / rho, zc / rho) if rho > 0.0 else (0.0, 0.0, 1.0)
        k = 1.0 / radius
        return (radius * nx, radius * ny, radius * (nz - 1.0), nx, ny, nz, rho - radius, k, k, *tangent_of(nx, ny, nz))


class Quadric(PlacedShape):
    """Any surface X'SX = 0 through the object's origin with outward normal z there.

    The closest point solves ``(I + t S3) x = p - t s`` with the multiplier t that puts x on the surface. On the
    interval where ``I + t S3`` is positive definite f falls monotonically with t, and its root there is the global
    minimum, also for hyperboloids and from inside the body.

    Args:
        T_base_object: (4, 4) pose, m.
        matrix: (4, 4) symmetric S in the object's frame, lengths in m, f < 0 inside; any positive multiple will do.

    Raises:
        ValueError: the matrix is not symmetric, the surface does not pass through the origin, or its gradient there is
            not along +z.

    Source: More, "Generalizations of the trust region problem", Optim. Methods Softw. 2, 1993 (global optimality).
    """

    def __init__(self, T_base_object: npt.ArrayLike, matrix: npt.ArrayLike) -> None:
        super().__init__(T_base_object)
        S = np.array(matrix, dtype=float)
        if S.shape != (4, 4) or not np.all(np.isfinite(S)) or not np.allclose(S, S.T, rtol=1e-12, atol=0.0):
            raise ValueError(f"matrix must be a finite symmetric 4x4 array, got {S!r}")
        if S[2, 3] <= 0.0 or np.abs(S[[0, 1], 3]).max() > 1e-12 * S[2, 3] or abs(S[3, 3]) > 1e-12 * S[2, 3]:
            raise ValueError(f"matrix must pass through the origin with its gradient along +z there, got {S!r}")
        w, V = np.linalg.eigh(S[:3, :3] * (0.5 / S[2, 3]))
        self._w: list[float] = w.tolist()
        self._b: list[float] = (0.5 * V[2]).tolist()
        self._v = tuple(V.ravel().tolist())
        low, high = float(w[0]), float(w[2])
        self._span = (-1.0 / high if high > 0.0 else -inf, -1.0 / low if low < 0.0 else inf)

    def _foot(self, x: float, y: float, z: float) -> Foot:
        v0, v1, v2, v3, v4, v5, v6, v7, v8 = self._v
        (w0, w1, w2), (b0, b1, b2) = self._w, self._b
        p = (v0 * x + v3 * y + v6 * z, v1 * x + v4 * y + v7 * z, v2 * x + v5 * y + v8 * z)
        e0, e1, e2 = self._eigen_foot(p)
        gx, gy, gz = w0 * e0 + b0, w1 * e1 + b1, w2 * e2 + b2  # half the gradient, eigenbasis
        size = sqrt(gx * gx + gy * gy + gz * gz)
        n0, n1, n2 = gx / size, gy / size, gz / size
        distance = n0 * (p[0] - e0) + n1 * (p[1] - e1) + n2 * (p[2] - e2)
        k1, k2, (d0, d1, d2) = self._curvatures((n0, n1, n2), size)
        return (
            *(v0 * e0 + v1 * e1 + v2 * e2, v3 * e0 + v4 * e1 + v5 * e2, v6 * e0 + v7 * e1 + v8 * e2),
            *(v0 * n0 + v1 * n1 + v2 * n2, v3 * n0 + v4 * n1 + v5 * n2, v6 * n0 + v7 * n1 + v8 * n2),
            *(distance, k1, k2),
            *(v0 * d0 + v1 * d1 + v2 * d2, v3 * d0 + v4 * d1 + v5 * d2, v6 * d0 + v7 * d1 + v8 * d2),
        )

    def _curvatures(self, n: Vec, half_gradient: float) -> tuple[float, float, Vec]:
        """Principal curvatures of K = P' S3 P / |half gradient| and the first direction, eigenbasis."""
        w0, w1, w2 = self._w
        t0, t1, t2 = tangent_of(*n)
        s0, s1, s2 = n[1] * t2 - n[2] * t1, n[2] * t0 - n[0] * t2, n[0] * t1 - n[1] * t0
        k_tt = (w0 * t0 * t0 + w1 * t1 * t1 + w2 * t2 * t2) / half_gradient
        k_ss = (w0 * s0 * s0 + w1 * s1 * s1 + w2 * s2 * s2) / half_gradient
        k_ts = (w0 * t0 * s0 + w1 * t1 * s1 + w2 * t2 * s2) / half_gradient
        mean, spread = 0.5 * (k_tt + k_ss), hypot(0.5 * (k_tt - k_ss), k_ts)
        angle = 0.5 * atan2(2.0 * k_ts, k_tt - k_ss)
        c, s = cos(angle), sin(angle)
        return mean + spread, mean - spread, (c * t0 + s * s0, c * t1 + s * s1, c * t2 + s * s2)

    def _eigen_foot(self, p: Vec) -> Vec:
        """Closest surface point in the eigenbasis."""
        (w0, w1, w2), (b0, b1, b2) = self._w, self._b
        p0, p1, p2 = p
        u0, u1, u2 = b0 + w0 * p0, b1 + w1 * p1, b2 + w2 * p2
        low, high = self._span
        t = 0.0
        f, (x0, x1, x2) = 0.0, p
        for _ in range(200):
            q0, q1, q2 = 1.0 + t * w0, 1.0 + t * w1, 1.0 + t * w2
            x0, x1, x2 = (p0 - t * b0) / q0, (p1 - t * b1) / q1, (p2 - t * b2) / q2
            f = x0 * (w0 * x0 + 2 * b0) + x1 * (w1 * x1 + 2 * b1) + x2 * (w2 * x2 + 2 * b2)
            if f > 0.0:
                low = t
            else:
                high = t
            slope = -2.0 * (u0 * u0 / (q0 * q0 * q0) + u1 * u1 / (q1 * q1 * q1) + u2 * u2 / (q2 * q2 * q2))
            new = t - f / slope if slope < 0.0 else inf
            if abs(new - t) <= 1e-15 + 1e-15 * abs(t):
                if abs(f) < 1e-14:
                    return x0, x1, x2
                break  # t cannot be resolved: at, or next to, a point of symmetry
            if not low < new < high:
                new = 0.5 * (low + high) if high - low < inf else 2.0 * t + (1.0 if f > 0.0 else -1.0)
                if not low < new < high:  # the bracket has shrunk onto the end of the interval
                    break
            t = new
        return self._medial_foot((x0, x1, x2), 2 if f < 0.0 else 0)

    def _medial_foot(self, x: Vec, free: int) -> Vec:
        """The foot on the side of x, where two are equally near, as seen from a point of symmetry."""
        # the multiplier stands at the end of its interval, where the coordinate ``free`` follows from f = 0 alone
        w, b = self._w[free], self._b[free]
        rest = sum(x[i] * (self._w[i] * x[i] + 2 * self._b[i]) for i in range(3) if i != free)
        foot = list(x)
        side = -1.0 if x[free] * w + b < 0.0 else 1.0
        foot[free] = (-b + side * sqrt(max(0.0, b * b - w * rest))) / w
        return foot[0], foot[1], foot[2]

    def _tightest_anywhere(self) -> float:
        radii = np.linspace(0.0, 0.05, 11)
        angles = np.arange(24) * (2 * pi / 24)
        local = np.array([(r * cos(a), r * sin(a), 0.0) for r in radii for a in angles])
        return self.tightest_concave_radius(local @ self._pose[:3, :3].T + self._pose[:3, 3])


def _level_matrix(xx: float, yy: float, zz: float) -> npt.NDArray[np.float64]:
    """S of ``xx x^2 + yy y^2 + zz z^2 + z``."""
    S = np.diag((xx, yy, zz, 0.0))
    S[2, 3] = S[3, 2] = 0.5
    return S


class Saddle(Quadric):
    """z = -x^2 / (2 radius_x) - y^2 / (2 radius_y), radii of opposite sign (positive: convex).

    Args:
        T_base_object: (4, 4) pose, m.
        radius_x: radius of the section along x at the origin, m.
        radius_y: radius of the section along y there, m. The negative radius is the tightest hollow of the surface.

    Raises:
        ValueError: the radii are not one positive and one negative.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius_x: float, radius_y: float) -> None:
        if not radius_x * radius_y < 0.0 or not abs(radius_x) + abs(radius_y) < inf:
            raise ValueError(
                f"a saddle needs radius_x and radius_y of opposite sign (positive: convex), in m; "
                f"got {radius_x!r} and {radius_y!r}"
            )
        super().__init__(T_base_object, _level_matrix(0.5 / radius_x, 0.5 / radius_y, 0.0))
        self.radius_x, self.radius_y = radius_x, radius_y

    def _tightest_anywhere(self) -> float:
        return -min(self.radius_x, self.radius_y)


class Ellipsoid(Quadric):
    """Ellipsoid with its axes along the object's, centre at z = -radius_z.

    Args:
        T_base_object: (4, 4) pose, m.
        radius_x: semi-axis along x, m.
        radius_y: semi-axis along y, m.
        radius_z: semi-axis along z, m.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius_x: float, radius_y: float, radius_z: float) -> None:
        require_positive(radius_x=radius_x, radius_y=radius_y, radius_z=radius_z)
        half = 0.5 * radius_z
        super().__init__(T_base_object, _level_matrix(half / radius_x**2, half / radius_y**2, half / radius_z**2))

    def _tightest_anywhere(self) -> float:
        return inf


_KINDS: Mapping[str, tuple[Callable[..., PlacedShape], tuple[str, ...]]] = {
    "plane": (Plane, ()),
    "sphere": (Sphere, ("radius",)),
    "cylinder": (Cylinder, ("radius",)),
    "saddle": (Saddle, ("radius_x", "radius_y")),
    "bowl": (Bowl, ("radius",)),
    "ellipsoid": (Ellipsoid, ("radius_x", "radius_y", "radius_z")),
    "torus": (Torus, ("ring_radius", "radius")),
    "wave": (Wave, ("amplitude", "wavelength")),
    "fillet": (Fillet, ("radius", "angle")),
    "quadric": (Quadric, ("matrix",)),
    "heights": (Heights, ("heights", "spacing", "origin")),
    "mesh": (MeshHeights.of, ("vertices", "faces", "spacing", "origin")),
}

OBJECT_PARAMETERS: Mapping[str, tuple[str, ...]] = {k: names for k, (_, names) in _KINDS.items()}
"""Kind of object -> names of its parameters (lengths in m, angles in rad), for loaders and messages."""


def make_object(kind: str, *, T_base_object: npt.ArrayLike, **params: object) -> PlacedShape:
    """Build an object by name.

    Args:
        kind: a key of ``OBJECT_PARAMETERS``.
        T_base_object: (4, 4) pose of the object's frame (origin on the surface, z outward), m.
        **params: exactly the parameters of this kind, m and rad.

    Returns:
        The placed shape.

    Raises:
        ValueError: the kind is unknown, or parameters or values are wrong; the message says what was expected.
    """
    if kind not in _KINDS:
        raise ValueError(f"unknown object kind {kind!r}; one of {', '.join(_KINDS)}")
    shape, names = _KINDS[kind]
    if set(params) != set(names):
        raise ValueError(
            f"object {kind!r} takes {', '.join(names) or 'no parameters'}; got {', '.join(params) or 'none'}"
        )
    return shape(T_base_object, **params)
