"""`ml`: the batch maximum-likelihood fit over the last samples, as far back as one surface reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.batch import Touches, fit_ml
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.estimators.base import WindowEstimator
from canprobe.touch.estimators.change import AGREES, LAST_FEW, looks_changed
from canprobe.touch.prior import Prior

LEAST = 3 * LAST_FEW
"""Samples in a window from which on its last few are held against the others."""


class MlEstimator(WindowEstimator):
    """Nine-parameter Gauss–Newton over a window (`nonlinear`): the reference, some milliseconds an answer.

    A window over a change of the surface has no quadric, and its last samples would be taken for wrong ones. So they
    are held against the fit first; where they disagree as a changed surface does, what was before is forgotten.

    Args:
        sigma_point, sigma_normal: effective noise, m and rad.
        window: samples kept.
        prior: None for `Prior.weak` over the extent of the window.
        coupling: of the errors of point and normal (`Noise`), 1/m.
    """

    def __init__(
        self,
        *,
        sigma_point: float,
        sigma_normal: float,
        window: int,
        prior: Prior | None = None,
        coupling: float = 0.0,
    ) -> None:
        super().__init__(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window, coupling=coupling)
        self._prior = prior

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        answer = fit_ml(touches, self._prior)
        squares = squared_residuals(answer, touches)
        if len(squares) < LEAST or answer.rank < 3 or not looks_changed(squares):
            return answer
        agree = np.flatnonzero(squares <= AGREES * float(np.median(squares)))
        for _ in range(min(int(agree[-1]) + 1, len(squares) - LAST_FEW)):
            self._samples.popleft()
        answer = fit_ml(self._touches(), self._prior)
        return replace(answer, notes=(*answer.notes, "the surface changed: memory shortened"))


def squared_residuals(answer: SurfaceEstimate, touches: Touches) -> Array:
    """(n,) squared distance of contacts from an answer's surface, χ² of 3 where the noise is as stated."""
    R, origin = answer.T_frame_contact[:3, :3], answer.T_frame_contact[:3, 3]
    places = (touches.points - origin) @ R
    gradient = 2.0 * (places @ answer.S[:3, :3] + answer.S[:3, 3])
    size = np.sqrt(np.einsum("ij,ij->i", gradient, gradient))
    value = np.einsum("ij,ij->i", places, 0.5 * gradient + answer.S[:3, 3]) + answer.S[3, 3]
    tilt = gradient / size[:, None] - touches.normals @ R
    point = touches.noise.point_variance
    felt = np.abs(answer.kappa).max() + touches.noise.coupling
    normal = touches.noise.normal_variance + felt**2 * point
    result: Array = (value / size) ** 2 / point + np.einsum("ij,ij->i", tilt, tilt) / normal
    return result
