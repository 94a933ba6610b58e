"""The local model, a quadric near the origin of a working frame with c34 = −½, and which of its curvature was observed.

Nine parameters, in this order: `c14, c24, c44` (tilt and height of the working frame), `c13, c23, c33`, and
`c11, c12, c22`, the half of K, last, so that the trailing 3x3 block of an upper triangular information root is the
information about K with all else unknown. Beside them stand the nine cubic and quartic terms that a quadric leaves
out. Lengths are in units of some length L: a dimensionless problem.

Residuals of a sample (x, n): `f/|∇f|` and the two tangential parts of `∇f/|∇f| − n`, whitened by σ_p² and
`σ_n² I + K² σ_p²`: the point's tangential noise turns the model's normal by K times it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.estimate.noise import Noise
from canprobe.mechanics.touch.linear_algebra import Array, eigen, principal

TO_Q = np.array([1.0, math.sqrt(2.0), 1.0])
"""K11, K12, K22 to q = (K11, √2 K12, K22), in which a rotation of the frame is orthogonal."""
UNIT = 0.5 / TO_Q
"""c11, c12, c22 per unit of q."""

_INDEX = ((0, 3), (1, 3), (3, 3), (0, 2), (1, 2), (2, 2), (0, 0), (0, 1), (1, 1))
_BASIS = np.zeros((9, 4, 4))
"""S = Σ c_k _BASIS_k + _CONSTANT."""
for _k, (_i, _j) in enumerate(_INDEX):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0
_FLAT = _BASIS.reshape(9, 16)
_PLACES = np.array([4 * i + j for i, j in _INDEX])
_CONSTANT = np.zeros((4, 4))
_CONSTANT[2, 3] = _CONSTANT[3, 2] = -0.5
_WIDE = np.concatenate([_BASIS, _CONSTANT[None]]).transpose(1, 0, 2).reshape(4, 40)
"""S as the sum of ten matrices, side by side."""
_ENTRIES = np.array([[40 * i + 4 * k + j for k in range(10)] for i, j in (*_INDEX, (2, 3))])
"""Where the parameters stand in each of them, and c34."""


def matrix_of(c: Array) -> Array:
    """S (4, 4) of parameters (9,)."""
    S: Array = c.dot(_FLAT).reshape(4, 4)
    S += _CONSTANT
    return S


def parameters_of(S: Array) -> Array:
    """Parameters (9,) of S (4, 4), scaled to c34 = −½."""
    result: Array = S.take(_PLACES)
    result *= -0.5 / S[2, 3]
    return result


def size_of(c: Array) -> float:
    """‖K‖ of parameters (9,), Frobenius."""
    c11, c12, c22 = c[6:].tolist()
    return 2.0 * math.sqrt(c11 * c11 + 2.0 * c12 * c12 + c22 * c22)


def sharpest(c: Array) -> float:
    """Largest |κ| of parameters (9,)."""
    c11, c12, c22 = c[6:].tolist()
    return float(abs(c11 + c22) + math.hypot(c11 - c22, 2.0 * c12))


# The eighteen terms of f: nine of the quadric, and the cubic and quartic ones that it leaves out.
#
# The latter are terms `Σ a_j φ_j(x, y)` of the height over the tangent plane, φ all monomials of third and fourth
# degree, each times the root of its binomial coefficient, so that independent a of one variance mean the same in all
# directions. All terms are polynomials of the place, so values, gradients and changes of the origin are each one
# product of a constant matrix with the place's monomials.

_POWER_Y = (0, 1, 2, 3, 0, 1, 2, 3, 4)
DEGREE = np.array([3, 3, 3, 3, 4, 4, 4, 4, 4])
"""(9,) degree of each term that a quadric leaves out."""
_FACTOR = [math.sqrt(math.comb(int(n), k)) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
_HIGHER = [(int(n) - k, k, 0) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
_QUADRIC = [(1, 0, 0), (0, 1, 0), (0, 0, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (2, 0, 0), (1, 1, 0), (0, 2, 0)]
"""Powers of x, y, z in the terms of the nine parameters, in their order."""
_OWN = [2.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 1.0]
_POWERS = [
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (2, 0, 0),
    (1, 1, 0),
    (0, 2, 0),
    (1, 0, 1),
    (0, 1, 1),
    (0, 0, 2),
    *_HIGHER,
]


def _monomials(x: Any, y: Any, z: Any) -> Array:
    """The 19 monomials of `_POWERS` at a place, (19,), or at places given as arrays, (19, n)."""
    xx, xy, yy = x * x, x * y, y * y
    rest = [xx * x, xx * y, x * yy, yy * y, xx * xx, xx * xy, xx * yy, xy * yy, yy * yy]
    return np.array((1.0 + 0.0 * x, x, y, z, xx, xy, yy, x * z, y * z, z * z, *rest))


def _derivatives() -> Array:
    """(19, 4, 18): values and derivatives by x, y, z of the 18 terms, per monomial."""
    found = np.zeros((len(_POWERS), 4, 18))
    for column, (powers, factor) in enumerate(zip(_QUADRIC + _HIGHER, _OWN + _FACTOR, strict=True)):
        found[_POWERS.index(powers), 0, column] = factor
        for axis in range(3):
            i, k, n = np.array(powers) - np.eye(3, dtype=int)[axis]
            if powers[axis]:
                found[_POWERS.index((i, k, n)), 1 + axis, column] = factor * powers[axis]
    return found


def _shift() -> Array:
    """(19, 162): A and Q of `shifted`, per monomial of the new place."""
    found = np.zeros((len(_POWERS), 18, 9))
    own = {powers: (row, factor) for row, (powers, factor) in enumerate(zip(_HIGHER, _FACTOR, strict=True))}
    low = {powers: (9 + row, factor) for row, (powers, factor) in enumerate(zip(_QUADRIC, _OWN, strict=True))}
    for column, ((i, k, _), factor) in enumerate(zip(_HIGHER, _FACTOR, strict=True)):
        for a in range(i + 1):
            for b in range(k + 1):
                row, per = (own if a + b > 2 else low)[a, b, 0]
                size = factor * math.comb(i, a) * math.comb(k, b) / per
                found[_POWERS.index((i - a, k - b, 0)), row, column] = size
    return found.reshape(len(_POWERS), -1)


_SHIFT = _shift()
_TABLE = {count: _derivatives()[:, :, :count].reshape(len(_POWERS), -1) for count in (9, 18)}


def terms(X: Array, count: int = 18) -> Array:
    """Values and derivatives by x, y, z (n, 4, count) of the first terms of f, the quadric's nine first, at (n, 3)."""
    values: Array = _monomials(*X.T).T.dot(_TABLE[count]).reshape(len(X), 4, count)
    return values


