"""An estimator whose regions grow where its answers change along the path.

A memory is a mean over the path, and a patch is one over its own size. Where curvature changes along the path the
mean is that of an earlier place; the terms that a quadric leaves out (`nonlinear`) follow most of the change, not
all of it. What is left has the direction in which the answers move, and is taken to be what they moved by over a
small share of the memory. So it is nothing where the answers stay, however uncertain the surface was before, and it
is large for a while where they go over from one curvature to another. The answers themselves are not touched.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate, is_umbilic
from canprobe.mechanics.touch.estimate.online import Dropped, Estimator
from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.types import Floats

SPAN_SHARE = 0.5
"""Path, over the memory, along which a change of the answers is looked for."""
MIN_SPAN_SHARE = 0.05
"""The same just after a start."""
LAG_SHARE = 0.075
"""Path, over the memory, that an answer lags behind, one standard deviation: 1.5 mm of 20 mm, half a patch. Set on
scans of nine packaged scenes."""


class FollowingEstimator:
    """Any estimator; the covariance of its answers grows by what they lag behind.

    Args:
        inner: the estimator.
        memory_m: path that it remembers, m.
        scale: relative error that all curvatures have in common.
    """

    def __init__(self, inner: Estimator, memory_m: float, scale: float = 0.0) -> None:
        self._inner = inner
        self._scale = scale
        self._memory = memory_m
        self._past: deque[tuple[float, Floats]] = deque()
        self._place: Floats | None = None
        self._travelled = 0.0

    @property
    def dropped(self) -> Dropped:
        """Samples that were not used."""
        return self._inner.dropped

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        self._inner.add(sample)

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._inner.reset()
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
        return less_certain(answer, *errors)

    def _late(self, tensor: Floats) -> Floats | None:
        """(3, 3) change of the curvature tensor over the path that an answer lags behind; None where there is none."""
        past = self._past
        while len(past) > 1 and self._travelled - past[1][0] >= SPAN_SHARE * self._memory:
            past.popleft()
        if not past or self._travelled - past[0][0] < MIN_SPAN_SHARE * self._memory:
            return None
        then, before = past[0]
        result: Floats = (tensor - before) * (LAG_SHARE * self._memory / (self._travelled - then))
        return result


def less_certain(answer: SurfaceEstimate, *errors: Floats) -> SurfaceEstimate:
    """An answer, all observed, whose curvature is also off by tensors (3, 3, 1/m), each times a normal variate."""
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
    """A root (n, k) of an information once the last parameters have one more error (3,) of random size."""
    u = root[:, -len(error) :].dot(error)
    square = float(u.dot(u))
    if square == 0.0:
        return root
    share = (1.0 - 1.0 / math.sqrt(1.0 + square)) / square
    result: Floats = root - (share * u)[:, None] * u.dot(root)
    return result
