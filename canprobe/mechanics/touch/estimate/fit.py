"""`fit_surface`: local shape from points and normals of one stretch of contact; and the online estimators by name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError, did_you_mean
from canprobe.mechanics.touch.checks import whole
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.differences import pairs_of, solve_pairs, usable_lag
from canprobe.mechanics.touch.estimate.estimator import Estimator
from canprobe.mechanics.touch.estimate.likelihood import ContactBatch, checked_arrays, fit_ml, make_touches
from canprobe.mechanics.touch.estimate.noise import Correlation, make_noise
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.touch.estimate.recursive import RecursiveEstimator
from canprobe.mechanics.touch.estimate.window import Chen1996Estimator, ChordEstimator, MlEstimator

METHODS = ("chen1996", "chord", "ml", "recursive")
"""Names of the methods."""
EXTENT_SCALE = 2.0
"""Longest memory over the extent of the points: a weave or a circle has seen all directions by then."""


def make_estimator(
    method: str,
    *,
    sigma_point: float,
    sigma_normal: float,
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
        sigma_point: effective standard deviation of a contact point per axis, m.
        sigma_normal: effective standard deviation of a normal per tangent axis, rad.
        memory_m: path that `recursive` remembers (e-folding), m.
        window: number of samples that the batch methods keep; for `recursive` the number on one memory at the nominal
            speed.
        prior, lag, correlation, coupling: as for `fit_surface`.

    Raises:
        UsageError: the method is unknown, or a value is out of range.
    """
    of_all: dict[str, Any] = {"sigma_point": sigma_point, "sigma_normal": sigma_normal, "window": window}
    of_models: dict[str, Any] = {"prior": prior, "coupling": coupling, "correlation": correlation}
    if method == "recursive":
        return RecursiveEstimator(**of_all, **of_models, memory_m=memory_m)
    if method == "ml":
        return MlEstimator(**of_all, **of_models)
    if method == "chord":
        return ChordEstimator(**of_all)
    if method == "chen1996":
        return Chen1996Estimator(**of_all, lag=lag)
    raise unknown_method(method)


def unknown_method(method: str) -> UsageError:
    """The error for an unknown method, with the nearest name."""
    hint = did_you_mean(str(method), METHODS)
    return UsageError(f"method: expected one of {', '.join(METHODS)}, got {method!r}{hint}")


