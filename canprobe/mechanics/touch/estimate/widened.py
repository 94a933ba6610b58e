"""An answer with wider or narrower regions and the same shape: of an array that is not as its calibration says."""

from __future__ import annotations

from dataclasses import replace

from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate, is_umbilic
from canprobe.mechanics.touch.estimate.known_curvature import CurvatureInformation

REGION_FACTOR = 2.0
"""Factor of the standard deviations of curvature, from a development draw of study `regions`."""


def widened(answer: SurfaceEstimate, factor: float = REGION_FACTOR) -> SurfaceEstimate:
    """An answer whose standard deviations of curvature are `factor` times as large."""
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
