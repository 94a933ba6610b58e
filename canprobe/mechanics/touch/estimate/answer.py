"""The answer of an estimator: local shape at the last contact, its covariance, and what was not observed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.mechanics.touch.checks import checked, read_only
from canprobe.mechanics.touch.estimate.matrix import MAX_HIDDEN_ENTRY, UncertainMatrix, linear_map, matrix_behind
from canprobe.mechanics.touch.estimate.observed import CurvatureInformation, Decision, outside, tensor
from canprobe.mechanics.touch.estimate.quadric import TO_Q, TO_Q_SQUARED, matrix_of, parameters_of
from canprobe.mechanics.touch.estimate.residuals import transport
from canprobe.mechanics.touch.linear_algebra import principal
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats, Vec

_MAX_HIDDEN_DIRECTION = 0.05
"""Largest unobserved part of the normal curvature along a direction that still counts as observed."""
_UMBILIC_CHI2 = 5.99
"""95 % point of χ² with two degrees of freedom, which the deviator of K has."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurfaceEstimate:
    """Local shape in the estimated contact frame of the last sample (z = inward normal); lengths in m.

    What the data did not observe is NaN in `K`, `kappa`, infinite in `covariance`, and False in `observed`. `S` alone
    is always finite: it holds unobserved combinations at the value nearest to flat, good for predicting along the
    path that was travelled and for nothing else.

    Attributes:
        S: (4, 4) surface matrix in the contact frame, c14 = c24 = c44 = 0, c34 = −½.
        T_frame_contact: (4, 4) contact frame to the frame of the points; its origin is on the estimated surface.
        K: (2, 2) shape operator in the contact frame, 1/m.
        kappa: (2,) principal curvatures, κ1 ≥ κ2, 1/m. With one observed it stands first, whatever its size, and is the
            normal curvature along `directions[0]`.
        directions: (2, 3) rows: unit vectors of `kappa` in the frame of the points.
        covariance: (3, 3) covariance of (K11, K12, K22), 1/m².
        observed: (2,) whether each of `kappa` was observed.
        rank: how many independent combinations of (K11, K12, K22) were observed, 0–3 (thresholds: `observed`).
        combinations: (rank, 3) rows: the observed ones as weights of (K11, √2 K12, K22).
        information: (3, 3) information of the data about (K11, √2 K12, K22), m²; finite also where nothing is observed.
        umbilic: κ1 and κ2 do not differ significantly (95 %), so that the directions are arbitrary.
        innovation: mean squared whitened residual per degree of freedom; about 1 when the model and the σ's are right.
        distance: path that the estimate rests on, m.
        samples: number of samples it rests on (effective, with forgetting).
        method: name of the estimator.
        prior: name of the prior that was assumed.
        notes: notes for a reader, one sentence each.
        stiffness: stiffness K/h of the probe's layer, N/m³, from an estimator that knows it; else None.
        contradicted: the patch contradicts the motion, so that neither observes anything.
        problem_root: root of the information (`rootᵀ root`) of the whitened dimensionless least-squares problem.
        model_root: (n, 9) root of the information (`rootᵀ root`, prior included) about the entries of `S` in the
            contact frame, in the order c14, c24, c44, c13, c23, c33, c11, c12, c22; SI units. It includes the
            information about place and normal. None from the methods of differences, which do not know it.
        evidence: value and information of K from the data (and a prior on curvature) before the rank decision, to be
            fused with another source. None from the methods of differences.
    """

    S: Floats
    T_frame_contact: Floats
    K: Floats
    kappa: Floats
    directions: Floats
    covariance: Floats
    observed: Floats
    rank: int
    combinations: Floats
    information: Floats
    umbilic: bool
    innovation: float
    distance: float
    samples: float
    method: str
    prior: str
    problem_root: Floats
    notes: tuple[str, ...] = ()
    model_root: Floats | None = None
    evidence: CurvatureInformation | None = None
    stiffness: float | None = None
    contradicted: bool = False

    def __post_init__(self) -> None:
        for field in self.__slots__:
            if isinstance(value := getattr(self, field), np.ndarray):
                value.setflags(write=False)

    @classmethod
    def of(cls, T_frame_contact: Floats, K: Floats, *, method: str = "own") -> SurfaceEstimate:
        """An estimate of which only frame and curvature are known, from an estimator of your own.

        Args:
            T_frame_contact: (4, 4) contact frame to that of the points: its origin on the surface, z the inward normal.
            K: (2, 2) shape operator along its x and y, 1/m; positive where the object is convex.
            method: name of the estimator.
        """
        c = parameters_of(SurfaceMatrix.from_curvature(checked("K", K, (2, 2))).S)
        known = Decision(np.zeros(3), np.eye(3), np.ones(3, dtype=bool))
        return build_estimate(
            Solution(c, np.full((3, 3), math.inf), known, has_prior=False),
            length=1.0,
            T_frame_contact=checked("T_frame_contact", T_frame_contact, (4, 4)),
            problem_root=np.eye(3),
            innovation=math.nan,
            distance=math.nan,
            samples=math.nan,
            method=method,
            prior="none",
        )

    @property
    def condition_number(self) -> float:
        """Condition number of the whitened dimensionless least-squares problem; infinite where it is singular."""
        singular = np.linalg.svd(self.problem_root, compute_uv=False)
        return float(singular[0] / singular[-1]) if singular[-1] > 0.0 else math.inf

    @property
    def T_base_contact(self) -> Floats:
        """`T_frame_contact` where the frame of the points is the base, as online."""
        return self.T_frame_contact

    @property
    def surface(self) -> SurfaceMatrix:
        """`S` with its operations."""
        return SurfaceMatrix(self.S)

    @property
    def point(self) -> Floats:
        """(3,) the contact point on the estimated surface, m."""
        return self.T_frame_contact[:3, 3]

    @property
    def normal(self) -> Floats:
        """(3,) the outward unit normal there."""
        return -self.T_frame_contact[:3, 2]

    def curvature_tensor_base(self) -> Floats:
        """(3, 3) shape operator as a tensor in the frame of the points, `P K Pᵀ`, 1/m.

        It is taken from `S` and so always finite; do not use it where `observed` is False.
        """
        P = self.T_frame_contact[:3, :2]
        result: Floats = P.dot(2.0 * self.S[:2, :2]).dot(P.T)
        return result

    def matrix(self, T_base_frame: ArrayLike | None = None) -> UncertainMatrix:
        """All ten unknowns of S with their covariance, in a frame of your choice.

        The covariance holds what the region of K holds (as stated in `covariance`), and the errors of normal, place and
        c13, c23, c33, of which a short path knows hardly more than the `prior`. It does not hold what displaces the
        whole surface: errors of tool and arm. The scale of S is that of the contact frame, c34 = −½ there, without an
        error. From the methods of differences, `of` and a patch alone, only the covariance of K is known.

        Args:
            T_base_frame: (4, 4) the frame, to the frame of the points (online the base), m; None: the contact frame.

        Returns:
            S and covariance; what was not observed is NaN, with an infinite variance.

        Raises:
            UsageError: T_base_frame is no finite (4, 4).
        """
        T_contact_frame: Floats = np.eye(4)
        if T_base_frame is not None:
            T_frame = checked("T_base_frame", T_base_frame, (4, 4))
            T_contact_frame = np.asarray(np.linalg.solve(self.T_frame_contact, T_frame))
        return matrix_behind(
            linear_map(T_contact_frame), self.S, (self.covariance, self.combinations, self.information), self.model_root
        )

    def predict(self, point: Floats) -> tuple[Floats, Floats]:
        """Point and outward normal of the estimated surface where a line along the contact normal meets it.

        Args:
            point: (3,) a point of that line near the contact, in the frame of the points, m.

        Returns:
            Point (3,), m, and unit normal (3,), in the frame of the points; NaN where the quadric has no point there.
        """
        R, origin = self.T_frame_contact[:3, :3], self.T_frame_contact[:3, 3]
        local = R.T @ (point - origin)
        surface = self.surface
        local[2] = float(surface.height(local[0], local[1]))
        return origin + R @ local, R @ surface.normal(local)


