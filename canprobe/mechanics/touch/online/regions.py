"""The covariance of an answer: how a stage changes it, and what widens a region.

Covariance, information, root and evidence of an answer say one thing; they are changed together, and only here. What a
region of curvature holds, in the order in which it comes in:

1. Noise of points and normals as contacts state it, wider for images in doubt and for the time of a moving probe
   (`estimate.gate`), correlated along the path, heights and normals, and over the pad: `estimate.sandwich`
   (`recursive`), `Correlation.whitener` (`ml`). Source: Huber, "The behavior of maximum likelihood estimates under
   nonstandard conditions", 1967.
2. The terms that a quadric leaves out: `estimate.misfit`, `estimate.omitted_terms`. Source: Hoeting, Madigan, Raftery
   and Volinsky, "Bayesian model averaging: a tutorial", 1999.
3. Errors of c13, c23, c33, as far as a plane is refuted: `estimate.observed.curvature_covariance`. Source: Judge
   and Bock, 1978.
4. The patch narrows it by its own information, which knows the errors of the calibration, how arrays of a make differ,
   a mean that belongs to an earlier place, and traces of creep (`patch_curvature`); χ² of both, where motion and patch
   disagree, widens it: `patch_fusion`.
5. The level of the innovations, a factor: `noise_level`. Source: Birge, Phys. Rev. 40, 1932.
6. Lag of the answer behind slow changes of curvature and quick ones, scale, error of the tool, drag of the pad, each
   an error that is added: `systematic_errors`.
7. A force above those of the calibration and a speed above those of the settings, a factor: `beyond`.
8. Ground that was touched before narrows it, less where the curvature changes there: `map_fusion`.
9. An array that is not as its calibration says, a factor: `FOREIGN_ARRAY_FACTOR`, once `CalibrationCheck` has found it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate, is_umbilic
from canprobe.mechanics.touch.estimate.observed import CurvatureInformation
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q
from canprobe.mechanics.types import Floats

FOREIGN_ARRAY_FACTOR = 2.0
"""Factor of the standard deviations of curvature of an array that is not as its calibration says, from a development
draw of study `regions`."""


def scaled(answer: SurfaceEstimate, factor: float) -> SurfaceEstimate:
    """An answer whose standard deviations of curvature are `factor` times as large."""
    if factor == 1.0:
        return answer
    f, evidence, root = factor, answer.evidence, answer.model_root
    covariance = answer.covariance * f**2
    return replace(
        answer,
        covariance=covariance,
        information=answer.information / f**2,
        model_root=None if root is None else root / f,
        evidence=None if evidence is None else CurvatureInformation(evidence.q, evidence.information / f**2),
        umbilic=is_umbilic(answer.K, covariance) if answer.rank == 3 else answer.umbilic,
    )


def with_errors(answer: SurfaceEstimate, *errors: Floats) -> SurfaceEstimate:
    """A fully observed answer with additional errors of curvature.

    Args:
        answer: the answer.
        errors: tensors (3, 3), 1/m; each is an error, times an independent standard normal variate.
    """
    P = answer.T_frame_contact[:3, :2]
    covariance, information, root = answer.covariance, answer.information, answer.model_root
    for error in errors:
        (k11, k12), (_, k22) = P.T.dot(error).dot(P).tolist()
        entries = np.array([k11, k12, k22])
        covariance = covariance + entries[:, None] * entries
        if root is not None:
            root = _with_error(root, 0.5 * entries)
        of_q = TO_Q * entries
        seen = information.dot(of_q)
        information = information - seen[:, None] * seen / (1.0 + float(of_q.dot(seen)))
    return replace(
        answer,
        covariance=covariance,
        information=information,
        model_root=root,
        umbilic=is_umbilic(answer.K, covariance),
    )


def with_information(root: Floats | None, root_q: Floats) -> Floats | None:
    """A root (n, 9) of a model (None: not known) with that (3, 3) of more information about q = (K11, √2 K12, K22)."""
    if root is None:
        return None
    rows = np.zeros((3, 9))
    rows[:, 6:] = root_q / C_PER_Q
    return np.concatenate([root, rows])


def _with_error(root: Floats, error: Floats) -> Floats:
    """A root (n, k) of an information after the last parameters got one more error (3,) times a normal variate."""
    u = root[:, -len(error) :].dot(error)
    square = float(u.dot(u))
    if square == 0.0:
        return root
    # (I − share u uᵀ)² = (I + u uᵀ)⁻¹: the formula of Sherman and Morrison on the root, without a decomposition
    share = (1.0 - 1.0 / math.sqrt(1.0 + square)) / square
    result: Floats = root - (share * u)[:, None] * u.dot(root)
    return result
