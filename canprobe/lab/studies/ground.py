"""Exact ground for the estimators: surfaces of any size, paths over them, noise on the contacts.

Every path ends at the origin of a contact frame (z = inward normal), where the answer is scored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.types import Floats

SURFACES = ("plane", "cylinder", "sphere", "ellipsoid", "saddle", "hyperboloid", "torus")
PATHS = ("weave", "circle")
_AXES = {"ellipsoid": (1.6, 1.2, 0.93), "hyperboloid": (1.6, 1.2, 0.93)}
"""Half-axes over the size."""
_START = {"ellipsoid": (1.04, 0.53, 0.59), "hyperboloid": (1.44, 0.72, 0.37)}
_TORUS_RING, _TORUS_ANGLE = 2.5, 0.5
"""Radius of a torus's ring over that of its tube, and where on the tube it is touched (rad from the equator)."""
WAVES, _AMPLITUDE = 1.6, 5.0 / 12.0
"""Waves of a weave, and its amplitude over the length of a wave."""
_OFF_AXIS = 0.4
"""Turn of the principal directions against the path, rad, so that no entry of K is special."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A path over an exact surface.

    Attributes:
        points, normals: points (n, 3), m, and outward unit normals (n, 3) in the contact frame of the last point.
        surface: the quadric of the surface's second order there (the surface itself but for a torus).
        tensor: the true curvature tensor (3, 3) at the foot of a point (3,) near the contact, 1/m.
    """

    points: Floats
    normals: Floats
    surface: SurfaceMatrix
    tensor: Callable[[Floats], Floats]

    @property
    def K(self) -> Floats:
        """Shape operator at the last point (2, 2), in its contact frame, 1/m."""
        return self.surface.curvature_at(np.zeros(3))[0]

    def measured(self, sigma_point: float, sigma_normal: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Points and unit normals with independent noise: m per axis, rad per tangent axis."""
        points = self.points + sigma_point * rng.normal(size=self.points.shape)
        normals = self.normals + sigma_normal * rng.normal(size=self.normals.shape)
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def error(self, T_frame_contact: Floats, K: Floats) -> Floats:
        """Error (3,) of an estimate's K11, K12, K22 at its contact point, in its contact frame, 1/m.

        An estimate holds at the foot of the last *measured* point, which is off by that point's noise; on a tight
        surface the true curvature differs there by as much as the bound.
        """
        axes = T_frame_contact[:3, :2]
        delta = K - axes.T @ self.tensor(T_frame_contact[:3, 3]) @ axes
        return np.array([delta[0, 0], delta[0, 1], delta[1, 1]])


def make_ground(surface: str, size: float, path: str, length: float, samples: int, *, waves: float = WAVES) -> Ground:
    """A path over a surface.

    Args:
        surface: one of `SURFACES`.
        size: radius, or the length that its radii follow, m; without effect on a plane.
        path: one of `PATHS`.
        length: length of the path as seen from above, m.
        samples: number of equally spaced points.
        waves: number of waves of a weave; it is as wide as such a wave is long, times 5/6.

    Raises:
        UsageError: the name is unknown.
    """
    if path not in PATHS:
        raise UsageError(f"path: expected one of {', '.join(PATHS)}, got {path!r}")
    x, y = _weave(length, samples, waves) if path == "weave" else _circle(length, samples)
    if surface == "torus":
        return _on_torus(size, x, y)
    if surface not in SURFACES:
        raise UsageError(f"surface: expected one of {', '.join(SURFACES)}, got {surface!r}")
    matrix = _turned(_quadric(surface, size))
    points = np.stack([x, y, matrix.height(x, y)], axis=1)
    return Ground(points, matrix.normal(points), matrix, partial(_tensor_of_quadric, matrix))


def _tensor_of_quadric(surface: SurfaceMatrix, near: Floats) -> Floats:
    K, basis = surface.curvature_at(surface.project(near))
    return np.asarray(basis @ K @ basis.T, dtype=np.float64)


def _weave(length: float, samples: int, waves: float) -> tuple[Floats, Floats]:
    """A sine whose amplitude is 5/12 of its wave length, cut to the wanted length; it ends at the origin."""
    t = np.linspace(-waves, 0.0, 8001)
    y = _AMPLITUDE * np.sin(2.0 * np.pi * t)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(t), np.diff(y)))])
    at = np.linspace(0.0, arc[-1], samples)
    scale = length / arc[-1]
    return scale * np.interp(at, arc, t), scale * np.interp(at, arc, y)


def _circle(length: float, samples: int) -> tuple[Floats, Floats]:
    """One turn that ends at the origin."""
    a = np.linspace(0.0, 2.0 * np.pi, samples)
    radius = length / (2.0 * np.pi)
    return radius * np.sin(a), radius * (1.0 - np.cos(a))


def _quadric(surface: str, size: float) -> SurfaceMatrix:
    simple: dict[str, Callable[[], SurfaceMatrix]] = {
        "plane": SurfaceMatrix.plane,
        "cylinder": lambda: SurfaceMatrix.cylinder(size),
        "sphere": lambda: SurfaceMatrix.sphere(size),
        "saddle": lambda: SurfaceMatrix.from_curvature(np.diag([1.0, -0.75]) / size),
    }
    if surface in simple:
        return simple[surface]()
    signs = (1.0, 1.0, 1.0 if surface == "ellipsoid" else -1.0)
    axes = np.multiply(_AXES[surface], size)
    whole = SurfaceMatrix(np.diag([*(np.array(signs) / axes**2), -1.0]))
    point = whole.project(np.multiply(_START[surface], size))
    return whole.normalised_at(point).transformed(whole.contact_frame(point))


def _turned(surface: SurfaceMatrix) -> SurfaceMatrix:
    c, s = np.cos(_OFF_AXIS), np.sin(_OFF_AXIS)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    return surface.transformed(T)


def _on_torus(tube: float, x: Floats, y: Floats) -> Ground:
    """Outside of a torus; the path is laid on its two angles, which keeps points and normals exact."""
    ring, a = _TORUS_RING * tube, _TORUS_ANGLE
    c, s = np.cos(_OFF_AXIS), np.sin(_OFF_AXIS)
    round_ring = (c * x - s * y) / (ring + tube * np.cos(a))
    round_tube = a + (s * x + c * y) / tube
    out = np.stack([np.cos(round_ring), np.sin(round_ring), np.zeros_like(x)], axis=1)
    normals = np.cos(round_tube)[:, None] * out
    normals[:, 2] = np.sin(round_tube)
    points = ring * out + tube * normals
    contact = np.array([ring + tube * np.cos(a), 0.0, tube * np.sin(a)])
    points -= contact
    # contact frame: u along the ring, v along the tube, w = inward normal; x, y turned off both as the path is
    u, v = np.array([0.0, 1.0, 0.0]), np.array([-np.sin(a), 0.0, np.cos(a)])
    w = -np.array([np.cos(a), 0.0, np.sin(a)])
    axes = np.stack([c * u + s * v, -s * u + c * v, w], axis=1)

    def tensor(near: Floats) -> Floats:
        x, y, z = axes @ near + contact
        about, height = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) - ring)
        along = np.array([-np.sin(about), np.cos(about), 0.0])
        up = np.array([-np.sin(height) * np.cos(about), -np.sin(height) * np.sin(about), np.cos(height)])
        k = np.cos(height) / (ring + tube * np.cos(height))
        return np.asarray(axes.T @ (k * np.outer(along, along) + np.outer(up, up) / tube) @ axes, dtype=np.float64)

    K = tensor(np.zeros(3))[:2, :2]
    return Ground(points @ axes, normals @ axes, SurfaceMatrix.from_curvature(K), tensor)
