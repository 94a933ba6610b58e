"""`ml`: the batch maximum-likelihood fit over the last samples."""

from __future__ import annotations

from canprobe.touch.batch import Touches, fit_ml
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.estimators.base import WindowEstimator
from canprobe.touch.prior import Prior


class MlEstimator(WindowEstimator):
    """Nine-parameter Gauss–Newton over a window (`nonlinear`): the reference, some milliseconds an answer.

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
        return fit_ml(touches, self._prior)
