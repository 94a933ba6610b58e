"""The answer of patch and motion together, and of the patch alone."""

from __future__ import annotations

import math

import numpy as np

from canprobe.touch._arrays import Array, eigen, inverted
from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.evidence import TO_Q
from canprobe.touch.frames import homogeneous, tangent_rotation
from canprobe.touch.patch_curvature import Fused, PatchCurvature
from canprobe.touch.quadric import UNIT, parameters_of
from canprobe.touch.rank import SIGMA_LIMIT, Decision

NAMED = 0.1
"""Share of the information about K that the patch gives from which on the estimate's method names it."""
DOUBTED = 0.5
"""Weight of the patch below which the estimate says that it contradicts the motion."""
_TO_K = 1.0 / np.outer(TO_Q, TO_Q)


def with_patch(motion: SurfaceEstimate, found: Fused, length: float) -> SurfaceEstimate:
    """A motion estimate with what was found with the patch.

    Place, normal and c13, c23, c33 stay the motion's; the patch says nothing about them.

    Args:
        motion: with its `evidence`.
        found: of the patch and that evidence.
        length: m, `rank` takes curvatures below 1/length for flat; the memory of the estimator.

    Returns:
        The estimate; its `method` ends in "+patch" where the patch gave at least `NAMED`, and a note says how much.
    """
    assert motion.evidence is not None
    has_prior = motion.rank < 3 and bool(np.isfinite(motion.covariance).all())
    data = motion.information if has_prior else motion.evidence.information
    decision = _decide(data + found.patch, found.q, length)
    root = None if motion.model_root is None else _joined(motion.model_root, found.patch)
    total = motion.evidence.information + found.patch
    inverse = inverted(total)
    share = float((inverse * found.patch).sum()) / 3.0
    return build_estimate(
        _solution(motion.S, found.q, inverse, decision, has_prior=has_prior, root=root),
        length=1.0,
        T_frame_contact=motion.T_frame_contact,
        problem_root=motion.problem_root,
        innovation=motion.innovation,
        distance=motion.distance,
        samples=motion.samples,
        method=motion.method + "+patch" if share >= NAMED else motion.method,
        prior=motion.prior,
        notes=(*motion.notes, *_notes(found, share)),
    )


def patch_estimate(contact: ContactSample, patch: PatchCurvature, length: float) -> SurfaceEstimate | None:
    """Shape from the patch alone, as of a touch that stands still; None where it says nothing.

    Args:
        contact: the last one; place and normal are its.
        patch: the images.
        length: m, see `with_patch`.
    """
    T = homogeneous(tangent_rotation(-contact.n_base), contact.p_base)
    found = patch.fuse(T)
    if found is None:
        return None
    plane = np.zeros((4, 4))
    plane[2, 3] = plane[3, 2] = -0.5
    return build_estimate(
        _solution(plane, found.q, inverted(found.patch), _decide(found.patch, found.q, length)),
        length=1.0,
        T_frame_contact=T,
        problem_root=_root(found.patch),
        innovation=1.0,
        distance=0.0,
        samples=float(patch.frames),
        method="patch",
        prior="none",
    )


def _notes(found: Fused, share: float) -> tuple[str, ...]:
    said = (f"{100.0 * share:.0f} % of the curvature from the patch",)
    return said if found.weight >= DOUBTED else (*said, "the patch contradicts the motion")


def _joined(model_root: Array, patch: Array) -> Array:
    """(n + 3, 9) root of the information about the entries of S with the patch's part about K."""
    rows = np.zeros((3, 9))
    rows[:, 6:] = _root(patch) / UNIT
    return np.concatenate([model_root, rows])


def _root(information: Array) -> Array:
    """(3, 3) root of the patch's information, which may be singular."""
    values, vectors = eigen(information)
    result: Array = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return result


def _decide(information: Array, q: Array, length: float) -> Decision:
    """The rank decision's second rule on what patch and motion together know; the first is about motion alone."""
    values, vectors = eigen(information)
    size = max(math.sqrt(float(q @ q)), 1.0 / length)
    return Decision(np.maximum(values, 0.0), vectors, values >= 1.0 / (SIGMA_LIMIT * size) ** 2)


def _solution(
    S: Array, q: Array, covariance: Array, decision: Decision, *, has_prior: bool = False, root: Array | None = None
) -> Solution:
    """From q and its covariance (3, 3)."""
    c = parameters_of(S)
    if has_prior or decision.rank == 3:
        c[6:] = UNIT * q
        return Solution(c, covariance * _TO_K, decision, has_prior, root)
    V = decision.vectors[:, decision.passed]
    c[6:] = UNIT * (V @ (V.T @ q))
    return Solution(c, np.full((3, 3), math.nan), decision, has_prior, root)
