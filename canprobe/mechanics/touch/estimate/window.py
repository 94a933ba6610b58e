"""Estimators over a window of the last samples: `ml`, and the linear ones from differences, `chord` and `chen1996`.

The linear ones rest on `n_a − n_b = 2 S₃ (p_a − p_b)`, exact only where |∇f| is constant along the
surface: plane, sphere, circular cylinder. Elsewhere they keep a bias without any noise, and noise in the points, on
both sides of the equation, draws them towards 0. They are baselines and are reported as they are.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch.checks import whole
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.change import LAST_SAMPLES, MAX_AGREEING_RESIDUAL, looks_changed
from canprobe.mechanics.touch.estimate.differences import Pairs, pairs_of, solve_pairs, usable_lag
from canprobe.mechanics.touch.estimate.estimator import Estimator
from canprobe.mechanics.touch.estimate.gate import Dropped, Gate, MeasuredContact
from canprobe.mechanics.touch.estimate.likelihood import ContactBatch, batch_of, fit_ml, working_frame
from canprobe.mechanics.touch.estimate.noise import Correlation
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.types import Floats


class WindowEstimator(Estimator):
    """Base of the estimators that keep their last samples and solve them as a batch when asked.

    Args:
        sigma_point, sigma_normal: effective standard deviations of points and normals, m and rad; the methods of
            differences use them for covariance and flags only.
        window: number of samples that are kept.
        prior: prior of `ml`; None for `Prior.weak` over the extent of the window.
        coupling: coupling of the errors of point and normal (`Noise`) for `ml`, 1/m.
        correlation: correlation of the noise along the path, for `ml`.
    """

    least = 2
    """Least number of samples that give an answer."""

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
        self._kept: deque[tuple[ContactSample, MeasuredContact]] = deque(maxlen=kept)
        self._answer: SurfaceEstimate | None = None

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        if self._gate.passes(sample, self.dropped):
            self._kept.append((sample, self._gate.measured(sample, self._coupling)))
            self._answer = None

    def estimate(self) -> SurfaceEstimate | None:
        """The answer over the samples kept; None from fewer than `least`, or where they face more than 90° apart."""
        if self._answer is None and len(self._kept) >= self.least:
            touches = self._batch()
            if float((touches.normals @ touches.normals[-1]).min()) > 0.0:
                answer = self._solve(touches)
                self._answer = replace(answer, notes=answer.notes + self._gate.notes())
        return self._answer

    def reset(self) -> None:
        """Forget all samples."""
        self._kept.clear()
        self._gate.reset()
        self._answer = None

    def _solve(self, touches: ContactBatch) -> SurfaceEstimate:
        raise NotImplementedError

    def _batch(self) -> ContactBatch:
        return batch_of([touch for _, touch in self._kept], self._correlation)


class MlEstimator(WindowEstimator):
    """Nine-parameter Gauss–Newton over a window (`likelihood`): the reference, some milliseconds an answer.

    No quadric describes a window over a change of the surface, and its last samples would be taken for outliers. So
    they are compared with the fit first; where they disagree as after a change, earlier samples are forgotten.
    """

    def _solve(self, touches: ContactBatch) -> SurfaceEstimate:
        answer = fit_ml(touches, self._prior)
        squares = _squared_residuals(answer, touches)
        if len(squares) < 3 * LAST_SAMPLES or answer.rank < 3 or not looks_changed(squares):
            return answer
        agree = np.flatnonzero(squares <= MAX_AGREEING_RESIDUAL * float(np.median(squares)))
        for _ in range(min(int(agree[-1]) + 1, len(squares) - LAST_SAMPLES)):
            self._kept.popleft()
        answer = fit_ml(self._batch(), self._prior)
        return replace(answer, notes=(*answer.notes, "the surface changed: memory shortened"))


def _squared_residuals(answer: SurfaceEstimate, touches: ContactBatch) -> Floats:
    """(n,) squared distance of contacts from an answer's surface, χ² of 3 where the noise is as stated."""
    places = (touches.points - answer.point) @ answer.T_frame_contact[:3, :3]
    gradient = answer.surface.gradient(places)
    size = np.sqrt(np.einsum("ij,ij->i", gradient, gradient))
    tilt = gradient / size[:, None] - touches.normals @ answer.T_frame_contact[:3, :3]
    point, height = touches.noise.point_variance, touches.noise.height_variance
    turn = np.abs(answer.kappa).max() + touches.noise.coupling
    normal = touches.noise.normal_variance + turn**2 * point
    result: Floats = (answer.surface.value(places) / size) ** 2 / height + np.einsum("ij,ij->i", tilt, tilt) / normal
    return result


