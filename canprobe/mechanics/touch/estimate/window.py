"""Estimators over a window of the last samples: `ml`, and the linear one from differences, `chord`.

The linear one, and `chen1996`, rest on `n_a − n_b = 2 S₃ (p_a − p_b)`, exact only where |∇f| is constant along the
surface: plane, sphere, circular cylinder. Elsewhere they keep a bias without any noise, and noise in the points, on
both sides of the equation, draws them towards 0. They are baselines and are reported as they are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.change import LAST_SAMPLES, MAX_AGREEING_RESIDUAL, looks_changed
from canprobe.mechanics.touch.estimate.differences import chord_pairs, solve_pairs
from canprobe.mechanics.touch.estimate.likelihood import ContactBatch, fit_ml, make_touches
from canprobe.mechanics.touch.estimate.noise import Correlation, Noise, SlowErrors
from canprobe.mechanics.touch.estimate.online import Dropped, Gate, PadWay
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.touch.linear_algebra import whole
from canprobe.mechanics.types import Floats


class WindowEstimator:
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
        self._rows: deque[Sequence[float]] = deque(maxlen=kept)
        self._pad = PadWay(sigma_point)
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

    def _solve(self, touches: ContactBatch) -> SurfaceEstimate:
        raise NotImplementedError

    def _row(self, sample: ContactSample) -> Sequence[float]:
        """The row that is kept of a sample: point, normal, their noise; a subclass adds what it needs."""
        sigmas = self._gate.sigmas(sample)
        return (*sample.p_base.tolist(), *sample.n_base.tolist(), *sigmas, *self._pad.step(sample, sigmas[0]))

    def _touches(self) -> ContactBatch:
        rows = np.array(self._rows)
        noise = Noise(rows[:, 6], rows[:, 8], self._coupling, height=rows[:, 7])
        slow = SlowErrors(rows[:, 9], rows[:, 10])
        return make_touches(rows[:, :3], rows[:, 3:6], noise, self._correlation, slow)


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
            self._rows.popleft()
        answer = fit_ml(self._touches(), self._prior)
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
        return solve_pairs(touches, chord_pairs(touches), "chord")
