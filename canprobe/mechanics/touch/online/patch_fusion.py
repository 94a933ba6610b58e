"""The contact patch as a second sensor of the motion: one answer of both."""

from __future__ import annotations

import math

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import Solution, SurfaceEstimate, build_estimate, with_solution
from canprobe.mechanics.touch.estimate.noise import CHI2_95
from canprobe.mechanics.touch.estimate.observed import SIGMA_LIMIT, Decision, nothing_observed
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q_SQUARED, matrix_of, parameters_of
from canprobe.mechanics.touch.linear_algebra import eigen, inverted
from canprobe.mechanics.touch.online.estimator import AnswerPath, AnswerStage
from canprobe.mechanics.touch.online.patch_curvature import Fused, PatchCurvature
from canprobe.mechanics.touch.online.regions import with_information
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

MIN_NAMED_SHARE = 0.1
"""Least share of the patch in the information about K at which the estimate's method names it."""
_TO_K = 1.0 / TO_Q_SQUARED


class PatchFusion(AnswerStage):
    """Completes the answers of the motion by the patch (`with_patch`); before the contact moves, the patch's alone.

    Args:
        patch: estimator from images.
        length: memory of the motion, m.
    """

    is_step = True

    def __init__(self, patch: PatchCurvature, length: float) -> None:
        self.patch = patch
        self._length = length
        self._path = AnswerPath()

    def take(self, sample: ContactSample) -> None:
        self.patch.add(sample)

    def refine(self, answer: SurfaceEstimate | None, sample: ContactSample) -> SurfaceEstimate | None:
        if answer is None:
            return patch_estimate(sample, self.patch, self._length)
        if answer.evidence is None:
            return answer
        found = self.patch.fuse(answer.T_frame_contact, answer.evidence)
        moved = self._path.step(answer)
        if found is None:
            return answer
        if not found.contradicted:
            new = min(moved / self._length, 1.0)
            self.patch.stiffness.take(found.log_stiffness, found.stiffness_information, new)
        return with_patch(answer, found, self._length, self.patch.stiffness.value)

    def reset(self) -> None:
        self.patch.reset()
        self._path = AnswerPath()


def with_patch(motion: SurfaceEstimate, found: Fused, length: float, stiffness: float) -> SurfaceEstimate:
    """A motion estimate, with its curvature replaced by that of motion and patch together.

    Where the two contradict each other nothing is observed.

    Place, normal and c13, c23, c33 stay the motion's; the patch says nothing about them. The `method` ends in "+patch"
    where the patch gave at least `MIN_NAMED_SHARE`; a note gives its share.

    Args:
        motion: the estimate, with its `evidence`.
        found: the curvature of both (`PatchCurvature.fuse`).
        length: memory of the estimator, m; curvatures below its inverse count as flat.
        stiffness: stiffness K/h of the layer, N/m³, that the answer states.
    """
    assert motion.evidence is not None
    weight = CHI2_95 / max(found.cost, CHI2_95)
    evidence, patch = weight * motion.evidence.information, weight * found.patch
    has_prior = motion.rank < 3 and bool(np.isfinite(motion.covariance).all())
    data = weight * motion.information if has_prior else evidence
    decision = nothing_observed() if found.contradicted else _decide(data + patch, found.q, length)
    root = None if motion.model_root is None else math.sqrt(weight) * motion.model_root
    root = with_information(root, _root(patch))
    inverse = inverted(evidence + patch)
    share = float((inverse * patch).sum()) / 3.0
    notes = [f"{100.0 * share:.0f} % of the curvature from the patch"]
    if found.contradicted:
        notes.append("the patch contradicts the motion")
    return with_solution(
        motion,
        _solution(motion.S, found.q, inverse, decision, has_prior=has_prior, root=root),
        method=motion.method + "+patch" if share >= MIN_NAMED_SHARE else motion.method,
        notes=(*motion.notes, *notes),
        evidence=None,
        stiffness=stiffness,
        contradicted=found.contradicted,
    )


def patch_estimate(contact: ContactSample, patch: PatchCurvature, length: float) -> SurfaceEstimate | None:
    """Shape from the patch alone at a contact that has not moved; None where the patch gives none.

    `length` is the memory of the estimator, m, as for `with_patch`.
    """
    T = homogeneous(tangent_rotation(-contact.n_base), contact.p_base)
    found = patch.fuse(T)
    if found is None:
        return None
    return build_estimate(
        _solution(matrix_of(np.zeros(9)), found.q, inverted(found.patch), _decide(found.patch, found.q, length)),
        length=1.0,
        T_frame_contact=T,
        problem_root=_root(found.patch),
        innovation=1.0,
        distance=0.0,
        samples=float(patch.frames),
        method="patch",
        prior="none",
        stiffness=patch.stiffness.value,
    )


def _root(information: Floats) -> Floats:
    """(3, 3) root of the patch's information, which may be singular."""
    values, vectors = eigen(information)
    result: Floats = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return result


def _decide(information: Floats, q: Floats, length: float) -> Decision:
    """Rank decision by rule 2 of `observed` alone: rule 1, the spread of the points, is about motion."""
    values, vectors = eigen(information)
    size = max(math.sqrt(float(q @ q)), 1.0 / length)
    return Decision(np.maximum(values, 0.0), vectors, values >= 1.0 / (SIGMA_LIMIT * size) ** 2)


def _solution(
    S: Floats, q: Floats, covariance: Floats, decision: Decision, *, has_prior: bool = False, root: Floats | None = None
) -> Solution:
    """A solution with the place and the other entries of S (4, 4), and with q and its covariance (3, 3)."""
    c = parameters_of(S)
    if has_prior or decision.rank == 3:
        c[6:] = C_PER_Q * q
        return Solution(c, covariance * _TO_K, decision, has_prior, root)
    V = decision.vectors[:, decision.passed]
    c[6:] = C_PER_Q * (V @ (V.T @ q))
    return Solution(c, np.full((3, 3), math.nan), decision, has_prior, root)
