"""Estimators over a window of the last samples: `ml`, and the linear ones from differences, `chord` and `chen1996`.

The linear ones rest on `n_a − n_b = 2 S₃ (p_a − p_b)`, exact only where |∇f| is constant along the surface: plane,
sphere, circular cylinder. Elsewhere they keep a bias without any noise, and noise in the points, on both sides of the
equation, draws them towards 0. They are baselines and are reported as they are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import Solution, SurfaceEstimate, build_estimate
from canprobe.mechanics.touch.estimate.likelihood import Touches, fit_ml, make_touches, working_frame
from canprobe.mechanics.touch.estimate.noise import Correlation, Prior, make_noise
from canprobe.mechanics.touch.estimate.online import AGREES, LAST_FEW, Dropped, Gate, looks_changed
from canprobe.mechanics.touch.estimate.quadric import TO_Q, decide, size_of
from canprobe.mechanics.touch.linear_algebra import Array, rotation_vectors, upper_root, whole

# Six-unknown linear estimates from differences of points and normals.

NO_PRIOR = "none (the method takes none)"
_COLUMNS = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Columns of c11 c12 c13 c22 c23 c33 in the rows of S₃ y."""
_FROM_SIX = [2, 4, 5, 0, 1, 3]
"""c13 c23 c33 c11 c12 c22 of the nine-parameter order, as places among the six."""
_K_OF_SIX = [0, 1, 3]
"""2 c11, 2 c12, 2 c22, which are K itself, among the six."""
_NUMERIC = 1e-10
_OPEN = 1e-8
"""Part of K in a unit vector of the six that the differences leave open, from which it is no rounding."""


class Pairs(NamedTuple):
    """Differences along a path.

    Attributes:
        newer, older: (m,) indices of the samples.
        points: (m, 3) differences of points, in the contact frame's axes, over the extent.
        normals: (m, 3) differences of outward normals.
    """

    newer: NDArray[np.intp]
    older: NDArray[np.intp]
    points: Array
    normals: Array


def chord_pairs(touches: Touches) -> Pairs:
    """Every sample against the last."""
    n = len(touches.points)
    return _pairs(touches, np.full(n - 1, n - 1), np.arange(n - 1))


def lag_pairs(touches: Touches, lag: int) -> Pairs:
    """Every sample against the one `lag` before it."""
    newer = np.arange(lag, len(touches.points))
    return _pairs(touches, newer, newer - lag)


def _pairs(touches: Touches, newer: NDArray[np.intp], older: NDArray[np.intp]) -> Pairs:
    R = working_frame(touches)[:3, :3]
    p, n = touches.points, touches.normals
    return Pairs(newer, older, (p[newer] - p[older]) @ R / touches.extent, (n[newer] - n[older]) @ R)


