"""The answer of patch and motion together, and of the patch alone."""

from __future__ import annotations

import math

import numpy as np

from canprobe.touch._arrays import Array, solved
from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.frames import homogeneous, tangent_rotation
from canprobe.touch.patch_curvature import CurvatureInformation, PatchCurvature, mean_of
from canprobe.touch.quadric import UNIT, parameters_of
from canprobe.touch.rank import SIGMA_LIMIT, Decision

_TO_Q = np.array([1.0, math.sqrt(2.0), 1.0])


def fuse(motion: SurfaceEstimate, patch: PatchCurvature, length: float) -> SurfaceEstimate:
    """A motion estimate with what the patch adds to it; the same object where it adds nothing.

    Place, normal and c13, c23, c33 stay the motion's; the patch says nothing about them.

    Args:
        motion: of any estimator, at the last contact that the patch was given.
        patch: the images.
        length: m, `rank` takes curvatures below 1/length for flat; the memory of the estimator.

    Returns:
        An estimate whose `method` ends in "+patch", or `motion`.
    """
    data = _observed_part(motion)
    known = _known(motion, data)
    found = patch.information(motion.T_frame_contact, known)
    if found is None or not found.information.any():
        return motion
    q = mean_of(known, found)
    decision = _decide(data + found.information, q, length)
    has_prior = motion.rank < 3 and bool(np.isfinite(motion.covariance).all())
    return build_estimate(
        _solution(motion.S, q, known.information + found.information, decision, has_prior),
        length=1.0,
        T_frame_contact=motion.T_frame_contact,
        condition_number=motion.condition_number,
        innovation=motion.innovation,
        distance=motion.distance,
        samples=motion.samples,
        method=motion.method + "+patch",
        prior=motion.prior,
        notes=motion.notes,
    )


def patch_estimate(contact: ContactSample, patch: PatchCurvature, length: float) -> SurfaceEstimate | None:
    """Shape from the patch alone, as of a touch that stands still; None where it says nothing.

    Args:
        contact: the last one; place and normal are its.
        patch: the images.
        length: m, see `fuse`.
    """
    T = homogeneous(tangent_rotation(-contact.n_base), contact.p_base)
    found = patch.information(T)
    if found is None:
        return None
    plane = np.zeros((4, 4))
    plane[2, 3] = plane[3, 2] = -0.5
    return build_estimate(
        _solution(plane, found.q, found.information, _decide(found.information, found.q, length), False),
        length=1.0,
        T_frame_contact=T,
        condition_number=math.sqrt(float(np.linalg.cond(found.information))),
        innovation=1.0,
        distance=0.0,
        samples=float(patch.frames),
        method="patch",
        prior="none",
    )


def _observed_part(motion: SurfaceEstimate) -> Array:
    """(3, 3) information of the data about q, in the observed combinations alone."""
    inside = motion.combinations.T @ motion.combinations
    result: Array = inside @ motion.information @ inside
    return result


def _known(motion: SurfaceEstimate, data: Array) -> CurvatureInformation:
    """Everything that the motion estimate says about q, its prior included."""
    q = 2.0 * _TO_Q * motion.S[[0, 0, 1], [0, 1, 1]]
    if np.isfinite(motion.covariance).all():
        return CurvatureInformation(q, solved(motion.covariance * np.outer(_TO_Q, _TO_Q), np.eye(3)))
    return CurvatureInformation(q, data)


def _decide(information: Array, q: Array, length: float) -> Decision:
    """The rank decision's second rule on what patch and motion together know; the first is about motion alone."""
    values, vectors = np.linalg.eigh(information)
    size = max(math.sqrt(float(q @ q)), 1.0 / length)
    return Decision(np.maximum(values, 0.0), vectors, values >= 1.0 / (SIGMA_LIMIT * size) ** 2)


def _solution(S: Array, q: Array, information: Array, decision: Decision, has_prior: bool) -> Solution:
    c = parameters_of(S)
    V = decision.vectors[:, decision.passed]
    c[6:] = UNIT * (q if has_prior else V @ (V.T @ q))
    if decision.rank < 3 and not has_prior:
        return Solution(c, np.full((3, 3), math.nan), decision, has_prior)
    return Solution(c, solved(information, np.eye(3)) / np.outer(_TO_Q, _TO_Q), decision, has_prior)
