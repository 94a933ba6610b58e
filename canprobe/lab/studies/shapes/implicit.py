"""A Gaussian process that is 0 on the surface and has its normals as gradient: the usual surface of sparse touches.

Observations of f are 0 at every contact and the normal as ∇f there, with their stated noise; the prior's mean is the
distance from the contacts' mean plane. The kernel is a function of r = |x − x'|; with a = k'/r and b = (k'' − k'/r)/r²
the covariances of values and gradients are, d = x − x',

    cov(f, f') = k,   cov(∇f, f') = a d,   cov(f, ∇'f') = −a d,   cov(∇f, ∇'f') = −a I − b d dᵀ.

Near the surface f/|∇f| is the distance, its standard deviation that of f over |∇f|. n contacts cost (4 n)³/3.

Source: Williams and Fitzgibbon, "Gaussian process implicit surfaces", 2007; Dragiev, Toussaint and Gienger, "Gaussian
process implicit surfaces for shape estimation and grasping", ICRA 2011; Rasmussen and Williams, "Gaussian processes for
machine learning", 2006, 9.4 (derivatives), 5.4 (marginal likelihood).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

Kernel = Callable[[Floats, float, float], tuple[Floats, Floats, Floats]]
"""Distances r, scale of f (m) and length (m) → k, a, b."""
_STEP_M = 2e-4
"""Step of the differences that give the curvature."""
_BATCH_POINTS = 400
"""Query points; more would only take more memory."""


def rbf(r: Floats, scale: float, length: float) -> tuple[Floats, Floats, Floats]:
    """s² exp(−r²/2ℓ²)."""
    k = scale**2 * np.exp(-0.5 * (r / length) ** 2)
    return k, -k / length**2, k / length**4


def thin_plate(r: Floats, scale: float, length: float) -> tuple[Floats, Floats, Floats]:
    """s² (2 r³ − 3 R r² + R³) / R³; R is `length`, to be above every distance."""
    unit = scale**2 / length**3
    k = unit * (2.0 * r**3 - 3.0 * length * r**2 + length**3)
    return k, 6.0 * unit * (r - length), 6.0 * unit / np.maximum(r, 1e-12)


class Touched(NamedTuple):
    """Contacts with their noise: points (n, 3), m, outward normals, and standard deviations (n,), m and rad."""

    points: Floats
    normals: Floats
    sigma_point: Floats
    sigma_normal: Floats

    def some(self, i: Floats | slice) -> Touched:
        """The contacts of some indices."""
        return Touched(*(values[i] for values in self))


class ImplicitSurface:
    """The posterior of f.

    Args:
        kernel: `rbf` or `thin_plate`.
        scale, length: its parameters, m.
        touched: the contacts.
    """

    def __init__(self, kernel: Kernel, scale: float, length: float, touched: Touched) -> None:
        self._k, self._settings = kernel, (scale, length)
        points, normals, sigma_point, sigma_normal = touched
        self.points = points
        self._middle = points.mean(axis=0)
        up = normals.mean(axis=0)
        self._up = up / np.linalg.norm(up)
        observed = np.column_stack([-(points - self._middle) @ self._up, normals - self._up]).ravel()
        noise = np.column_stack([sigma_point, *3 * [sigma_normal]]).ravel()
        C = self._covariance(points, points)
        C[np.diag_indices_from(C)] += noise**2
        self._root = cho_factor(C, lower=True, overwrite_a=True)
        self._weights: Floats = cho_solve(self._root, observed)
        self.log_likelihood = -0.5 * float(observed @ self._weights) - float(np.log(np.diag(self._root[0])).sum())
        self.log_likelihood -= 0.5 * len(observed) * math.log(2.0 * math.pi)

    def _covariance(self, x: Floats, y: Floats) -> Floats:
        """Covariance (4 n, 4 m) of (f, ∇f) at points x and at points y."""
        d = x[:, None] - y
        k, a, b = self._k(np.sqrt(np.einsum("ijk,ijk->ij", d, d)), *self._settings)
        C = np.empty((len(x), 4, len(y), 4))
        C[:, 0, :, 0] = k
        ad, bd = a[..., None] * d, b[..., None] * d
        C[:, 0, :, 1:] = -ad
        C[:, 1:, :, 0] = ad.transpose(0, 2, 1)
        for i in range(3):
            for j in range(3):
                C[:, 1 + i, :, 1 + j] = -bd[:, :, i] * d[:, :, j] - (a if i == j else 0.0)
        return C.reshape(4 * len(x), 4 * len(y))

    def value(self, x: Floats) -> tuple[Floats, Floats]:
        """f (n,) and ∇f (n, 3) at points (n, 3)."""
        parts = [
            self._covariance(x[i : i + _BATCH_POINTS], self.points) @ self._weights
            for i in range(0, len(x), _BATCH_POINTS)
        ]
        both = np.concatenate([np.zeros(0), *parts]).reshape(-1, 4)
        return both[:, 0] + (x - self._middle) @ self._up, both[:, 1:] + self._up

    def sigma(self, x: Floats) -> Floats:
        """Standard deviation of f at points, (n,)."""
        found = [np.zeros(0)]
        for i in range(0, len(x), _BATCH_POINTS):
            C = self._covariance(x[i : i + _BATCH_POINTS], self.points)[::4]
            half = solve_triangular(self._root[0], C.T, lower=True, check_finite=False)
            k0 = self._k(np.zeros(1), *self._settings)[0]
            found.append(np.sqrt(np.maximum(k0 - np.einsum("ij,ij->j", half, half), 0.0)))
        return np.concatenate(found)

    def curvature(self, x: Floats) -> Floats:
        """Curvature tensors of the level sets through points (n, 3, 3), 1/m."""
        steps = [self.value(x + s * _STEP_M * e)[1] for e in np.eye(3) for s in (1.0, -1.0)]
        hessian = np.stack([(steps[2 * k] - steps[2 * k + 1]) / (2.0 * _STEP_M) for k in range(3)], axis=2)
        g = self.value(x)[1]
        size = np.linalg.norm(g, axis=1)[:, None, None]
        n = g / size[:, 0]
        P = np.eye(3) - n[:, :, None] * n[:, None, :]
        result: Floats = P @ hessian @ P / size
        return result


def fit_quadric(at: Floats, up: Floats, touched: Touched) -> tuple[Floats, Floats, Floats] | None:
    """Least squares of a quadric over a tangent plane, weighted by stated noise: a second usual answer.

    The height over the plane and the slopes of the normals are fitted; the plane follows the answer in three rounds.

    Args:
        at, up: place (3,), m, and the outward normal near it (3,).
        touched: the contacts near it.

    Returns:
        The contact frame (4, 4), K (2, 2), and the covariance (6, 6) of height, slopes, K11, K12, K22; None where the
        contacts leave it open.
    """
    points, normals, sigma_point, sigma_normal = touched
    w = np.concatenate([1.0 / sigma_point, 1.0 / sigma_normal, 1.0 / sigma_normal])
    for _ in range(3):
        R = tangent_rotation(-up)
        x, y, z = ((points - at) @ R).T
        n = normals @ R
        one, zero = np.ones_like(x), np.zeros_like(x)
        rows = np.concatenate(
            [
                np.stack([one, x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1),
                np.stack([zero, one, zero, x, y, zero], axis=1),
                np.stack([zero, zero, one, zero, x, y], axis=1),
            ]
        )
        values = np.concatenate([z, -n[:, 0] / n[:, 2], -n[:, 1] / n[:, 2]])
        c, _, rank, _ = np.linalg.lstsq(rows * w[:, None], values * w, rcond=1e-9)
        if rank < 6:
            return None
        at = at + c[0] * R[:, 2]
        up = R @ np.array([c[1], c[2], -1.0])
        up /= np.linalg.norm(up)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = tangent_rotation(-up), at
    K = np.array([[c[3], c[4]], [c[4], c[5]]])
    return T, K, np.linalg.inv((rows * w[:, None]).T @ (rows * w[:, None]))