class ChordEstimator(WindowEstimator):
    """`n_i − n_0 = 2 S₃ (p_i − p_0)` over a window, p_0 the last sample."""

    def _solve(self, touches: ContactBatch) -> SurfaceEstimate:
        return solve_pairs(touches, pairs_of(touches), "chord")


class Chen1996Estimator(WindowEstimator):
    """The scheme of Chen, Rink and Zhang (1996), (24)–(35), with the rates of a robot and its pad.

    From a stretch of contact, in the contact frame of its last sample: `x_i = −S y_i` (27) with `x_i = ω × n_f + S_f
    v_f` (28), `y_i = V + v` (29), assembled to `A c = b` (30)–(34) with the boundary row. What is not in print:

    - S in (27)–(28) means 2S (of both bodies): as printed, (28) drops the factor 2 on S' and κ would be wrong by it.
    - All y_i4 are 0, so the columns of c14, c24, c34, c44 vanish: A has rank 7 at most, (35) is singular for every
      motion. Its solution of least norm is that of the six unknowns that are left (`solve_pairs`), in the gauge
      c14 = c24 = c44 = 0, c34 = −½.
    - Rates are differences of samples `lag` apart.

    Faults of the scheme that are reproduced: a bias of some percent where |∇f| is not constant, and noise in y that
    draws κ towards 0.

    Args:
        sigma_point, sigma_normal, window: as for `WindowEstimator`.
        lag: number of samples between the two of a difference. The paper has 1, with which the noise of the points is
            larger than the motion.

    Source: Chen, Rink and Zhang, "Local object shape from tactile sensing", section 4.1.2.
    """

    least = 3

    def __init__(self, *, sigma_point: float, sigma_normal: float, window: int, lag: int = 10) -> None:
        super().__init__(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window)
        self._lag = whole("lag", lag, 1, "sample")

    def _solve(self, touches: ContactBatch) -> SurfaceEstimate:
        T, r = (np.array([getattr(s, name) for s, _ in self._kept]) for name in ("T_base_probe", "r_probe"))
        lag = usable_lag(len(r), self._lag)
        newer = np.arange(lag, len(r))
        rates = paper_rates(T, r, touches.normals, lag)
        x, y = np.array(rates) @ working_frame(touches)[:3, :3]
        return solve_pairs(touches, Pairs(newer, newer - lag, y / touches.extent, -x), "chen1996")


def paper_rates(
    T_base_probe: Floats, r_probe: Floats, n_base: Floats, lag: int, object_twist: Floats | None = None
) -> tuple[Floats, Floats]:
    """x (28) and y (29), each (n − lag, 3), times the time between samples `lag` apart.

    `x = (ω_f − ω_o) × n_f + K_f v_f`, `y = V_f − V_o + v_f` (16)–(19), in base axes, all taken half-way between the
    samples; K_f = 1/|r_probe|. In the frame of the object ω_o and V_o are 0, and x and y are the same vectors.

    Args:
        T_base_probe: (n, 3 or 4, 4) poses of the probe, m.
        r_probe: (n, 3) contact points in its frame, m.
        n_base: (n, 3) outward unit normals of the object there.
        lag: number of samples between the two of a difference.
        object_twist: (6,) rotation, rad, and displacement of the object's point at the base's origin, m, in the time
            between those two; None: it stands still.
    """
    from scipy.spatial.transform import Rotation  # late: this estimator alone needs it

    R, r = T_base_probe[:, :3, :3], r_probe[:, :, None]
    Ra, Rb, ra, rb = R[:-lag], R[lag:], r[:-lag], r[lag:]
    n = 0.5 * (n_base[:-lag] + n_base[lag:])
    turn = Rotation.from_matrix(Rb @ Ra.transpose(0, 2, 1)).as_rotvec()
    arm = (0.5 * (Ra @ ra + Rb @ rb))[:, :, 0]
    slide = (0.5 * (Ra + Rb) @ (rb - ra))[:, :, 0]
    V = T_base_probe[lag:, :3, 3] - T_base_probe[:-lag, :3, 3] + np.cross(turn, arm)
    if object_twist is not None:
        contact = 0.5 * (T_base_probe[lag:, :3, 3] + T_base_probe[:-lag, :3, 3]) + arm
        V = V - object_twist[3:] - np.cross(object_twist[:3], contact)
        turn = turn - object_twist[:3]
    return slide / np.linalg.norm(rb, axis=1) - np.cross(turn, n), V + slide
