"""From the state of the online filter to an estimate at a contact."""

from __future__ import annotations

import math

import numpy as np

from canprobe.touch._arrays import Array, inverted, lower_root, solved, upper_root
from canprobe.touch.anchor import Anchor, anchor
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.estimators.information import InformationFilter
from canprobe.touch.evidence import evidence_of
from canprobe.touch.quadric import UNIT, curvature_jacobian
from canprobe.touch.rank import Decision, decide


def filter_estimate(
    state: InformationFilter,
    point: Array,
    spread: Array,
    *,
    innovation: float,
    distance: float,
    samples: float,
    prior: str,
    notes: tuple[str, ...],
) -> SurfaceEstimate:
    """The answer at the foot of a point.

    Args:
        state: of the filter.
        point: (3,) in base, m.
        spread: (3, 3) covariance of the points that the filter rests on over the variance of their noise.
        innovation, distance, samples, prior, notes: see `SurfaceEstimate`.
    """
    L = state.length
    a = anchor(state.c, state.T, state.place(point), L)
    tangent = a.T_frame_contact[:3, :2]
    size = 2.0 * math.sqrt(a.c[6] ** 2 + 2.0 * a.c[7] ** 2 + a.c[8] ** 2)
    q = a.M[6:] @ state.inverse / UNIT[:, None]
    flat = tangent.T @ spread @ tangent
    decision = decide(inverted(upper_root(q.T)).T, flat, size)
    noise = state.inverse.T @ state.score.matrix @ state.inverse
    noise_root = lower_root(noise)
    evidence = evidence_of(a.c, a.M @ state.inverse @ noise_root, flat, L)
    known = decision.vectors[:, decision.passed]
    a.c[6:] = UNIT * (known @ (known.T @ (a.c[6:] / UNIT)))
    singular = np.linalg.svd(state.root, compute_uv=False)
    return build_estimate(
        _solution(state, a, decision, noise_root),
        length=L,
        T_frame_contact=a.T_frame_contact,
        condition_number=float(singular[0] / singular[-1]),
        innovation=innovation,
        distance=distance,
        samples=samples,
        method="recursive",
        prior=prior,
        notes=notes,
        evidence=evidence,
    )


def _solution(state: InformationFilter, a: Anchor, decision: Decision, noise_root: Array) -> Solution:
    """With the sandwich covariance where all is observed."""
    root = solved(a.M.T, state.root.T).T
    if decision.rank < 3:
        return Solution(a.c, np.full((3, 3), math.nan), decision, has_prior=False, root=root)
    D = curvature_jacobian(a.c) @ a.M @ state.inverse @ noise_root
    return Solution(a.c, D @ D.T, decision, has_prior=False, root=solved(noise_root, root))
