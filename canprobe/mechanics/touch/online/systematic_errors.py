"""Errors of curvature that no path averages: the lag of an answer, the scale, the tool, and the drag of the pad.

**Lag.** An answer is a mean over the memory, and a patch is one over its own size. Where curvature changes along the
path the mean belongs to an earlier place; the terms that a quadric leaves out (`misfit`) follow most of the change, not
all of it. The error that is left points in the direction in which the answers move, and is taken to be their movement
over a small share of the memory (`LAGS`). So it is zero where the answers stay, however uncertain the surface was
before, and large for a while where they change from one curvature to another. Why not move the answer on too: the
movement is itself an estimate, and extrapolated noise would do more harm than the lag.

**Scale** is a relative error that all curvatures have in common.

**Tool.** Where the probe turns with the surface, an error of its centre along the normal puts the contacts on an offset
surface, whose curvature differs by `offset · K²`.

**Drag.** Where it keeps its orientation, the contact seems to go `(I + M) w` over the pad where it goes w
(`drag_errors`).

Each is added to the covariance (`with_errors`); curvature is not changed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.online.estimator import AnswerPath, AnswerStage
from canprobe.mechanics.touch.online.regions import scaled, with_errors
from canprobe.mechanics.types import Floats

LAGS = ((0.5, 0.075), (0.1, 0.035))
"""Path over which a change of the answers is measured, and path by which an answer lags behind such a change (one
standard deviation), both over the memory. Slow changes lag by 1.5 mm of 20 mm, half a patch: set on scans of nine
packaged scenes. A surface whose curvature goes up and down within some millimetres changes little over half the memory,
so changes over 2 mm count apart, by 0.7 mm: set on 90 scenes of a development draw."""
MIN_SPAN_SHARE = 0.05
"""Least path of a change, just after a start."""
SCALE_ERROR = 4e-3
"""Relative error of curvature that no path averages."""
PAD_DRAG = 0.03
"""Error of the way of a contact over the pad, over this way (`drag_errors`), by hysteresis and creep. A probe that
keeps its orientation measures the normal by this way alone; else the rolling share is its part in the turn of the
normal. The value has the best log score on 15 scenes of a gantry of a development draw."""


class SystematicErrors(AnswerStage):
    """Adds errors that no path averages to the covariance of fully observed answers.

    Args:
        memory_m: path that the motion remembers, m.
        scale: relative error that all curvatures have in common, one standard deviation.
        drag: error of the way of a contact over the pad, over this way, one standard deviation (`drag_errors`).
        offset: error of the probe's centre along the normal while the probe turns with the surface, m, one standard
            deviation.
        wider: factor of all standard deviations at last (`beyond_factor`).
    """

    def __init__(
        self, memory_m: float, *, scale: float = 0.0, drag: float = 0.0, offset: float = 0.0, wider: float = 1.0
    ) -> None:
        self._scale, self._drag, self._offset, self._wider = scale, drag, offset, wider
        self._memory = memory_m
        self._past: deque[tuple[float, Floats]] = deque()
        self._path = AnswerPath()
        self._travelled = 0.0

    @classmethod
    def of_scan(cls, memory_m: float, rolling_share: float, position_sd: float, wider: float = 1.0) -> SystematicErrors:
        """The errors of a scan: the pad drags as far as the contact rolls, the tool errs as far as the probe turns.

        Args:
            memory_m: path that the motion remembers, m.
            rolling_share: 0 where the probe follows the normal, 1 where it keeps its orientation.
            position_sd: standard deviation of the probe's centre on the flange, per axis, m.
            wider: factor of all standard deviations at last.
        """
        drag, offset = PAD_DRAG * rolling_share, position_sd * (1.0 - rolling_share)
        return cls(memory_m, scale=SCALE_ERROR, drag=drag, offset=offset, wider=wider)

    def reset(self) -> None:
        self._past.clear()  # only differences of the path count, so that the path itself goes on
        self._path = AnswerPath()

    def refine(self, answer: SurfaceEstimate | None, sample: ContactSample) -> SurfaceEstimate | None:
        if answer is None or answer.rank < 3:
            return answer
        self._travelled += self._path.step(answer)
        tensor = answer.curvature_tensor_base()
        errors = list(self._lag_errors(tensor))
        self._past.append((self._travelled, tensor))
        if self._scale != 0.0:
            errors.append(self._scale * tensor)
        if self._offset != 0.0:
            errors.append(self._offset * tensor.dot(tensor))
        if self._drag != 0.0:
            errors += drag_errors(answer, self._drag)
        return scaled(with_errors(answer, *errors), self._wider)

    def _lag_errors(self, tensor: Floats) -> Iterator[Floats]:
        """(3, 3) changes of the curvature tensor over the paths by which an answer lags, as far as they are known."""
        past = self._past
        while len(past) > 1 and self._travelled - past[1][0] >= LAGS[0][0] * self._memory:
            past.popleft()
        for span, lag in LAGS if past else ():
            then, before = next((p for p in reversed(past) if self._travelled - p[0] >= span * self._memory), past[0])
            if self._travelled - then >= MIN_SPAN_SHARE * self._memory:
                yield (tensor - before) * (lag * self._memory / (self._travelled - then))


def drag_errors(answer: SurfaceEstimate, drag: float) -> list[Floats]:
    """Errors (3, 3) of curvature, 1/m, of a probe that keeps its orientation, each times a standard normal variate.

    Model: the contact seems to go `(I + M) w` over the pad where it goes w, and each entry of M (2, 2) has the standard
    deviation `drag`. So the normal seems to turn too far or not far enough, and about another axis: the centroid lags
    behind a contact that goes round, for instance, which turns the principal directions. Of `M K` the symmetrical part
    is a curvature. The other part is not, and contradicts the places of the contacts.
    """
    P = answer.T_frame_contact[:3, :2]
    errors = []
    for i in range(2):
        for row in answer.K:
            MK = np.zeros((2, 2))
            MK[i] = drag * row
            errors.append(P.dot(0.5 * (MK + MK.T)).dot(P.T))
    return errors