def shifted(x: float, y: float) -> tuple[Array, Array]:
    """The terms that a quadric leaves out about another place (x, y).

    Returns:
        A (9, 9) and Q (9, 9): terms a become terms `A a` there, and `Q a` more in the nine parameters.
    """
    both = _monomials(x, y, 0.0).dot(_SHIFT).reshape(18, 9)
    return both[:9], both[9:]


# Residuals of samples and their Jacobian.


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


def design(points: Array, normals: Array, noise: Noise) -> Design:
    """Constant parts for points and outward normals (n, 3) in the working frame."""
    return Design(points, tangents(normals), noise, noise.point_variance, noise.normal_variance)


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
    w_p = 1.0 / np.sqrt(d.point_variance)
    w_n = 1.0 / np.sqrt(d.normal_variance + d.noise.coupling**2 * d.point_variance)
    F = terms(d.X, 9)
    A = np.concatenate([F[:, :1] * w_p[:, None, None], d.T @ F[:, 1:] * w_n[:, None, None]], axis=1)
    b = np.stack([d.X[:, 2] * w_p, d.T[:, 0, 2] * w_n, d.T[:, 1, 2] * w_n], axis=1)
    return A.reshape(-1, 9), b.reshape(-1)


class Linearised(NamedTuple):
    """The model at the likely places of samples.

    The model's normal is compared at the foot of the measured point, and the Jacobian is taken where the sample most
    likely was (foot moved by the part of the residual that the point's tangential noise explains). At the measured
    point itself its noise would enter the regressors together with the residuals, which draws K towards 0.

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

    @property
    def log_det(self) -> float:
        """Log-determinant of the covariances of the residuals."""
        return -2.0 * float(np.log(self.W[:, 1, 1] * self.W[:, 2, 2]).sum())

    def jacobian(self, count: int = 9) -> Array:
        """Whitened Jacobian (n, 3, count): 9 of the parameters, 18 with the terms that a quadric leaves out."""
        F = terms(self.X, count)
        G = self.V @ F[:, 1:]
        G[:, 1:] -= (self.V[:, 1:] @ self.V[:, 0, :, None]) * G[:, :1]  # ∇f/|∇f| is blind to what is along it
        G[:, 0] = F[:, 0]
        G *= self.inverse[:, None, None]
        G[:, 1:] -= self.bend[:, 0, :, None] * G[:, :1]  # the foot moves with the model
        result: Array = self.W @ G
        return result


def linearise(c: Array, d: Design) -> Linearised:
    """The model at parameters (9,) with samples."""
    S = matrix_of(c)
    B, h = 2.0 * S[:3, :3], 2.0 * S[:3, 3]
    g = d.X.dot(B) + h
    square = np.einsum("ij,ij->i", g, g)
    f = 0.5 * np.einsum("ij,ij->i", d.X, g + h) + S[3, 3]
    X = d.X - g * (f / square)[:, None]
    r = np.empty((len(X), 3))
    r[:, 0] = f / np.sqrt(square)
    g = X.dot(B) + h
    inverse = 1.0 / np.sqrt(np.einsum("ij,ij->i", g, g))
    V = np.empty((len(X), 3, 3))
    V[:, 0], V[:, 1:] = g * inverse[:, None], d.T
    r[:, 1:] = (d.T @ V[:, 0, :, None])[:, :, 0]
    bend = V.reshape(-1, 3).dot(B).reshape(V.shape) @ d.T.mT * inverse[:, None, None]
    felt = bend[:, 1:] + d.noise.coupling * np.eye(2)  # turn against the surface that an error of the point is felt as
    W = _whitener(felt, V[:, 0], d)
    r = (W @ r[:, :, None])[:, :, 0]
    X = _likely_places(d, X, (r[:, None] @ W)[:, 0], felt, V[:, 0])
    g = X.dot(B) + h
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
    """c' (9,) of the same surface in new coordinates, `S' = Tᵀ S T` scaled to c34 = −½, and dc'/dc (9, 9).

    T (4, 4) takes new coordinates to old, lengths in the problem's unit.
    """
    moved = T.T.dot(_WIDE).reshape(40, 4).dot(T).take(_ENTRIES)
    entries = moved[:, :9].dot(c) + moved[:, 9]
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
    axes, wide = excited(spread)
    if wide.all():
        root = root_q.dot(axes)
        values, turn = eigen(root.T.dot(root))
        return Decision(values, axes.dot(turn), values >= _least(curvature, float(values[-1])))
    seen = axes[:, wide]
    root = root_q.dot(seen)
    values, turn = eigen(root.T.dot(root)) if seen.size else (np.zeros(0), np.zeros((0, 0)))
    least = _least(curvature, float(values.max(initial=0.0)))
    unseen = int(np.count_nonzero(~wide))
    return Decision(
        np.concatenate([np.zeros(unseen), values]),
        np.concatenate([axes[:, ~wide], seen.dot(turn)], axis=1),
        np.concatenate([np.zeros(unseen, dtype=bool), values >= least]),
    )


def _least(curvature: float, largest: float) -> float:
    return max(1.0 / (SIGMA_LIMIT * max(curvature, 1.0)) ** 2, NUMERIC * largest)


def excited(spread: Array) -> tuple[Array, NDArray[np.bool_]]:
    """As columns (3, 3) in q the curvature along the main axis of a spread, the twist, and across; and for which of
    them (3,) the points were spread.
    """
    mean, radius, angle = principal(spread)
    return turned(angle).T, np.array([mean + radius, mean, mean - radius]) >= SPREAD


def turned(angle: float) -> Array:
    """The (3, 3) orthogonal matrix that takes q = (K11, √2 K12, K22) to axes turned by an angle in rad."""
    c, s = math.cos(angle), math.sin(angle)
    cs = math.sqrt(2.0) * c * s
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
    k11, k12, k22 = q / TO_Q
    return np.array([[k11, k12], [k12, k22]])
