"""Independent truth for the touch tests: closed-form surfaces, paths over them, noise, and a robot that follows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from canprobe.mechanics.touch import ContactSample, SurfaceMatrix
from canprobe.mechanics.touch.contact import contact_on_object, pad_to_direction

Array = NDArray[np.float64]
STEP = 0.125e-3
PROBE_RADIUS = 0.040
QUADRICS = {
    "ellipsoid": np.diag([1 / 0.060**2, 1 / 0.045**2, 1 / 0.035**2, -1.0]),
    "hyperboloid": np.diag([1 / 0.060**2, 1 / 0.045**2, -1 / 0.035**2, -1.0]),
}


@dataclass(frozen=True)
class Path:
    """A path over a surface in some frame."""

    points: Array
    normals: Array
    surface: SurfaceMatrix

    def noisy(self, sigma_point: float, sigma_normal: float, seed: int) -> tuple[Array, Array]:
        rng = np.random.default_rng(seed)
        points = self.points + sigma_point * rng.normal(size=self.points.shape)
        normals = self.normals + sigma_normal * rng.normal(size=self.normals.shape)
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def error(self, estimate: object, at: Array | None = None) -> Array:
        """(K11, K12, K22) of estimate − truth at a place, by default the last, in the contact frame of the estimate."""
        P = estimate.T_frame_contact[:3, :2]  # type: ignore[attr-defined]
        K, B = self.surface.curvature_at(self.points[-1] if at is None else at)
        delta = estimate.K - P.T @ (B @ K @ B.T) @ P  # type: ignore[attr-defined]
        return np.array([delta[0, 0], delta[0, 1], delta[1, 1]])


def weave(n: int = 160, size: float = 1.0) -> tuple[Array, Array]:
    """n points 0.125 mm apart along a sine of ±2.5 mm and 6 mm wave length, ending at the origin."""
    x = np.linspace(-n * STEP, 0.0, 20001)
    y = 2.5e-3 * np.sin(2 * np.pi * x / 6e-3)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = (np.arange(n) - n + 1) * STEP + arc[-1]
    return size * np.interp(at, arc, x), size * np.interp(at, arc, y)


def in_contact_frame(name: str) -> SurfaceMatrix:
    """A named surface in a contact frame, normalised."""
    simple = {
        "plane": SurfaceMatrix.plane(),
        "cylinder": SurfaceMatrix.cylinder(0.036),
        "sphere": SurfaceMatrix.sphere(0.050),
        "small sphere": SurfaceMatrix.sphere(0.005),
        "saddle": SurfaceMatrix.from_curvature([[20.0, 0.0], [0.0, -15.0]]),
        "bowl": SurfaceMatrix.sphere(-0.080),
    }
    if name in simple:
        return simple[name]
    quadric = SurfaceMatrix(QUADRICS[name])
    start = {"ellipsoid": [0.039, 0.020, 0.022], "hyperboloid": [0.054, 0.027, 0.014]}[name]
    point = quadric.project(start)
    return quadric.normalised_at(point).transformed(quadric.contact_frame(point))


def placed(surface: SurfaceMatrix, x: Array, y: Array, T: Array | None = None) -> Path:
    """The path over (x, y) of a contact frame that stands at T in the frame of the answer."""
    z = surface.height(x, y)
    points = np.stack([x, y, z], axis=1)
    normals = surface.normal(points)
    if T is None:
        return Path(points, normals, surface)
    R, o = T[:3, :3], T[:3, 3]
    return Path(points @ R.T + o, normals @ R.T, surface.transformed(np.linalg.inv(T)))


def any_pose(seed: int) -> Array:
    """A random rigid transform within some decimetres."""
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = Q * np.sign(np.linalg.det(Q))
    T[:3, 3] = 0.2 * rng.normal(size=3)
    return T


def samples(points: Array, normals: Array, t0: float = 0.0) -> Iterator[ContactSample]:
    """Contacts of a probe whose pole follows the normal; places and normals as given."""
    for i, (p, n) in enumerate(zip(points, normals, strict=True)):
        T = facing(p + PROBE_RADIUS * n, n)
        yield ContactSample(t0 + 0.005 * i, p, n, T, np.array([0.0, 0.0, PROBE_RADIUS]), 1.0)


def facing(centre: Array, n: Array) -> Array:
    """Probe pose at a centre with its pole against a normal."""
    x = np.array([1.0, 0.0, 0.0]) + n * n[0] * -1.0
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(-n, x), -n])
    T[:3, 3] = centre
    return T


def felt(path: Path, centroid_noise: float, seed: int) -> Iterator[ContactSample]:
    """Contacts as a pad feels them: the pose is exact, the centroid on the pad is not."""
    rng = np.random.default_rng(seed)
    for i, (p, n) in enumerate(zip(path.points, path.normals, strict=True)):
        T = facing(p + PROBE_RADIUS * n, n)
        d = pad_to_direction(*(centroid_noise * rng.normal(size=2)), PROBE_RADIUS)
        point, normal = contact_on_object(T, d, PROBE_RADIUS, 0.0)
        yield ContactSample(0.005 * i, point, normal, T, PROBE_RADIUS * d, 1.0)


@dataclass(frozen=True)
class Truth:
    """What the tests take from here (test folders are no packages)."""

    weave: Callable[..., tuple[Array, Array]] = weave
    surface: Callable[[str], SurfaceMatrix] = in_contact_frame
    placed: Callable[..., Path] = placed
    any_pose: Callable[[int], Array] = any_pose
    samples: Callable[..., Iterator[ContactSample]] = samples
    felt: Callable[..., Iterator[ContactSample]] = felt

    def path(self, name: str, size: float = 1.0, T: Array | None = None) -> Path:
        """A weave over a named surface."""
        return placed(in_contact_frame(name), *weave(size=0.25 * size if name == "small sphere" else size), T)

    def straight(self, name: str, angle: float = 0.0, length: float = 0.02) -> Path:
        """A straight path over a named surface that ends at the origin."""
        s = np.linspace(-length, 0.0, 160)
        return placed(in_contact_frame(name), s * math.cos(angle), s * math.sin(angle))


@pytest.fixture(scope="session")
def truth() -> Truth:
    """Closed-form surfaces, paths, noise."""
    return Truth()


@dataclass(frozen=True)
class TorusLine:
    """A cut of a torus by a plane along a normal: points and outward normals (n, 3) of a straight path, and its K."""

    ring: float
    tube: float
    points: Array
    normals: Array

    def tensor(self, point: Array) -> Array:
        """(3, 3) curvature near a point, 1/m."""
        u, v = self._angles(point)
        along_ring = np.array([-math.sin(u), math.cos(u), 0.0])
        along_tube = np.array([-math.sin(v) * math.cos(u), -math.sin(v) * math.sin(u), math.cos(v)])
        across = math.cos(v) / (self.ring + self.tube * math.cos(v))
        result: Array = np.outer(along_tube, along_tube) / self.tube + across * np.outer(along_ring, along_ring)
        return result

    def _angles(self, point: Array) -> tuple[float, float]:
        """Along ring and tube, rad."""
        return math.atan2(point[1], point[0]), math.atan2(point[2], math.hypot(point[0], point[1]) - self.ring)

    def felt(self, sigma_point: float, sigma_normal: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """Points and normals with noise."""
        normals = self.normals + sigma_normal * rng.normal(size=self.normals.shape)
        points = self.points + sigma_point * rng.normal(size=self.points.shape)
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.fixture(scope="session")
def torus_line() -> Callable[..., TorusLine]:
    """A straight path over a torus: ring and tube (m), where on the tube it ends and its heading there (rad)."""

    def cut(ring: float, tube: float, end: float, heading: float, *, length: float, samples: int = 160) -> TorusLine:
        up = np.array([math.cos(end), 0.0, math.sin(end)])
        along = math.cos(heading) * np.array([-up[2], 0.0, up[0]]) + math.sin(heading) * np.array([0.0, 1.0, 0.0])
        line = np.array([ring, 0.0, 0.0]) + tube * up + np.linspace(-length, 0.0, samples)[:, None] * along
        height = np.zeros((samples, 1))
        for _ in range(20):
            p = line + height * up
            rho = np.hypot(p[:, 0], p[:, 1])
            gradient = np.stack([(rho - ring) * p[:, 0] / rho, (rho - ring) * p[:, 1] / rho, p[:, 2]], axis=1)
            value = (rho - ring) ** 2 + p[:, 2] ** 2 - tube**2
            height -= (0.5 * value / (gradient @ up))[:, None]
        return TorusLine(ring, tube, p, gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    return cut