def usable_lag(n: int, lag: int) -> int:
    """The lag that n samples allow: at most half of them."""
    return max(1, min(lag, (n - 1) // 2))


def three_rows(y: Array) -> Array:
    """A (3m, 6) with `A c = S₃ y` for vectors y (m, 3), (33) without its empty columns."""
    A = np.zeros((len(y), 3, 6))
    for row, columns in enumerate(_COLUMNS):
        A[:, row, columns] = y
    return A.reshape(-1, 6)


def solve_pairs(touches: Touches, data: Pairs, method: str) -> SurfaceEstimate:
    """Least squares for 2 S₃, in the contact frame of the last *measured* point and normal.

    By SVD; singular values below 1e-10 of the largest are left out, and what of K lies along their vectors is not
    observed: three points leave one open that mixes c33 with K. The covariance is propagated from the samples' noise;
    it does not know the method's bias.
    """
    length = touches.extent
    A, b = three_rows(data.points), data.normals.reshape(-1)
    U, s, Vt = np.linalg.svd(A, full_matrices=len(A) < 6)  # all six of Vt, however few the rows
    rank = int(np.count_nonzero(s > _NUMERIC * max(float(s[0]), 1e-300)))
    inverse = (Vt[:rank].T / s[:rank]) @ U[:, :rank].T
    double = inverse @ b
    residual = b - A @ double
    c = np.concatenate([np.zeros(3), 0.5 * double[_FROM_SIX]])
    size = size_of(c)
    vp = float(touches.noise.point_variance.mean()) / length**2
    variance = float(touches.noise.normal_variance.mean()) + size**2 * vp
    k = variance * _propagated(data, inverse)[np.ix_(_K_OF_SIX, _K_OF_SIX)]
    flat = data.points[:, :2]
    root_q = _root_of(k * np.outer(TO_Q, TO_Q), TO_Q[:, None] * Vt[rank:, _K_OF_SIX].T)
    decision = decide(root_q, flat.T @ flat / (len(flat) * 2.0 * vp), size)
    return build_estimate(
        Solution(c, k, decision, has_prior=False),
        length=length,
        T_frame_contact=working_frame(touches),
        problem_root=upper_root(A),
        innovation=float(residual @ residual) / max(len(residual) - 6, 1) / (2.0 * variance),
        distance=touches.distance,
        samples=float(len(touches.points)),
        method=method,
        prior=NO_PRIOR,
    )


def _propagated(data: Pairs, inverse: Array) -> Array:
    """Covariance (6, 6) of the six per unit variance of each sample's equation noise."""
    gain = inverse.reshape(6, -1, 3)
    total = np.zeros((int(data.newer.max()) + 1, 6, 3))
    np.add.at(total, data.newer, gain.transpose(1, 0, 2))
    np.subtract.at(total, data.older, gain.transpose(1, 0, 2))
    result: Array = np.einsum("kia,kja->ij", total, total)
    return result


def _root_of(covariance: Array, open_ways: Array) -> Array:
    """A root (k, 3) of the inverse of a covariance that may vanish or be singular (then: nothing is known there).

    Nothing is known along the columns of `open_ways` (3, m) either.
    """
    ways, sizes, _ = np.linalg.svd(open_ways)
    known = ways[:, np.count_nonzero(sizes > _OPEN) :]
    values, vectors = np.linalg.eigh(known.T @ covariance @ known)
    inverse = np.where(values > 1e-14 * values.max(initial=1e-300), 1.0 / np.maximum(values, 1e-300), 0.0)
    result: Array = np.sqrt(inverse)[:, None] * (known @ vectors).T
    return result


# The estimators.


class WindowEstimator:
    """Base of the estimators that keep their last samples and solve them as a batch when asked.

    Args:
        sigma_point, sigma_normal: effective noise, m and rad; with differences they only enter covariance and flags.
        window: samples that are kept.
        prior: of `ml`; None for `Prior.weak` over the extent of the window.
        coupling: of the errors of point and normal (`Noise`), 1/m; of `ml`.
        correlation: of the noise along the path; of `ml`.
    """

    least = 2
    """Fewer samples give no answer."""

    def __init__(
        self,
        *,
        sigma_point: float,
        sigma_normal: float,
        window: int,
        prior: Prior | None = None,
        coupling: float = 0.0,
        correlation: Correlation | None = None,
    ) -> None:
        kept = whole("window", window, self.least, "samples")
        self.dropped = Dropped()
        self._gate = Gate(sigma_point, sigma_normal)
        self._prior, self._coupling, self._correlation = prior, coupling, correlation
        self._rows: deque[Sequence[float]] = deque(maxlen=kept)
        self._answer: SurfaceEstimate | None = None

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        if self._gate.passes(sample, self.dropped):
            self._rows.append(self._row(sample))
            self._answer = None

    def estimate(self) -> SurfaceEstimate | None:
        """The answer over the samples kept; None from fewer than `least`, or where they face more than 90° apart."""
        if self._answer is None and len(self._rows) >= self.least:
            touches = self._touches()
            if float((touches.normals @ touches.normals[-1]).min()) > 0.0:
                answer = self._solve(touches)
                self._answer = replace(answer, notes=answer.notes + self._gate.notes())
        return self._answer

    def reset(self) -> None:
        """Forget all samples."""
        self._rows.clear()
        self._gate.reset()
        self._answer = None

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        raise NotImplementedError

    def _row(self, sample: ContactSample) -> Sequence[float]:
        """What is kept of a sample: point, normal, their standard deviations; a subclass adds what it needs."""
        return (*sample.p_base.tolist(), *sample.n_base.tolist(), *self._gate.sigmas(sample))

    def _touches(self) -> Touches:
        rows = np.array(self._rows)
        noise = make_noise(len(rows), rows[:, 6], rows[:, 7], self._coupling)
        return make_touches(rows[:, :3], rows[:, 3:6], noise, self._correlation)


class MlEstimator(WindowEstimator):
    """Nine-parameter Gauss–Newton over a window (`nonlinear`): the reference, some milliseconds an answer.

    A window over a change of the surface has no quadric, and its last samples would be taken for wrong ones. So they
    are held against the fit first; where they disagree as a changed surface does, what was before is forgotten.
    """

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        answer = fit_ml(touches, self._prior)
        squares = _squared_residuals(answer, touches)
        if len(squares) < 3 * LAST_FEW or answer.rank < 3 or not looks_changed(squares):
            return answer
        agree = np.flatnonzero(squares <= AGREES * float(np.median(squares)))
        for _ in range(min(int(agree[-1]) + 1, len(squares) - LAST_FEW)):
            self._rows.popleft()
        answer = fit_ml(self._touches(), self._prior)
        return replace(answer, notes=(*answer.notes, "the surface changed: memory shortened"))


def _squared_residuals(answer: SurfaceEstimate, touches: Touches) -> Array:
    """(n,) squared distance of contacts from an answer's surface, χ² of 3 where the noise is as stated."""
    places = (touches.points - answer.point) @ answer.T_frame_contact[:3, :3]
    gradient = answer.surface.gradient(places)
    size = np.sqrt(np.einsum("ij,ij->i", gradient, gradient))
    tilt = gradient / size[:, None] - touches.normals @ answer.T_frame_contact[:3, :3]
    point = touches.noise.point_variance
    felt = np.abs(answer.kappa).max() + touches.noise.coupling
    normal = touches.noise.normal_variance + felt**2 * point
    result: Array = (answer.surface.value(places) / size) ** 2 / point + np.einsum("ij,ij->i", tilt, tilt) / normal
    return result


class ChordEstimator(WindowEstimator):
    """`n_i − n_0 = 2 S₃ (p_i − p_0)` over a window, p_0 the last sample."""

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        return solve_pairs(touches, chord_pairs(touches), "chord")


# The scheme of Chen, Rink and Zhang (1996), (24)–(35), over a window.
#
# From a stretch of contact, in the contact frame of its last sample: `x_i = −S y_i` (27) with `x_i = ω × n_f + S_f v_f`
# (28), `y_i = V + v` (29), assembled to `A c = b` (30)–(34) with the boundary row. What is not in print, and had to be
# settled:
#
# - S in (27)–(28) means 2S (of both bodies): as printed, (28) drops the factor 2 on S' and κ would be wrong by it.
# - All y_i4 are 0, so the columns of c14, c24, c34, c44 vanish: A has rank 7 at most, (35) is singular for every
#   motion. Its solution of least norm is that of the six unknowns that are left (`solve_pairs`), in the gauge
#   c14 = c24 = c44 = 0, c34 = −½.
# - Rates are differences of samples `lag` apart.
#
# Known faults, reproduced: a bias of some percent where |∇f| is not constant, and noise in y that draws κ towards 0.
#
# Source: Chen, Rink and Zhang, "Local object shape from tactile sensing", section 4.1.2.


class Chen1996Estimator(WindowEstimator):
    """The paper's own scheme, with the rates of a robot and its pad.

    Args:
        sigma_point, sigma_normal, window: as of `WindowEstimator`.
        lag: samples between the two of a difference. 1 is the paper's; noise of the points then swamps the motion.
    """

    least = 3

    def __init__(self, *, sigma_point: float, sigma_normal: float, window: int, lag: int = 10) -> None:
        super().__init__(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window)
        self._lag = whole("lag", lag, 1, "sample")

    def _row(self, sample: ContactSample) -> Sequence[float]:
        """With the probe's pose, row by row, and the contact in its frame."""
        return (*super()._row(sample), *sample.T_base_probe[:3].ravel().tolist(), *sample.r_probe.tolist())

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        rows = np.array(self._rows)
        lag = usable_lag(len(rows), self._lag)
        newer = np.arange(lag, len(rows))
        rates = paper_rates(rows[:, 8:20].reshape(-1, 3, 4), rows[:, 20:], touches.normals, lag)
        x, y = np.array(rates) @ working_frame(touches)[:3, :3]
        return solve_pairs(touches, Pairs(newer, newer - lag, y / touches.extent, -x), "chen1996")


def paper_rates(T_base_probe: Array, r_probe: Array, n_base: Array, lag: int) -> tuple[Array, Array]:
    """x (28) and y (29) (n − lag, 3) times the time between samples `lag` apart, in base axes; the object stands still.

    `x = ω × n_f + K_f v_f`, `y = V_f + v_f`, everything taken half-way; K_f = 1/|r_probe|.

    Args:
        T_base_probe: (n, 3 or 4, 4) poses of the probe.
        r_probe: (n, 3) contact points in its frame, m.
        n_base: (n, 3) outward normals of the object there.
        lag: samples between the two of a difference.
    """
    R, r = T_base_probe[:, :3, :3], r_probe[:, :, None]
    Ra, Rb, ra, rb = R[:-lag], R[lag:], r[:-lag], r[lag:]
    n = 0.5 * (n_base[:-lag] + n_base[lag:])
    turn = rotation_vectors(Rb @ Ra.transpose(0, 2, 1))
    arm = (0.5 * (Ra @ ra + Rb @ rb))[:, :, 0]
    slide = (0.5 * (Ra + Rb) @ (rb - ra))[:, :, 0]
    V = T_base_probe[lag:, :3, 3] - T_base_probe[:-lag, :3, 3] + np.cross(turn, arm)
    return slide / np.linalg.norm(rb, axis=1) - np.cross(turn, n), V + slide