class Solution(NamedTuple):
    """A solved local model, dimensionless, before it becomes an estimate.

    Attributes:
        c: (9,) parameters in the contact frame (c14 = c24 = c44 = 0).
        covariance: (3, 3) covariance of (K11, K12, K22); used as it is where all is observed.
        decision: rank decision on the data's information.
        has_prior: whether a prior makes every combination finite.
        root: (9, 9) root of the information about c, prior included; None where it is not known.
    """

    c: Floats
    covariance: Floats
    decision: Decision
    has_prior: bool
    root: Floats | None = None


def build_estimate(solution: Solution, *, length: float, T_frame_contact: Floats, **facts: Any) -> SurfaceEstimate:
    """An estimate from a solution in units of `length` (m); `facts` are the fields that no solution gives."""
    T = read_only(T_frame_contact)
    return SurfaceEstimate(T_frame_contact=T, **_shape(solution, T, length), **facts)


def with_solution(answer: SurfaceEstimate, solution: Solution, **facts: Any) -> SurfaceEstimate:
    """An estimate with another solution in its contact frame, in 1/m; `facts` are other fields that change."""
    return replace(answer, **_shape(solution, answer.T_frame_contact, 1.0), **facts)


def _shape(solution: Solution, T: Floats, length: float) -> dict[str, Any]:
    """The fields of an estimate in the contact frame T (4, 4) that a solution in units of `length` (m) gives."""
    S = matrix_of(solution.c)
    S[:3, :3] /= length
    k = 2.0 * S[:2, :2]
    decision = solution.decision
    covariance = solution.covariance / length**2
    if decision.rank == 3:
        kappa, local = _principal(k)
        observed = np.array([True, True])
        umbilic = is_umbilic(k, covariance)
    else:
        k, covariance, kappa, local, observed = _partly(k, covariance, decision, solution.has_prior, length)
        umbilic = False
    V = decision.vectors
    return {
        "S": S,
        "K": k,
        "kappa": kappa,
        "directions": local.dot(T[:3, :2].T),
        "covariance": covariance,
        "observed": observed,
        "rank": decision.rank,
        "combinations": V[:, decision.passed].T.copy(),
        "information": (V * decision.information).dot(V.T) * length**2,
        "umbilic": umbilic,
        "model_root": None if solution.root is None else solution.root * [1.0, 1.0, 1.0 / length, *6 * [length]],
    }