def fit_surface(
    points: ArrayLike,
    normals: ArrayLike,
    *,
    sigma_point: ArrayLike,
    sigma_normal: ArrayLike,
    method: str = "ml",
    prior: Prior | None = None,
    lag: int = 10,
    correlation: Correlation | None = None,
    coupling: float = 0.0,
    quadric: bool = False,
) -> SurfaceEstimate:
    """Local shape at the last of a series of contact points.

    Lengths may be in any unit, as long as all are in the same; the answer is in that unit too.

    Args:
        points: (n, 3) contact points on the object in one frame, in the order of time; the answer is at the last row.
        normals: (n, 3) outward unit normals of the object there.
        sigma_point: standard deviation of a point per axis: a number, (n,), or covariances (3, 3) or (n, 3, 3).
        sigma_normal: standard deviation of a normal per tangent axis, rad, in the same forms (of a covariance only the
            tangential part counts).
        method: "ml" (reaches the Cramér–Rao bound), "recursive" (the online filter run over the points; it remembers
            all of a short path, of a longer one at most twice the points' extent and the surface's radius), "chord",
            or "chen1996". The last has no robot here: its rates are differences of points and normals `lag` apart,
            (16) with the object at rest.
        prior: prior of "ml" and "recursive"; None for `Prior.weak` over the path, which says nothing of curvature.
        lag: number of samples between the two of a difference of "chen1996".
        correlation: correlation of the noise along the path; "ml" weighs the samples by it, the covariance of
            "recursive" grows by it; None for independent samples.
        coupling: coupling of the errors of a point and its normal (`Noise`), for "ml" and "recursive": 1/R_p where both
            come from one centroid on a spherical probe; 0 for independent errors.
        quadric: whether the surface is known to be a quadric, for "ml" and "recursive". Otherwise cubic and quartic
            terms are corrected where they show, and enter the covariance where noise could hide them (`misfit`).

    Returns:
        The estimate; what the points did not observe is marked as unobserved, not guessed.

    Raises:
        UsageError: a value is not usable; the message names the field, what was expected and what was got.

    Example:
        >>> import numpy as np
        >>> from canprobe import fit_surface
        >>> a = np.linspace(-0.2, 0.0, 40)
        >>> n = np.stack([np.sin(a), 0.3 * np.sin(20 * a), -np.cos(a)], axis=1)
        >>> n /= np.linalg.norm(n, axis=1, keepdims=True)
        >>> estimate = fit_surface(0.05 * n, n, sigma_point=2e-5, sigma_normal=1e-3)
        >>> estimate.kappa.round(1).tolist()
        [20.0, 20.0]
    """
    p, n = checked_arrays(points, normals, 3 if method == "chen1996" else 2)
    touches = make_touches(p, n, make_noise(len(p), sigma_point, sigma_normal, coupling), correlation)
    if method in ("ml", "recursive"):
        fitted = fit_ml if method == "ml" else _run_filter
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite has no root
                return fitted(touches, prior, quadric)
        except (np.linalg.LinAlgError, OverflowError) as error:
            raise UsageError(
                f"sigma_point, sigma_normal: expected those of real noise, got {sigma_point!r} and {sigma_normal!r}, "
                f"with which the equations cannot be solved in double precision: {error}"
            ) from error
    if correlation is not None:
        raise UsageError(f"correlation: expected none for {method!r}, which has no noise model, got {correlation}")
    if method == "chord":
        return solve_pairs(touches, pairs_of(touches), "chord")
    if method == "chen1996":
        apart = usable_lag(len(p), whole("lag", lag, 1, "sample"))
        return solve_pairs(touches, pairs_of(touches, apart), "chen1996")
    raise unknown_method(method)


def _run_filter(touches: ContactBatch, prior: Prior | None, quadric: bool) -> SurfaceEstimate:
    """The answer of `recursive` after samples of which only place and normal are known."""
    # why the larger of both below: at rest the distance is next to 0, while the extent has a floor (`make_touches`)
    memory = _memory_of(touches)
    point, height = (np.sqrt(variance) for variance in touches.noise.tangential_and_height(touches.normals))
    normal = np.sqrt(touches.noise.normal_variance)
    estimator = RecursiveEstimator(
        sigma_point=math.sqrt(float(np.mean(point**2))),
        sigma_normal=math.sqrt(float(np.mean(normal**2))),
        memory_m=memory,
        window=max(1, round(len(point) * memory / max(touches.distance, touches.extent))),
        prior=prior,
        correlation=touches.correlation,
        coupling=touches.noise.coupling,
        quadric=quadric,
    )
    nowhere = np.eye(4)
    rows = zip(touches.points, touches.normals, point.tolist(), normal.tolist(), height.tolist(), strict=True)
    # no probe is known: every contact is at one place of a pad that never turns; any time that grows will do
    for i, (p, n, s, r, h) in enumerate(rows):
        estimator.add(ContactSample(float(i), p, n, nowhere, nowhere[:3, 2], 0.0, s, r, sigma_height=h))
    answer = estimator.estimate()
    if answer is None:
        raise UsageError(
            f"points: expected a path that moves beyond its noise for 'recursive', got {touches.distance:.3g} in all "
            f"with sigma_point {math.sqrt(float(np.mean(point**2))):.3g}"
        )
    return answer


def _memory_of(touches: ContactBatch) -> float:
    """Path that `recursive` remembers, m: all of a short one; of a longer one as much as extent and radius allow."""
    # why not always the whole path: the filter's unit of length, its steps and its prior are shares of the memory, and
    # on a long path over a small patch the steps would be larger than the patch
    off, turned = touches.points - touches.points[-1], touches.normals - touches.normals[-1]
    square = float(np.square(turned).sum())
    radius = math.sqrt(float(np.square(off).sum()) / square) if square > 0.0 else math.inf  # exact on a sphere
    return min(max(touches.distance, touches.extent), EXTENT_SCALE * touches.extent, max(radius, 0.5 * touches.extent))
