"""Estimators of local shape by name, behind one interface."""

from __future__ import annotations

import difflib

from canprobe.errors import UsageError
from canprobe.touch.estimators.base import Dropped, Estimator
from canprobe.touch.noise import Correlation
from canprobe.touch.prior import Prior

METHODS = ("chen1996", "chord", "ml", "recursive")

__all__ = ["METHODS", "Dropped", "Estimator", "make_estimator"]


def make_estimator(
    method: str,
    *,
    sigma_point: float,
    sigma_normal: float,
    probe_radius: float,
    memory_m: float = 0.02,
    window: int = 160,
    prior: Prior | None = None,
    lag: int = 10,
    correlation: Correlation | None = None,
    coupling: float = 0.0,
) -> Estimator:
    """An online estimator.

    Args:
        method: one of `METHODS`.
        sigma_point: effective standard deviation of a contact point per axis, m. Along a path a real sensor's errors
            are correlated: give what independent samples at this density would have to have.
        sigma_normal: of a normal per tangent axis, rad.
        probe_radius: R_p, m; only checked, the samples carry their geometry.
        memory_m: path that `recursive` remembers (e-folding), m.
        window: samples that the batch methods keep; for `recursive` the samples on one memory at the nominal pace.
        prior: of `ml` and `recursive`; None for the weak default.
        correlation: of the noise along the path, `recursive` only; the deviations are then those of one sample.
        coupling: of the errors of point and normal, `ml` and `recursive` only: 1/R_p where both come from one centroid
            on the probe, 1/m; 0 for independent errors.
        lag: samples between the two of a difference, `chen1996` only.

    Raises:
        UsageError: on an unknown method or a value out of range.
    """
    if not probe_radius > 0.0:
        raise UsageError(f"probe_radius: expected a length above 0 m, got {probe_radius}")
    if method == "recursive":
        from canprobe.touch.estimators.recursive import RecursiveEstimator

        return RecursiveEstimator(
            sigma_point=sigma_point,
            sigma_normal=sigma_normal,
            memory_m=memory_m,
            window=window,
            prior=prior,
            correlation=correlation,
            coupling=coupling,
        )
    if method == "ml":
        from canprobe.touch.estimators.ml import MlEstimator

        return MlEstimator(
            sigma_point=sigma_point, sigma_normal=sigma_normal, window=window, prior=prior, coupling=coupling
        )
    if method == "chord":
        from canprobe.touch.estimators.chord import ChordEstimator

        return ChordEstimator(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window)
    if method == "chen1996":
        from canprobe.touch.estimators.chen1996 import Chen1996Estimator

        return Chen1996Estimator(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window, lag=lag)
    raise unknown_method(method)


def unknown_method(method: str) -> UsageError:
    """The error for a name that is no method, with the nearest one."""
    near = difflib.get_close_matches(str(method), METHODS, n=1)
    hint = f'; did you mean "{near[0]}"?' if near else ""
    return UsageError(f"method: expected one of {', '.join(METHODS)}, got {method!r}{hint}")