def _principal(K: Floats) -> tuple[Floats, Floats]:
    """κ1 ≥ κ2 and their directions as rows (2, 2)."""
    mean, radius, angle = principal(K)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([mean + radius, mean - radius]), np.array([[c, s], [-s, c]])


def is_umbilic(K: Floats, covariance: Floats) -> bool:
    """Whether the deviator (K11 − K22, 2 K12) of K is 0 within its 95 % region."""
    (k11, k12), (_, k22) = K.tolist()
    (c11, c12, c13), (_, c22, c23), (_, _, c33) = covariance.tolist()
    x, y = k11 - k22, 2.0 * k12
    a, b, d = c11 - 2.0 * c13 + c33, 2.0 * (c12 - c23), 4.0 * c22
    determinant = a * d - b * b
    # times the determinant instead of divided by it: an infinite covariance answers False, and nothing raises
    return bool(determinant > 0.0 and (d * x * x - 2.0 * b * x * y + a * y * y) < _UMBILIC_CHI2 * determinant)


def _partly(
    K: Floats, covariance: Floats, decision: Decision, has_prior: bool, length: float
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """K, covariance, kappa, directions and flags where the data did not observe all of K."""
    if has_prior:
        kappa, local = _principal(K)
        flags = [outside(decision, _projector(d)) < _MAX_HIDDEN_DIRECTION for d in local]
        return K, covariance, kappa, local, np.array(flags)
    t = _observed_direction(decision)
    local = np.array([t, [-t[1], t[0]]])
    seen = decision.rank > 0 and outside(decision, _projector(t)) < _MAX_HIDDEN_DIRECTION
    kappa = np.array([float(t @ K @ t) if seen else math.nan, math.nan])
    hidden = np.array([outside(decision, e) >= MAX_HIDDEN_ENTRY for e in np.eye(3)])
    K = np.where(hidden[[[0, 1], [1, 2]]], math.nan, K)
    V, passed = decision.vectors, decision.passed
    covariance = partial_covariance(V[:, passed], decision.information[passed], hidden) / length**2
    return K, covariance, kappa, local, np.array([seen, False])


def partial_covariance(V: Floats, information: Floats, hidden: Floats) -> Floats:
    """Covariance (3, 3) of (K11, K12, K22), NaN and infinite in the hidden (3,) entries.

    Args:
        V: (3, k) columns: observed combinations of q.
        information: (k,) information about each of them.
        hidden: (3,) whether an entry of K is hidden.
    """
    C: Floats = (V / information) @ V.T / TO_Q_SQUARED
    C[hidden] = C[:, hidden] = math.nan
    C[hidden, hidden] = math.inf
    return C


def _projector(t: Floats) -> Floats:
    """q of t tᵀ, the normal curvature along the tangent direction t (2,)."""
    x, y = t.tolist()
    result: Floats = TO_Q * [x * x, x * y, y * y]
    return result


def _observed_direction(decision: Decision) -> Floats:
    """The tangent direction whose normal curvature the data know best."""
    # with one unobserved combination it is the null direction of that combination; with two it is the main direction of
    # the observed one
    if decision.rank == 0:
        return np.array([1.0, 0.0])
    open_one = decision.rank == 2
    wanted = np.logical_not(decision.passed) if open_one else decision.passed
    q = decision.vectors[:, int(np.argmax(wanted))]
    values, vectors = np.linalg.eigh(tensor(q))
    order = np.argsort(np.abs(values))
    result: Floats = vectors[:, order[0 if open_one else 1]]
    return result if result[np.argmax(np.abs(result))] > 0.0 else -result


class Anchor(NamedTuple):
    """A solution in its own contact frame.

    Attributes:
        c: (9,) dimensionless parameters, c14 = c24 = c44 = 0.
        M: (9, 9) derivative of c by the parameters in the working frame.
        T_frame_contact: (4, 4) contact frame to the frame of the points, m.
        turn: angle of the contact frame's x axis from the working frame's, rad.
    """

    c: Floats
    M: Floats
    T_frame_contact: Floats
    turn: float


def foot(c: Floats, start: Vec) -> tuple[Vec, Vec]:
    """Foot of a nearby point on the model's surface and the inward unit normal there, dimensionless.

    Why not Newton on the Lagrange conditions, as in `SurfaceMatrix.project`: this runs for every answer in the loop,
    and for a point near the surface four rounds in plain floats suffice.
    """
    half0, half1, constant, *entries = c.tolist()
    b02, b12, b22, b00, b01, b11 = [2.0 * entry for entry in entries]
    h0, h1, h2 = 2.0 * half0, 2.0 * half1, -1.0
    p, q, r = x, y, z = start
    u, v, w = b00 * x + b01 * y + b02 * z + h0, b01 * x + b11 * y + b12 * z + h1, b02 * x + b12 * y + b22 * z + h2
    for _ in range(4):
        # along the gradient to the surface, and back over the start along the tangent plane
        f = 0.5 * (x * (u + h0) + y * (v + h1) + z * (w + h2)) + constant
        share = ((x - p) * u + (y - q) * v + (z - r) * w - f) / (u * u + v * v + w * w)
        x, y, z = p + share * u, q + share * v, r + share * w
        u, v, w = b00 * x + b01 * y + b02 * z + h0, b01 * x + b11 * y + b12 * z + h1, b02 * x + b12 * y + b22 * z + h2
    size = math.sqrt(u * u + v * v + w * w)
    return (x, y, z), (-u / size, -v / size, -w / size)


def anchor(c: Floats, T_frame_work: Floats, point: Vec, length: float) -> Anchor:
    """A model at the foot of a point; c (9,) and the point in the working frame, in units of `length` (m)."""
    x, z = foot(c, point)
    R_work = T_frame_work[:3, :3]
    R = tangent_rotation(R_work.dot(z).tolist())
    R_work_contact = R_work.T.dot(R)
    c_new, M = transport(c, homogeneous(R_work_contact, x))
    c_new[:3] = 0.0  # what is left is rounding; `curvature_jacobian` takes them for 0
    origin = T_frame_work[:3, 3] + length * R_work.dot(x)
    (xx, xy, _), (yx, yy, _), _ = R_work_contact.tolist()
    # the two planes are tilted: this is the turn of the plane's rotation that is nearest (polar decomposition)
    turn = math.atan2(yx - xy, xx + yy)
    return Anchor(c_new, M, homogeneous(R, origin), turn)
