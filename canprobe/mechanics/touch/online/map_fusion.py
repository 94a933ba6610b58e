"""Answers joined with what the map knows of the ground from earlier passes.

Contacts that are further back along the path than `MEMORIES_BETWEEN` memories of the estimator go into a map of their
own: what it says shares no data with the answer. At every answer one quartic is fitted to the nodes round the contact.
Where it observes all curvature and does not contradict the answer (95 %), both are added as information. The map holds
a change of curvature for smoother than it is, so the change that its quartic shows within `BLUR_M` counts as an error:
where the curvature jumps the map has hardly any weight. Place and normal stay those of the estimator, which has the
newest contacts. The cost of an answer does not grow with the scan: it takes the nodes within 12 mm.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import Solution, SurfaceEstimate, with_solution
from canprobe.mechanics.touch.estimate.noise import CHI2_95
from canprobe.mechanics.touch.estimate.observed import Decision
from canprobe.mechanics.touch.estimate.path_length import PathLength
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q, TO_Q_SQUARED, parameters_of
from canprobe.mechanics.touch.linear_algebra import eigen, inverted, solved
from canprobe.mechanics.touch.map.cells import observed_of, robust
from canprobe.mechanics.touch.map.discs import Discs
from canprobe.mechanics.touch.map.local_fits import fit_discs
from canprobe.mechanics.touch.map.nodes import step_of
from canprobe.mechanics.touch.map.quartic import LENGTH_M, SECOND, THIRD
from canprobe.mechanics.touch.map.surface_map import REACH_M, SurfaceMap
from canprobe.mechanics.touch.online.estimator import AnswerStage
from canprobe.mechanics.touch.online.regions import with_information
from canprobe.mechanics.types import Floats

MEMORIES_BETWEEN = 2.0
"""Path between a contact of the map and the answer, in memories of the estimator: they share 13 % of their data."""
BLUR_M = 2e-3
"""Distance within which a change of curvature counts as an error, m. The value was set on the development shapes of
`study shapes`: 0 states too little on a fillet, 3 mm gives away what free forms gain."""
MAX_WAITING = 10_000
"""Most contacts that wait to become ground: a contact at rest adds none beyond 50 s of an array of 200 Hz."""
MAX_EXCESS = 1.0
"""Largest χ² per degree of freedom above 1 of the contacts of a map that is believed."""
JOINED_NOTE = "of the curvature from ground that was touched before"
MIN_NODES = 4
"""Least number of nodes of a quartic."""
# z of the map points outward, that of a contact inward: with the same x, y turns round and K12 changes its sign
_OUTWARD, _MIRRORED = np.array([1.0, -1.0, -1.0]), np.array([1.0, -1.0, 1.0])


class KnownCurvature(NamedTuple):
    """Curvature q = (K11, √2 K12, K22) in a contact frame, 1/m, and its covariance (3, 3)."""

    q: Floats
    covariance: Floats


class MapFusion(AnswerStage):
    """Joins answers with the map of the ground that the contact comes back to.

    Args:
        surface_map: an empty map for the contacts of the estimator's pad.
        memory_m: path that the motion remembers, m.
    """

    is_step = True

    def __init__(self, surface_map: SurfaceMap, memory_m: float) -> None:
        self._map = surface_map
        self._between = MEMORIES_BETWEEN * memory_m
        self._waiting: deque[tuple[float, ContactSample]] = deque()
        self._path_length = PathLength(step_of(surface_map.noise.lateral))

    def take(self, sample: ContactSample) -> None:
        self._path_length.add(sample.p_base)
        # why no deque with a maxlen: it would drop the oldest contacts, which become ground next
        if len(self._waiting) < MAX_WAITING:
            self._waiting.append((self._path_length.total, sample))

    def reset(self) -> None:
        """Forget everything but the settings and the ground."""
        self._learn(math.inf)  # the estimator has forgotten all of them, too

    def refine(self, answer: SurfaceEstimate | None, sample: ContactSample) -> SurfaceEstimate | None:
        self._learn(self._path_length.total - self._between)
        if answer is None or not answer.rank:  # what was withdrawn stays so
            return answer
        known = ground_at(self._map, answer)
        return answer if known is None else joined(answer, known)

    def _learn(self, until: float) -> None:
        """Put the contacts before a path (m) into the map."""
        old = []
        while self._waiting and self._waiting[0][0] < until:
            old.append(self._waiting.popleft()[1])
        self._map.add_samples(old)


def ground_at(surface_map: SurfaceMap, answer: SurfaceEstimate) -> KnownCurvature | None:
    """What a map says of the curvature at an answer, in its contact frame; None where it did not observe all of it."""
    rows, pad = surface_map.nodes.near(answer.point), surface_map.pad
    points = surface_map.nodes.points_of(rows)
    if len(rows) < MIN_NODES or not np.linalg.norm(points - answer.point, axis=1).min() < REACH_M:
        return None
    R = answer.T_frame_contact[:3, :3] * _OUTWARD  # the same x axis, z outward
    disc = Discs.at(answer.point, R, points, rows)
    if pad is not None and answer.stiffness is not None:
        pad = pad._replace(stiffness=answer.stiffness)
    K_ref = (R[:, :2].T @ answer.curvature_tensor_base() @ R[:, :2])[None]
    fits, _, chi2 = fit_discs(rows, disc, pad, surface_map.noise, K_ref=K_ref, weight=disc.weight)
    weight = robust(disc.weight, chi2)
    fits, _, _ = fit_discs(rows, disc, pad, surface_map.noise, K_ref=fits.K, weight=weight)
    covariance = fits.covariance(fits.excess)
    if observed_of(fits, covariance)[1][0] < 3 or fits.excess[0] > MAX_EXCESS:
        return None
    xxx, xxy, xyy, yyy = (fits.a[0, THIRD] / LENGTH_M**2).tolist()
    change2 = xxx**2 + 3.0 * (xxy**2 + xyy**2) + yyy**2  # of the tensor along both axes
    turn = TO_Q * _MIRRORED / LENGTH_M
    V = covariance[0, SECOND, SECOND] * np.outer(turn, turn)
    # the square of the change is shared out evenly to the three entries of q
    return KnownCurvature(-turn * fits.a[0, SECOND], V + BLUR_M**2 * change2 / 3.0 * np.eye(3))


def joined(answer: SurfaceEstimate, known: KnownCurvature) -> SurfaceEstimate:
    """An answer and the map's curvature as one; the answer alone where they contradict each other."""
    C, q = answer.combinations, parameters_of(answer.S)[6:] / C_PER_Q
    V = C @ (answer.covariance * TO_Q_SQUARED) @ C.T if answer.rank == 3 else inverted(C @ answer.information @ C.T)
    apart = C @ (known.q - q)
    if float(apart @ solved(V + C @ known.covariance @ C.T, apart)) > CHI2_95:
        return answer
    own, ground = C.T @ inverted(V) @ C, inverted(known.covariance)
    covariance = inverted(own + ground)
    values, vectors = eigen(own + ground)
    c = parameters_of(answer.S)
    c[6:] = C_PER_Q * (covariance @ (own @ q + ground @ known.q))
    root = with_information(answer.model_root, np.asarray(np.linalg.cholesky(ground).T, np.float64))
    share = float((covariance * ground).sum()) / 3.0
    return with_solution(
        answer,
        Solution(c, covariance / TO_Q_SQUARED, Decision(values, vectors, np.ones(3, bool)), False, root),
        notes=(*answer.notes, f"{100.0 * share:.0f} % {JOINED_NOTE}"),
    )
