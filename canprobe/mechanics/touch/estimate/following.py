"""An estimator whose regions grow where its answers change along the path.

An answer is a mean over the memory, and a patch is one over its own size. Where curvature changes along the path the
mean belongs to an earlier place; the terms that a quadric leaves out (`misfit`) follow most of the change, not all of
it. The error that is left points in the direction in which the answers move, and is taken to be their movement over a
small share of the memory. So it is zero where the answers stay, however uncertain the surface was before, and large for
a while where they change from one curvature to another. Only the covariance is changed. Why not move the answer on too:
the movement is itself an estimate, and extrapolated noise would do more harm than the lag.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate, is_umbilic
from canprobe.mechanics.touch.estimate.online import Estimator, OuterEstimator
from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.types import Floats

SPAN_SHARE = 0.5
"""Path, over the memory, over which a change of the answers is measured."""
MIN_SPAN_SHARE = 0.05
"""Least such path, just after a start."""
LAG_SHARE = 0.075
"""Path, over the memory, by which an answer lags (one standard deviation): 1.5 mm of 20 mm, half a patch. The value was
set on scans of nine packaged scenes."""


class FollowingEstimator(OuterEstimator):
    """An estimator, with covariances that grow by the lag of its answers.

    Args:
        inner: the estimator.
        memory_m: path that it remembers, m.
        scale: relative error that all curvatures have in common, one standard deviation.
        drag: error of the way of a contact over the pad, over this way, one standard deviation (`drag_errors`).
        offset: error of the probe's centre along the normal while the probe turns with the surface, m, one standard
            deviation. The contacts then lie on an offset surface, whose curvature differs by `offset · K²`.
    """

    def __init__(
        self, inner: Estimator, memory_m: float, *, scale: float = 0.0, drag: float = 0.0, offset: float = 0.0
    ) -> None:
        super().__init__(inner)
        self._scale, self._drag, self._offset = scale, drag, offset
        self._memory = memory_m
        self._past: deque[tuple[float, Floats]] = deque()
        self._place: Floats | None = None
        self._travelled = 0.0

    def reset(self) -> None:
        """Forget everything but the settings."""
        super().reset()
        self._past.clear()
        self._place = None

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact, or None before there is any."""
        answer = self._inner.estimate()
        if answer is None or answer.rank < 3:
            return answer
        if self._place is not None:
            self._travelled += float(np.linalg.norm(answer.point - self._place))
        self._place = answer.point
        tensor = answer.curvature_tensor_base()
        late = self._late(tensor)
        self._past.append((self._travelled, tensor))
        errors = [] if late is None else [late]
        if self._scale != 0.0:
            errors.append(self._scale * tensor)
        if self._offset != 0.0:
            errors.append(self._offset * tensor.dot(tensor))
        if self._drag != 0.0:
            errors += drag_errors(answer, self._drag)
        return less_certain(answer, *errors)

    def _late(self, tensor: Floats) -> Floats | None:
        """(3, 3) change of the curvature tensor over the path by which an answer lags; None where it is not known."""
        past = self._past
        while len(past) > 1 and self._travelled - past[1][0] >= SPAN_SHARE * self._memory:
            past.popleft()
        if not past or self._travelled - past[0][0] < MIN_SPAN_SHARE * self._memory:
            return None
        then, before = past[0]
        result: Floats = (tensor - before) * (LAG_SHARE * self._memory / (self._travelled - then))
        return result


def drag_errors(answer: SurfaceEstimate, drag: float) -> list[Floats]:
    """Errors (3, 3) of curvature, 1/m, of a probe that keeps its orientation, each times a standard normal variate.

    Model: the contact seems to go `(I + M) w` over the pad where it goes w, and each entry of M (2, 2) has the standard
    deviation `drag`. So the normal seems to turn too far or not far enough, and about another axis: the centroid lags
    behind a contact that goes round, for instance, which turns the principal directions. Of `M K` the symmetrical part
    is a curvature. The other part is none, and contradicts the places of the contacts.
    """
    P = answer.T_frame_contact[:3, :2]
    errors = []
    for i in range(2):
        for row in answer.K:
            MK = np.zeros((2, 2))
            MK[i] = drag * row
            errors.append(P.dot(0.5 * (MK + MK.T)).dot(P.T))
    return errors


def less_certain(answer: SurfaceEstimate, *errors: Floats) -> SurfaceEstimate:
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


def _with_error(root: Floats, error: Floats) -> Floats:
    """A root (n, k) of an information after the last parameters got one more error (3,) times a normal variate."""
    u = root[:, -len(error) :].dot(error)
    square = float(u.dot(u))
    if square == 0.0:
        return root
    share = (1.0 - 1.0 / math.sqrt(1.0 + square)) / square
    result: Floats = root - (share * u)[:, None] * u.dot(root)
    return result
