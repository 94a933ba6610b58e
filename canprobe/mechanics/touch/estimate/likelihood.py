"""Maximum likelihood from points and normals: the checked arrays, the `ml` fit, and the Cramér–Rao bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import MAX_LENGTH, checked, instance
from canprobe.mechanics.touch.estimate.answer import (
    Solution,
    SurfaceEstimate,
    anchor,
    build_estimate,
    partial_covariance,
)
from canprobe.mechanics.touch.estimate.gate import MeasuredContact, noise_of, slow_errors
from canprobe.mechanics.touch.estimate.misfit import MENTIONED_PROBABILITY, correct, misfit_notes
from canprobe.mechanics.touch.estimate.noise import Correlation, Noise, SlowErrors, make_noise, mixed
from canprobe.mechanics.touch.estimate.nonlinear import DIFFUSE_INFORMATION, fit
from canprobe.mechanics.touch.estimate.observed import (
    curvature_covariance,
    decide,
    evidence_of,
    nothing_observed,
    spread_of,
)
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q_SQUARED, parameters_of
from canprobe.mechanics.touch.estimate.residuals import curvature_jacobian, design, linearise
from canprobe.mechanics.touch.linear_algebra import inverted, solved, upper_root
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

_MIN_EXTENT_SIGMAS = 20.0
"""Least extent of a path in standard deviations of a point: a shorter one is noise, and no unit of length."""
_MEAN_POINTS = 8
"""Most points in a mean of the path."""


class ContactBatch(NamedTuple):
    """Checked input of a batch fit.

    Attributes:
        points, normals: (n, 3) points, m, and outward unit normals; the answer is at the last row.
        noise: noise of the n samples.
        extent: largest distance from the last point, but at least `_MIN_EXTENT_SIGMAS` of noise, m: the unit of length
            of the problem.
        distance: length along the path, m.
        correlation: correlation of the noise along the path; None for independent samples.
        slow: errors that change as the contact moves over the pad; None: there are none.
    """

    points: Floats
    normals: Floats
    noise: Noise
    extent: float
    distance: float
    correlation: Correlation | None = None
    slow: SlowErrors | None = None

    def whitener(self) -> Floats | None:
        """(3, n, n) matrices that make the whitened samples independent; None where they are independent."""
        if self.correlation is None:
            return None
        return self.correlation.whitener(np.linspace(0.0, self.distance, len(self.points)), self.slow)


def make_touches(
    points: Floats,
    normals: Floats,
    noise: Noise,
    correlation: Correlation | None = None,
    slow: SlowErrors | None = None,
) -> ContactBatch:
    """A batch of arrays that are already checked, with its extent and length."""
    if correlation is not None:
        instance("correlation", correlation, Correlation)
    floor = _MIN_EXTENT_SIGMAS * math.sqrt(float(np.median(noise.point_variance)))
    offset = points - points[-1]
    extent = max(math.sqrt(float(np.einsum("ij,ij->i", offset, offset).max())), floor)
    return ContactBatch(points, normals, noise, extent, _travelled(points), correlation, slow)


def batch_of(touches: Sequence[MeasuredContact], correlation: Correlation | None) -> ContactBatch:
    """A batch of contacts; the answer is at the last."""
    points, normals = np.array([t.point for t in touches]), np.array([t.normal for t in touches])
    return make_touches(points, normals, noise_of(touches), correlation, slow_errors(touches))


def _travelled(points: Floats) -> float:
    """Length along noisy points (n, 3), m: along means of up to eight, as the noise of each would add up to a path."""
    each = min(_MEAN_POINTS, max(1, len(points) // 20))
    means = points[len(points) % each :].reshape(-1, each, 3).mean(axis=1)
    steps = np.diff(means, axis=0)
    share = (len(points) - 1) / max(len(points) - each, 1)  # the ends that the means cut off
    return share * float(np.sqrt(np.einsum("ij,ij->i", steps, steps)).sum())


def checked_arrays(points: ArrayLike, normals: ArrayLike, least: int) -> tuple[Floats, Floats]:
    """Points and unit normals (n, 3), n ≥ least; else a UsageError that names the field."""
    p, n = checked("points", points, (None, 3)), checked("normals", normals, (None, 3))
    if len(p) < least:
        raise UsageError(f"points: expected at least {least} samples, got {len(p)}")
    if float(np.abs(p).max()) > MAX_LENGTH:
        raise UsageError(f"points: expected coordinates up to {MAX_LENGTH:g}, got {np.abs(p).max():g}")
    if len(n) != len(p):
        raise UsageError(f"normals: expected one per point, shape ({len(p)}, 3), got {n.shape}")
    size = np.sqrt(np.einsum("ij,ij->i", n, n))
    worst = int(np.argmax(np.abs(size - 1.0)))
    if abs(size[worst] - 1.0) > 1e-6:
        raise UsageError(f"normals: expected unit vectors, got length {size[worst]:.9g} at index {worst}")
    if float((n @ n[-1]).min()) <= 0.0:
        raise UsageError("normals: expected all within 90° of the last (one side of a surface), got some beyond")
    return p, n


def working_frame(touches: ContactBatch) -> Floats:
    """T (4, 4) from the frame at the last measured point, z against its measured normal, to the frame of the points."""
    return homogeneous(tangent_rotation(-touches.normals[-1]), touches.points[-1])


def fit_ml(touches: ContactBatch, prior: Prior | None, quadric: bool = False) -> SurfaceEstimate:
    """The `ml` estimate (`nonlinear`) in the estimated contact frame of the last point.

    Args:
        touches: the samples.
        prior, quadric: as for `fit_surface`.
    """
    length = touches.extent
    stated = Prior.weak(length) if prior is None else instance("prior", prior, Prior)
    T = working_frame(touches)
    R = T[:3, :3]
    d = design((touches.points - T[:3, 3]) @ R / length, touches.normals @ R, touches.noise.scaled(length, R))
    independent = touches.whitener()
    prior_rows = stated.rows(length)
    result = fit(d, prior_rows, independent)
    problem_root = result.root
    notes: tuple[str, ...] = () if result.converged else ("the iteration did not settle",)
    if result.decision.rank > 0 and not quadric:
        root = result.root if result.decision.rank == 3 else result.free_root
        observed = result.decision.vectors[:, result.decision.passed]
        found, root = correct(result.c, root, d, independent, observed)
        trusted = found.trusted and (result.converged or found.misfit <= MENTIONED_PROBABILITY)
        notes += misfit_notes(found.misfit, trusted=trusted)
        if trusted:
            c = result.c + found.shift
            free = c if result.decision.rank == 3 else result.free + found.shift
            result = result._replace(c=c, root=root, free=free, free_root=root)
        else:
            c, root = result.c.copy(), upper_root(np.concatenate([prior_rows[0], DIFFUSE_INFORMATION * np.eye(9)]))
            c[3:] = 0.0
            c[[6, 8]] = 0.5 * stated.curvature * length
            result = result._replace(c=c, root=root, free=c, free_root=root, decision=nothing_observed())
    has_prior = math.isfinite(stated.sigma_curvature)
    a = anchor(result.c, T, (0.0, 0.0, 0.0), length)
    decision = result.decision.turned(a.turn)
    # evidence is that of the fit with nothing held, in the frame of that fit: a patch may know what is held here
    freed = anchor(result.free, T, (0.0, 0.0, 0.0), length)
    spread = None if has_prior else _turned_spread(spread_of(d.X, d.point_variance), freed.turn)
    covariance = curvature_covariance(freed.c, solved(result.free_root.T, freed.M.T).T)
    evidence = evidence_of(freed.c, covariance, spread, length)
    if decision.rank == 3 or has_prior:
        covariance = curvature_covariance(a.c, a.M @ inverted(result.root))
    else:
        decision = decision.with_covariance(TO_Q_SQUARED * covariance)
        covariance = np.full((3, 3), math.nan)
    if result.outliers:
        notes += (f"{result.outliers} samples with reduced weight",)
    return build_estimate(
        Solution(a.c, covariance, decision, has_prior, root=solved(a.M.T, result.root.T).T),
        length=length,
        T_frame_contact=a.T_frame_contact,
        problem_root=problem_root,
        innovation=result.innovation,
        distance=touches.distance,
        samples=float(len(touches.points)),
        method="ml",
        prior=stated.name,
        notes=notes,
        evidence=evidence,
    )


def _turned_spread(spread: Floats, angle: float) -> Floats:
    """A covariance (2, 2) in axes turned by an angle (rad)."""
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    result: Floats = R.T @ spread @ R
    return result


MAX_OFF_SURFACE_SIGMAS = 10.0
"""Largest distance of a point from the surface, in its standard deviations, at which it counts as on it."""


def cramer_rao(
    points: ArrayLike,
    normals: ArrayLike,
    S: SurfaceMatrix | ArrayLike,
    *,
    sigma_point: ArrayLike,
    sigma_normal: ArrayLike,
    prior: Prior | None = None,
    correlation: Correlation | None = None,
    coupling: float = 0.0,
) -> Floats:
    """Least covariance that an unbiased estimate of local curvature can have.

    Information `Σ JᵀJ` of the whitened residual rows at the true surface, plus the prior's, reduced to K by the delta
    method. Sorted principal curvatures are not differentiable at umbilics, so the bound is on the entries of K.

    Args:
        points: (n, 3) points on the true surface, or measured, m: not further off than `MAX_OFF_SURFACE_SIGMAS` times
            the noise; the bound is for the last row.
        normals: (n, 3) outward unit normals.
        S: (4, 4) matrix of the true surface in the frame of the points.
        sigma_point, sigma_normal, prior, correlation, coupling: as for `fit_surface`; the prior is that of the
            estimator.

    Returns:
        (3, 3) covariance of (K11, K12, K22), 1/m², in the contact frame of the last point,
        `SurfaceMatrix(S).contact_frame(foot of the last point)`; infinite where nothing is known.

    Raises:
        UsageError: a value is not usable; the message names the field, what was expected and what was got.

    Source: Kay, "Fundamentals of statistical signal processing: estimation theory", ch. 3.
    """
    p, n = checked_arrays(points, normals, 1)
    touches = make_touches(p, n, make_noise(len(p), sigma_point, sigma_normal, coupling), correlation)
    surface = S if isinstance(S, SurfaceMatrix) else SurfaceMatrix(checked("S", S, (4, 4)))
    gradient = surface.gradient(p)
    off = np.abs(surface.value(p)) / np.maximum(np.sqrt(np.einsum("ij,ij->i", gradient, gradient)), 1e-300)
    limit = MAX_OFF_SURFACE_SIGMAS * np.sqrt(touches.noise.point_variance) + 1e-9 * np.abs(p).max()  # and rounding
    worst = int(np.argmax(off / limit))
    if off[worst] > limit[worst]:
        raise UsageError(
            f"points: expected all on S, up to {limit[worst]:.3g} off ({MAX_OFF_SURFACE_SIGMAS:g} sigma_point), got "
            f"one {off[worst]:.3g} off at index {worst}; S is expected in the frame and unit of the points"
        )
    return osculating_bound(touches, surface, prior)


def osculating_bound(touches: ContactBatch, surface: SurfaceMatrix, prior: Prior | None = None) -> Floats:
    """As `cramer_rao`, for a quadric that need only osculate the surface at the last point."""
    p, n = touches.points, touches.normals
    origin = surface.project(p[-1])
    T = surface.contact_frame(origin)
    length, R = touches.extent, T[:3, :3]
    in_contact = surface.normalised_at(origin).transformed(T).S.copy()
    in_contact[:3, :3] *= length
    c = parameters_of(in_contact)
    d = design((p - origin) @ R / length, n @ R, touches.noise.scaled(length, R))
    J = linearise(c, d).jacobian()
    independent = touches.whitener()
    J = (J if independent is None else mixed(independent, J)).reshape(-1, 9)
    stated = Prior.weak(length) if prior is None else instance("prior", prior, Prior)
    root = upper_root(np.concatenate([J, stated.rows(length)[0]]))
    # a bound has no thresholds: spread for everything, and any σ passes; only what is rounding is left out (rule 3)
    wide = 1e30 * np.eye(2)
    decision = decide(root[6:, 6:] * C_PER_Q, wide, math.inf)
    known = decision.passed & (decision.information > 0.0)  # points in one place know nothing
    if not known.all():
        V = decision.vectors[:, known]
        hidden = 1.0 - np.einsum("ij,ij->i", V, V) > 1e-9
        return partial_covariance(V, decision.information[known], hidden) / length**2
    X = np.linalg.solve(root.T, curvature_jacobian(c).T)
    return X.T @ X / length**2
