"""The nine-parameter local model, a quadric near the origin of a working frame, with c34 = −½; and which of it was
observed.

Parameters, in this order: `c14, c24, c44` (tilt and height of the working frame), `c13, c23, c33`, and
`c11, c12, c22`, the half of K, last, so that the trailing 3x3 block of an upper triangular information root is the
information about K with all else unknown. Lengths are in units of some length L: a dimensionless problem.

Residual rows of a sample (x, n): `f/|∇f|` and the two tangential parts of `∇f/|∇f| − n`, whitened by σ_p² and
`σ_n² I + K² σ_p²`: the point's tangential noise turns the model's normal by K times it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.touch.estimate.noise import Noise
from canprobe.touch.linear_algebra import Array, eigen

# The nine-parameter local model: a quadric near the origin of a working frame, with c34 = −½.

UNIT = np.array([0.5, 0.5 / np.sqrt(2.0), 0.5])
"""c11, c12, c22 per unit of q = (K11, √2 K12, K22), in which a rotation of the frame is orthogonal."""

_INDEX = ((0, 3), (1, 3), (3, 3), (0, 2), (1, 2), (2, 2), (0, 0), (0, 1), (1, 1))
BASIS = np.zeros((9, 4, 4))
"""(9, 4, 4): S = BASISᵀ c + constant."""
for _k, (_i, _j) in enumerate(_INDEX):
    BASIS[_k, _i, _j] = BASIS[_k, _j, _i] = 1.0
_FLAT = BASIS.reshape(9, 16)
_PICK = np.array([4 * i + j for i, j in _INDEX])
_CONSTANT = np.zeros((4, 4))
_CONSTANT[2, 3] = _CONSTANT[3, 2] = -0.5
_WIDE = np.concatenate([BASIS, _CONSTANT[None]]).transpose(1, 0, 2).reshape(4, 40)
"""S as the sum of ten matrices, side by side."""
_ENTRIES = np.array([[40 * i + 4 * k + j for k in range(10)] for i, j in (*_INDEX, (2, 3))])
"""Where the parameters stand in each of them, and c34."""


class Rows(NamedTuple):
    """Whitened residuals (n, 3), their Jacobian (n, 3, 9) and the log-determinant of their covariances."""

    r: Array
    J: Array
    log_det: float


class Design(NamedTuple):
    """What does not change from one iteration to the next.

    Attributes:
        X: (n, 3) points in the working frame.
        T: (n, 2, 3) tangent axes of the measured normals.
        noise: of the samples.
        point_variance, normal_variance: (n,) the noise per axis.
    """

    X: Array
    T: Array
    noise: Noise
    point_variance: Array
    normal_variance: Array


def matrix_of(c: Array) -> Array:
    """S (4, 4) of parameters (9,)."""
    return (c @ _FLAT).reshape(4, 4) + _CONSTANT


def parameters_of(S: Array) -> Array:
    """Parameters (9,) of S (4, 4), scaled to c34 = −½."""
    result: Array = S.reshape(16)[_PICK] * (-0.5 / S[2, 3])
    return result


def design(points: Array, normals: Array, noise: Noise) -> Design:
    """Constant parts for points and outward normals (n, 3) in the working frame."""
    return Design(points, tangents(normals), noise, noise.point_variance, noise.normal_variance)


def value_rows(X: Array) -> Array:
    """df/dc (n, 9) at points (n, 3)."""
    x, y, z = X.T
    F = np.empty((len(X), 9))
    F[:, 0], F[:, 1], F[:, 2] = 2 * x, 2 * y, 1.0
    F[:, 3], F[:, 4], F[:, 5] = 2 * x * z, 2 * y * z, z * z
    F[:, 6], F[:, 7], F[:, 8] = x * x, 2 * x * y, y * y
    return F


def gradient_rows(X: Array, V: Array) -> Array:
    """d(V ∇f)/dc (n, k, 9) at points (n, 3) for vectors (n, k, 3)."""
    x, y, z = (2.0 * X.T)[:, :, None]
    vx, vy, vz = V[:, :, 0], V[:, :, 1], V[:, :, 2]
    G = np.empty((*vx.shape, 9))
    G[:, :, 0], G[:, :, 1], G[:, :, 2] = 2.0 * vx, 2.0 * vy, 0.0
    G[:, :, 3], G[:, :, 4], G[:, :, 5] = z * vx + x * vz, z * vy + y * vz, z * vz
    G[:, :, 6], G[:, :, 7], G[:, :, 8] = x * vx, y * vx + x * vy, y * vy
    return G


def tangents(normals: Array) -> Array:
    """Two tangent axes (n, 2, 3) of unit normals (n, 3) that lie near the z axis, either way."""
    T = np.empty((len(normals), 2, 3))
    nx, ny, nz = normals.T
    size = np.sqrt(nz * nz + nx * nx)
    flat = size < 1e-6  # normal along y: cannot be in a sane working frame, but must not divide by zero
    if flat.any():
        nz, size = np.where(flat, 1.0, nz), np.where(flat, 1.0, size)
    T[:, 0, 0], T[:, 0, 1], T[:, 0, 2] = nz / size, 0.0, -nx / size
    T[:, 1, 0], T[:, 1, 1], T[:, 1, 2] = -ny * nx / size, size, -ny * nz / size
    return T


def linear_rows(d: Design) -> tuple[Array, Array]:
    """Whitened linear equations (3n, 9), (3n,): f = 0 and t·∇f = 0, as if |∇f| were 1 everywhere.

    The second multiplies the normals' noise into the regressor and shrinks K by some percent: a start, no answer.
    """
    w_p, w_n = 1.0 / np.sqrt(d.point_variance), 1.0 / np.sqrt(d.normal_variance)
    A = np.empty((len(d.X), 3, 9))
    A[:, 0] = value_rows(d.X) * w_p[:, None]
    A[:, 1:] = gradient_rows(d.X, d.T) * w_n[:, None, None]
    b = np.stack([d.X[:, 2] * w_p, d.T[:, 0, 2] * w_n, d.T[:, 1, 2] * w_n], axis=1)
    return A.reshape(-1, 9), b.reshape(-1)


def rows(c: Array, d: Design) -> Rows:
    """Whitened residuals and Jacobian at parameters (9,).

    The model's normal is compared at the foot of the measured point, and the Jacobian is taken where the sample most
    likely was (foot moved by the part of the residual that the point's tangential noise explains). At the measured
    point itself its noise would enter the regressors together with the residuals, which draws K towards 0.
    """
    at = linearise(c, d)
    log_det = -2.0 * float(np.log(at.W[:, 1, 1] * at.W[:, 2, 2]).sum())
    return Rows(at.r, at.jacobian(value_rows(at.X), gradient_rows(at.X, at.V), d), log_det)


class Linearised(NamedTuple):
    """The model at the likely places of the samples, from which any term of f has its Jacobian.

    Attributes:
        r: (n, 3) whitened residuals.
        X: (n, 3) likely places.
        V: (n, 3, 3) rows: the model's unit normal and the tangent axes of the measured one.
        bend: (n, 3, 2) change of the model's normal along the tangent axes when its foot moves along V.
        inverse: (n,) 1/|∇f|.
        W: (n, 3, 3) whitener.
    """

    r: Array
    X: Array
    V: Array
    bend: Array
    inverse: Array
    W: Array

    def jacobian(self, F: Array, G: Array, d: Design) -> Array:
        """Whitened Jacobian (n, 3, k) of k terms of f, from df/dc (n, k) and d(V ∇f)/dc (n, 3, k); changes G."""
        G[:, 1:] -= (d.T @ self.V[:, 0, :, None]) * G[:, :1]
        G[:, 0] = F
        G *= self.inverse[:, None, None]
        G[:, 1:] -= self.bend[:, 0, :, None] * G[:, :1]  # the foot moves with the model
        result: Array = self.W @ G
        return result


def linearise(c: Array, d: Design) -> Linearised:
    """The model at parameters (9,), as for `rows`."""
    S = matrix_of(c)
    B, h = 2.0 * S[:3, :3], 2.0 * S[:3, 3]
    g = d.X @ B + h
    square = np.einsum("ij,ij->i", g, g)
    f = 0.5 * np.einsum("ij,ij->i", d.X, g + h) + S[3, 3]
    X = d.X - g * (f / square)[:, None]
    r = np.empty((len(X), 3))
    r[:, 0] = f / np.sqrt(square)
    g = X @ B + h
    inverse = 1.0 / np.sqrt(np.einsum("ij,ij->i", g, g))
    V = np.empty((len(X), 3, 3))
    V[:, 0], V[:, 1:] = g * inverse[:, None], d.T
    r[:, 1:] = (d.T @ V[:, 0, :, None])[:, :, 0]
    bend = (V.reshape(-1, 3) @ B).reshape(V.shape) @ d.T.mT * inverse[:, None, None]
    felt = bend[:, 1:] + d.noise.coupling * np.eye(2)  # turn against the surface that an error of the point is felt as
    W = _whitener(felt, V[:, 0], d)
    r = (W @ r[:, :, None])[:, :, 0]
    X = _likely_places(d, X, (r[:, None] @ W)[:, 0], felt, V[:, 0])
    g = X @ B + h
    inverse = 1.0 / np.sqrt(np.einsum("ij,ij->i", g, g))
    V[:, 0] = g * inverse[:, None]
    return Linearised(r, X, V, bend, inverse, W)


def _whitener(K: Array, ghat: Array, d: Design) -> Array:
    """Lower triangular W (n, 3, 3) with Wᵀ W the inverse covariance of the residuals."""
    W = np.zeros((len(K), 3, 3))
    if not d.noise.isotropic:
        point, normal = d.noise.covariances()
        A = np.concatenate([ghat[:, None], K @ d.T], axis=1)
        C = A @ point @ A.mT
        C[:, 1:, 1:] += d.T @ normal @ d.T.mT
        return np.linalg.solve(np.linalg.cholesky(C), np.broadcast_to(np.eye(3), C.shape))
    vp, vn = d.point_variance, d.normal_variance
    k11, k12, k22 = K[:, 0, 0], K[:, 0, 1], K[:, 1, 1]
    l11 = np.sqrt(vn + vp * (k11 * k11 + k12 * k12))
    l21 = vp * k12 * (k11 + k22) / l11
    l22 = np.sqrt(vn + vp * (k12 * k12 + k22 * k22) - l21 * l21)
    W[:, 0, 0], W[:, 1, 1], W[:, 2, 2] = 1.0 / np.sqrt(vp), 1.0 / l11, 1.0 / l22
    W[:, 2, 1] = -l21 / (l11 * l22)
    return W


def _likely_places(d: Design, foot: Array, score: Array, K: Array, ghat: Array) -> Array:
    """Most likely true places (n, 3), given residuals times their inverse covariance (n, 3)."""
    if d.noise.isotropic:
        tangential = (score[:, None, 1:] @ K @ d.T)[:, 0]
        return foot - d.point_variance[:, None] * tangential
    A = np.concatenate([ghat[:, None], K @ d.T], axis=1)
    result: Array = d.X - ((score[:, None] @ A) @ d.noise.covariances()[0])[:, 0]
    return result


def transport(c: Array, T: Array) -> tuple[Array, Array]:
    """The same surface in new coordinates, `S' = Tᵀ S T` scaled to c34 = −½, and dc'/dc.

    Args:
        c: (9,).
        T: (4, 4) takes new coordinates to old, lengths in the problem's unit.

    Returns:
        c' (9,) and M (9, 9).
    """
    moved = ((T.T @ _WIDE).reshape(40, 4) @ T).reshape(-1).take(_ENTRIES)
    entries = moved[:, :9] @ c + moved[:, 9]
    scale = -0.5 / float(entries[9])
    c_new = scale * entries[:9]
    M: Array = scale * (moved[:9, :9] + (2.0 * c_new)[:, None] * moved[9, :9])
    return c_new, M


def curvature_jacobian(c: Array) -> Array:
    """d(K11, K12, K22)/dc (3, 9) in the *estimated* contact frame, where c14 = c24 = c44 = 0.

    The frame tilts with c14, c24, so c13 and c23 leak in; |∇f| changes with c44 through c33.
    """
    c13, c23, c33, c11, c12, c22 = c[3:9].tolist()
    D = np.zeros((3, 9))
    D[0, 6] = D[1, 7] = D[2, 8] = 2.0
    D[0, 0], D[1, 0] = 8.0 * c13, 4.0 * c23
    D[1, 1], D[2, 1] = 4.0 * c13, 8.0 * c23
    D[0, 2] = 4.0 * c33 * c11 + 8.0 * c13 * c13
    D[1, 2] = 4.0 * c33 * c12 + 8.0 * c13 * c23
    D[2, 2] = 4.0 * c33 * c22 + 8.0 * c23 * c23
    return D


# What `quadric.rows` makes of one sample, in plain floats: a twentieth of the time at this size.


class SampleRows(NamedTuple):
    """Whitened rows of one sample.

    Attributes:
        weights: (12,) of three rows, one after the other: of f, f_x, f_y, f_z in the row of any term of f.
        residuals: three, their signs turned.
        place: x, y, z at which the sample most likely was: where the terms are to be taken.
    """

    weights: tuple[float, ...]
    residuals: tuple[float, float, float]
    place: tuple[float, float, float]


def sample_rows(
    c: Sequence[float], x: Sequence[float], n: Sequence[float], variances: tuple[float, float], coupling: float = 0.0
) -> SampleRows:
    """The rows of one sample with isotropic noise.

    Args:
        c: nine parameters in the order of `quadric`.
        x, n: point and outward normal in the working frame, dimensionless.
        variances: of point and normal per axis, dimensionless.
        coupling: `Noise.coupling`, dimensionless.
    """
    point_variance, normal_variance = variances
    c14, c24, c44, c13, c23, c33, c11, c12, c22 = c
    px, py, pz = x
    # value and gradient at the measured point, then at its foot
    gx = 2.0 * (c11 * px + c12 * py + c13 * pz + c14)
    gy = 2.0 * (c12 * px + c22 * py + c23 * pz + c24)
    gz = 2.0 * (c13 * px + c23 * py + c33 * pz) - 1.0
    square = gx * gx + gy * gy + gz * gz
    f = 0.5 * (px * (gx + 2.0 * c14) + py * (gy + 2.0 * c24) + pz * (gz - 1.0)) + c44
    k = f / square
    r0 = f / math.sqrt(square)
    px, py, pz = px - k * gx, py - k * gy, pz - k * gz
    hx, hy, hz, inverse = _unit_gradient(c, px, py, pz)
    # tangent axes of the measured normal
    nx, ny, nz = n
    size = math.sqrt(nz * nz + nx * nx)
    ax, az = nz / size, -nx / size
    bx, by, bz = -ny * nx / size, size, -ny * nz / size
    ra, rb = ax * hx + az * hz, bx * hx + by * hy + bz * hz
    # 2 S3 along the axes, and on them the shape operator with the coupling
    ux, uy, uz = 2 * (c11 * ax + c13 * az), 2 * (c12 * ax + c23 * az), 2 * (c13 * ax + c33 * az)
    wx = 2 * (c11 * bx + c12 * by + c13 * bz)
    wy = 2 * (c12 * bx + c22 * by + c23 * bz)
    wz = 2 * (c13 * bx + c23 * by + c33 * bz)
    k11 = (ax * ux + az * uz) * inverse + coupling
    k12 = (bx * ux + by * uy + bz * uz) * inverse
    k22 = (bx * wx + by * wy + bz * wz) * inverse + coupling
    bend_a = (hx * ux + hy * uy + hz * uz) * inverse
    bend_b = (hx * wx + hy * wy + hz * wz) * inverse
    # whitening: Cholesky of σ_n² I + K² σ_p²
    l11 = math.sqrt(normal_variance + point_variance * (k11 * k11 + k12 * k12))
    l21 = point_variance * k12 * (k11 + k22) / l11
    l22 = math.sqrt(normal_variance + point_variance * (k12 * k12 + k22 * k22) - l21 * l21)
    w0 = 1.0 / math.sqrt(point_variance)
    ra /= l11
    rb = (rb - l21 * ra) / l22
    # where the sample most likely was
    sb = rb / l22
    sa = (ra - l21 * sb) / l11
    ea, eb = point_variance * (k11 * sa + k12 * sb), point_variance * (k12 * sa + k22 * sb)
    px, py, pz = px - ea * ax - eb * bx, py - eb * by, pz - ea * az - eb * bz
    hx, hy, hz, inverse = _unit_gradient(c, px, py, pz)
    # Jacobian there; the tangent axes lose their part along the model's normal
    t = ax * hx + az * hz
    ax, ay, az = ax - t * hx, -t * hy, az - t * hz
    t = bx * hx + by * hy + bz * hz
    bx, by, bz = bx - t * hx, by - t * hy, bz - t * hz
    s0, sa, sb, m = w0 * inverse, inverse / l11, inverse / l22, l21 / l22
    a0, a1, a2, a3 = -sa * bend_a, sa * ax, sa * ay, sa * az
    b0, b1, b2, b3 = -sb * bend_b - m * a0, sb * bx - m * a1, sb * by - m * a2, sb * bz - m * a3
    weights = s0, 0.0, 0.0, 0.0, a0, a1, a2, a3, b0, b1, b2, b3
    return SampleRows(weights, (-w0 * r0, -ra, -rb), (px, py, pz))


def _unit_gradient(c: Sequence[float], px: float, py: float, pz: float) -> tuple[float, float, float, float]:
    """∇f/|∇f| and 1/|∇f|."""
    c14, c24, _, c13, c23, c33, c11, c12, c22 = c
    gx = 2.0 * (c11 * px + c12 * py + c13 * pz + c14)
    gy = 2.0 * (c12 * px + c22 * py + c23 * pz + c24)
    gz = 2.0 * (c13 * px + c23 * py + c33 * pz) - 1.0
    inverse = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz)
    return gx * inverse, gy * inverse, gz * inverse, inverse


# Which combinations of curvature the data observed.
#
# The decision is made on K alone, in q = (K11, √2 K12, K22), where a turn of the frame is orthogonal, so that it does
# not depend on the choice of axes. A combination of K counts as observed when
#
# 1. the points were spread: their mean square distance from their mean, along the axes that the combination weighs, is
#    at least `SPREAD · σ_p²` (noise alone would give σ_p²). Below, an answer would be drawn towards 0 with a small but
#    false σ. This is decided first, on the places alone, so that no fit can talk itself into it;
# 2. its standard deviation, all other parameters unknown, is at most `SIGMA_LIMIT · max(‖K‖, 1/L)`, L the length of the
#    path;
# 3. its information is at least `NUMERIC` times the largest: rounding.
#
# A straight path passes two of three: the normal curvature along it and the twist. Combinations that fail are held at
# the value nearest to flat.

SPREAD = 10.0
SIGMA_LIMIT = 0.3
NUMERIC = 1e-12

_ROOT2 = math.sqrt(2.0)


class Decision(NamedTuple):
    """What is known about q, combination by combination.

    Attributes:
        information: (3,) information 1/σ² of each; 0 for what the points were not spread for.
        vectors: (3, 3) columns, orthonormal in q.
        passed: (3,) bool.
    """

    information: Array
    vectors: Array
    passed: NDArray[np.bool_]

    @property
    def rank(self) -> int:
        """Number of observed combinations."""
        return int(self.passed.tolist().count(True))


def nothing_observed() -> Decision:
    """The decision where a model does not hold."""
    return Decision(np.zeros(3), np.eye(3), np.zeros(3, dtype=bool))


def decide(root_q: Array, spread: Array, curvature: float) -> Decision:
    """Rank decision.

    Args:
        root_q: (m, 3) root of the data's information about q, all else unknown, dimensionless.
        spread: (2, 2) covariance of the points in the tangent plane over the variance of their noise.
        curvature: ‖K‖, dimensionless.
    """
    small, large, axes = _axes(spread)
    if small >= SPREAD:  # spread for everything, the usual case
        values, vectors = eigen(root_q.T @ root_q)
        return Decision(np.maximum(values, 0.0), vectors, values >= _least(curvature, float(values[-1])))
    wide = np.array([large, 0.5 * (small + large), small]) >= SPREAD
    seen = axes[:, wide]
    root = root_q @ seen
    values, turn = eigen(root.T @ root) if seen.size else (np.zeros(0), np.zeros((0, 0)))
    least = _least(curvature, float(values.max(initial=0.0)))
    unseen = int(np.count_nonzero(~wide))
    return Decision(
        np.concatenate([np.zeros(unseen), values]),
        np.concatenate([axes[:, ~wide], seen @ turn], axis=1),
        np.concatenate([np.zeros(unseen, dtype=bool), values >= least]),
    )


def _least(curvature: float, largest: float) -> float:
    return max(1.0 / (SIGMA_LIMIT * max(curvature, 1.0)) ** 2, NUMERIC * largest)


def _axes(spread: Array) -> tuple[float, float, Array]:
    """Eigenvalues of the spread and, as columns in q, the curvature along its main axis, the twist, and across."""
    (a, b), (_, d) = spread.tolist()
    mean, half = 0.5 * (a + d), 0.5 * (a - d)
    radius = math.hypot(half, b)
    angle = 0.5 * math.atan2(b, half)
    return mean - radius, mean + radius, turned(angle).T


def spread_share(spread: Array) -> Array:
    """How far each combination may be believed that the points were hardly spread for.

    The noise of the points spreads them as well, and what it says about curvature is false. Where a share s of the
    spread is noise the information counts (1 − s)²: nothing at s = 1, 0.81 at the threshold of the rank decision. A
    fusion needs that without a jump.

    Args:
        spread: as for `decide`.

    Returns:
        (3, 3) symmetric F; information I becomes F I F.
    """
    small, large, axes = _axes(spread)
    true = [max(0.0, 1.0 - 1.0 / max(s, 1e-300)) for s in (large, 0.5 * (small + large), small)]
    result: Array = axes * np.array(true) @ axes.T
    return result


def turned(angle: float) -> Array:
    """The (3, 3) orthogonal matrix that takes q = (K11, √2 K12, K22) to axes turned by an angle in rad."""
    c, s = math.cos(angle), math.sin(angle)
    cs = _ROOT2 * c * s
    return np.array([[c * c, cs, s * s], [-cs, c * c - s * s, cs], [s * s, -cs, c * c]])


def spread_of(points: Array, variance: Array) -> Array:
    """Covariance (2, 2) of points (n, 2 or 3) in the tangent plane, over the variance (n,) of their noise per axis."""
    weight = 1.0 / variance
    offset = points[:, :2] - weight @ points[:, :2] / weight.sum()
    result: Array = (offset * weight[:, None]).T @ offset / len(points)
    return result


def outside(decision: Decision, q: Array) -> float:
    """Length of the part of q (3,) that the data did not observe, relative to q."""
    hidden = decision.vectors[:, np.logical_not(decision.passed)].T @ q
    return math.sqrt(float(hidden @ hidden) / float(q @ q))


def tensor(q: Array) -> Array:
    """The symmetric (2, 2) matrix of q."""
    off = q[1] / _ROOT2
    return np.array([[q[0], off], [off, q[2]]])
