"""The Cramér–Rao bound on local curvature."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from canprobe.touch._arrays import Array, checked, upper_root
from canprobe.touch.batch import checked_arrays, make_touches
from canprobe.touch.noise import Correlation, make_noise, mixed
from canprobe.touch.prior import Prior
from canprobe.touch.quadric import UNIT, curvature_jacobian, design, parameters_of, rows
from canprobe.touch.rank import decide
from canprobe.touch.surface import SurfaceMatrix


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
) -> Array:
    """Least covariance that an unbiased estimate of local curvature can have.

    Information `Σ JᵀJ` of the whitened residual rows at the true surface, plus the prior's, reduced to K by the delta
    method. Sorted principal curvatures are not differentiable at umbilics, so the bound is on the entries of K.

    Args:
        points: (n, 3) m, on the true surface (or measured); the last row is now.
        normals: (n, 3) outward unit normals.
        S: (4, 4) the true surface in the frame of the points.
        sigma_point, sigma_normal: noise as for `fit_surface`.
        prior: the same prior as the estimator's; None for the same default.
        correlation: of the noise along the path; None for independent samples.
        coupling: of the errors of point and normal, as for `fit_surface`.

    Returns:
        (3, 3) covariance of (K11, K12, K22), 1/m², in the contact frame of the last point,
        `SurfaceMatrix(S).contact_frame(foot of the last point)`; infinite where nothing is known.

    Raises:
        UsageError: naming the field, what was expected and what was got.

    Source: Kay, "Fundamentals of statistical signal processing: estimation theory", ch. 3.
    """
    p, n = checked_arrays(points, normals, 1)
    touches = make_touches(p, n, make_noise(len(p), sigma_point, sigma_normal, coupling), correlation)
    surface = S if isinstance(S, SurfaceMatrix) else SurfaceMatrix(checked("S", S, (4, 4)))
    origin = surface.project(p[-1])
    T = surface.contact_frame(origin)
    length, R = touches.extent, T[:3, :3]
    in_contact = surface.normalised_at(origin).transformed(T).S.copy()
    in_contact[:3, :3] *= length
    c = parameters_of(in_contact)
    d = design((p - origin) @ R / length, n @ R, touches.noise.scaled(length, R))
    J = rows(c, d).J
    independent = touches.whitener()
    J = (J if independent is None else mixed(independent, J)).reshape(-1, 9)
    stated = Prior.weak(length) if prior is None else prior
    root = upper_root(np.concatenate([J, stated.rows(length)[0]]))
    wide = 1e30 * np.eye(2)
    decision = decide(root[6:, 6:] * UNIT, wide, math.inf)
    known = decision.passed & (decision.information > 0.0)  # points in one place know nothing
    if not known.all():
        return _open_covariance(decision.vectors[:, known], decision.information[known], length)
    X = np.linalg.solve(root.T, curvature_jacobian(c).T)
    result: Array = X.T @ X / length**2
    return result


def _open_covariance(V: Array, information: Array, length: float) -> Array:
    """Covariance where some combinations of K are not observed at all: infinite and NaN in what they touch."""
    to_q = np.array([1.0, math.sqrt(2.0), 1.0])
    C: Array = (V / information) @ V.T / np.outer(to_q, to_q) / length**2
    for i in np.flatnonzero(1.0 - np.einsum("ij,ij->i", V, V) > 1e-9):
        C[i, :] = C[:, i] = math.nan
        C[i, i] = math.inf
    return C
