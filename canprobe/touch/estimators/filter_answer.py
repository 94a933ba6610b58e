"""From the state of the online filter to an estimate at a contact."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array, inverted, inverted_upper, lower_root, upper_root
from canprobe.touch.anchor import Anchor, anchor
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.estimators.information import InformationFilter
from canprobe.touch.estimators.left_out import Expected
from canprobe.touch.evidence import curvature_covariance, evidence_of
from canprobe.touch.misfit import misfit_notes
from canprobe.touch.nonlinear import DIFFUSE, size_of
from canprobe.touch.quadric import UNIT
from canprobe.touch.rank import Decision, decide, nothing_observed


class _Answer(NamedTuple):
    """Where an answer is given and how sure it is.

    Attributes:
        anchor: at the contact.
        decision: on the data.
        spread: (2, 2) of the points in the tangent plane over the variance of their noise.
        deviation: (9, 9) root of the covariance of the filter's parameters.
        notes: what a reader should know.
    """

    anchor: Anchor
    decision: Decision
    spread: Array
    deviation: Array
    notes: tuple[str, ...]


def filter_answer(
    state: InformationFilter,
    point: Array,
    spread: Array,
    *,
    innovation: float,
    distance: float,
    samples: float,
    prior: str,
    notes: tuple[str, ...],
    expected: Expected | None,
) -> SurfaceEstimate:
    """The answer at the foot of a point.

    Args:
        state: of the filter.
        point: (3,) in base, m.
        spread: (3, 3) covariance of the points that the filter rests on over the variance of their noise.
        innovation, distance, samples, prior, notes: see `SurfaceEstimate`.
        expected: of the samples, to allow for what a quadric leaves out (`left_out`); None: the surface is one exactly.
    """
    found = _answered(state, point, spread, expected)
    a, decision = found.anchor, found.decision
    deviation = a.M @ found.deviation
    covariance = curvature_covariance(a.c, deviation)
    evidence = evidence_of(a.c, covariance, found.spread, state.length)
    if decision.rank < 3:
        known = decision.vectors[:, decision.passed]
        a.c[6:] = UNIT * (known @ (known.T @ (a.c[6:] / UNIT)))
        covariance = np.full((3, 3), math.nan)
    return build_estimate(
        Solution(a.c, covariance, decision, has_prior=False, root=inverted(deviation)),
        length=state.length,
        T_frame_contact=a.T_frame_contact,
        problem_root=state.root,
        innovation=innovation,
        distance=distance,
        samples=samples,
        method="recursive",
        prior=prior,
        notes=notes + found.notes,
        evidence=evidence,
    )


def _answered(state: InformationFilter, point: Array, spread: Array, expected: Expected | None) -> _Answer:
    """With the sandwich covariance, amended where all is observed."""
    place = state.place(point)
    a = anchor(state.c, state.T, place, state.length)
    tangent = a.T_frame_contact[:3, :2]
    flat = tangent.T @ spread @ tangent
    q = a.M[6:] @ state.inverse / UNIT[:, None]
    decision = decide(inverted_upper(upper_root(q.T)).T, flat, size_of(a.c))
    noise = state.inverse.T @ state.left_out.score.matrix[:9, :9] @ state.inverse
    notes: tuple[str, ...] = ()
    if decision.rank == 3 and expected is not None:
        amended = state.left_out.amend(state.c, state.inverse @ state.inverse.T, place, expected)
        notes = misfit_notes(amended.misfit, trusted=amended.trusted)
        if not amended.trusted:
            return _Answer(a, nothing_observed(), flat, np.eye(9) / DIFFUSE, notes)
        a = anchor(amended.c, state.T, place, state.length)
        noise += state.root @ amended.covariance @ state.root.T
    return _Answer(a, decision, flat, state.inverse @ lower_root(noise), notes)
