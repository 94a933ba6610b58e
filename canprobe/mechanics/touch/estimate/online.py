"""What an online estimator is, the gate that every sample passes, and how answers follow a changing surface."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample, Doubt
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate, is_umbilic
from canprobe.mechanics.touch.estimate.noise import CHI2_999, CHI2_MEDIAN
from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.touch.linear_algebra import Array, positive


@dataclass(slots=True)
class Dropped:
    """Samples that were not used, by reason."""

    not_finite: int = 0
    """A NaN or infinite time, place or normal."""
    repeated: int = 0
    """The time of the sample before."""
    backwards: int = 0
    """A time before that of the sample before."""
    zero_sigma: int = 0
    """A standard deviation of 0 or less, or not finite."""
    not_unit: int = 0
    """A normal that is not a unit vector."""

    @property
    def total(self) -> int:
        """All of them."""
        return self.not_finite + self.repeated + self.backwards + self.zero_sigma + self.not_unit


WIDER = {Doubt.SATURATED: 3.0, Doubt.CUT: 3.0, Doubt.SMALL: 3.0, Doubt.DEAD: 1.5}
"""Factor of both standard deviations of a contact whose image is in doubt."""
DOUBTS_OF = 160
"""Last contacts whose doubts an estimate reports."""


class Estimator(Protocol):
    """Local shape from a stream of contacts."""

    @property
    def dropped(self) -> Dropped:
        """Samples that were not used."""

    def add(self, sample: ContactSample) -> None:
        """Take one contact; a sample that cannot be used is dropped and counted, never an error."""

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact, or None before there is any."""

    def reset(self) -> None:
        """Forget everything but the settings: contact was lost, or the array was reset."""


class Gate:
    """Lets through what an estimator can use and counts the rest; sigmas: of points (m) and normals (rad), above 0."""

    def __init__(self, sigma_point: float, sigma_normal: float) -> None:
        self.sigma_point = positive("sigma_point", sigma_point)
        self.sigma_normal = positive("sigma_normal", sigma_normal)
        self._last_t = -math.inf
        self._doubts: deque[tuple[Doubt, ...]] = deque(maxlen=DOUBTS_OF)

    def reset(self) -> None:
        """Accept any time again."""
        self._last_t = -math.inf
        self._doubts.clear()

    def notes(self) -> tuple[str, ...]:
        """What was in doubt about the images of the last contacts."""
        if not any(self._doubts):
            return ()
        counts = Counter(doubt for doubts in self._doubts if doubts for doubt in doubts)
        return tuple(f"{n} of the last {len(self._doubts)} contacts: {doubt.value}" for doubt, n in counts.items())

    def passes(self, sample: ContactSample, dropped: Dropped) -> bool:
        """Whether to use a sample; counts it where not."""
        t = sample.t_s
        x, y, z = sample.p_base.tolist()
        nx, ny, nz = sample.n_base.tolist()
        square = nx * nx + ny * ny + nz * nz
        if not math.isfinite(x * x + y * y + z * z + square + t):
            dropped.not_finite += 1
        elif abs(square - 1.0) > 1e-6:
            dropped.not_unit += 1
        elif not (_usable(sample.sigma_point) and _usable(sample.sigma_normal)):
            dropped.zero_sigma += 1
        elif t <= self._last_t:
            if t == self._last_t:
                dropped.repeated += 1
            else:
                dropped.backwards += 1
        else:
            self._last_t = t
            self._doubts.append(sample.doubts)
            return True
        return False

    def sigmas(self, sample: ContactSample) -> tuple[float, float]:
        """Standard deviations of a sample's point (m) and normal (rad)."""
        wider = max([WIDER[doubt] for doubt in sample.doubts], default=1.0)
        return (
            wider
            * math.hypot(self.sigma_point if sample.sigma_point is None else sample.sigma_point, sample.sigma_motion),
            wider * (self.sigma_normal if sample.sigma_normal is None else sample.sigma_normal),
        )


def _usable(sigma: float | None) -> bool:
    return sigma is None or (math.isfinite(sigma) and sigma > 0.0)


# Whether the surface has changed under a filter: an innovation test that wrong single samples do not set off.
#
# A change of the surface makes every following sample disagree with the prediction, a wrong centroid makes one. So two
# innovations must both have risen: the running one of all samples, and that of the best of the last few. Each is
# measured by what it usually is, since stated standard deviations are often generous.

LAST_FEW, BEST = 8, 3
"""Of so many last samples so many are the best: they stay right while no more than five of eight are wrong."""
BEST_SHARE = 0.37
"""Innovation of the best three of eight over that of all, when nothing is wrong."""
ALARM, ALARM_OF_BEST = 2.2, 3.5
"""Innovations, over what is usual, at which the surface is taken to have changed. By chance, or with three wrong
samples among the eight, one in a thousand and one in a hundred are above the second."""
USUAL = (0.3, 2.0)
"""Bounds of the usual innovation that an alarm is measured by. It is small where the stated noise is generous; above
the upper bound no innovation, capped as it is, could ever set off an alarm."""
AGREES = 4.8
"""Squared residual over the median one up to which a sample may lie on the surface before a change: 99 % of χ² of 3."""
RUNNING, LONG_TERM = 0.1, 0.004
"""Weights of one sample in the running and in the long-term innovation."""


class ChangeTest:
    """Running innovation of a filter, and an alarm.

    Attributes:
        alarms: how often the surface was taken to have changed.
        innovation: mean squared whitened innovation per degree of freedom over the last samples; about 1.
    """

    def __init__(self) -> None:
        self.alarms = 0
        self.innovation = self._all = 1.0
        self._of_best = BEST_SHARE
        self._last: deque[float] = deque(maxlen=LAST_FEW)

    @property
    def usual(self) -> float:
        """The innovation in the long term, within `USUAL`."""
        return _bounded(self._all)

    def take(self, square: float, caution: float = 1.0) -> bool:
        """Take a sample's squared innovation, χ² of 3; whether the surface now looks changed.

        `caution` multiplies both thresholds.
        """
        now = min(square, CHI2_999) / 3.0
        self._last.append(now)
        best = sum(sorted(self._last)[:BEST]) / BEST if len(self._last) == LAST_FEW else 0.0
        self.innovation += RUNNING * (now - self.innovation)
        usual_best = BEST_SHARE * _bounded(self._of_best / BEST_SHARE)
        if self.innovation >= caution * ALARM * self.usual and best >= caution * ALARM_OF_BEST * usual_best:
            return True
        self._all += LONG_TERM * (now - self._all)
        if len(self._last) == LAST_FEW:
            self._of_best += LONG_TERM * (best - self._of_best)
        return False

    def usual_again(self, squares: Array) -> bool:
        """Whether such squared innovations alone would set off no alarm, once something is taken into account."""
        return float(np.minimum(squares, CHI2_999).mean()) / 3.0 < ALARM * self.usual

    def alarm(self) -> None:
        """Count a change; the running innovation begins again at what is usual."""
        self.alarms += 1
        self.innovation = self.usual
        self._last.clear()


def _bounded(usual: float) -> float:
    return min(max(usual, USUAL[0]), USUAL[1])


def looks_changed(squares: Array) -> bool:
    """The same test on a batch's squared residuals (n,), in the order of time: whether the last few disagree with the
    fit of all.
    """
    usual = _bounded(float(np.median(squares)) / CHI2_MEDIAN)
    last = np.sort(np.minimum(squares[-LAST_FEW:], CHI2_999)) / 3.0
    return bool(last.mean() >= ALARM * usual and last[:BEST].mean() >= ALARM_OF_BEST * BEST_SHARE * usual)


# An estimator whose regions grow where its answers change along the path.
#
# A memory is a mean over the path, and a patch is one over its own size. Where curvature changes along the path the
# mean is that of an earlier place; the terms that a quadric leaves out (`nonlinear`) follow most of the change, not
# all of it. What is left has the direction in which the answers move, and is taken to be what they moved by over a
# small share of the memory. So it is nothing where the answers stay, however uncertain the surface was before, and it
# is large for a while where they go over from one curvature to another. The answers themselves are not touched.

SPAN = 0.5
"""Path, over the memory, along which a change of the answers is looked for."""
LEAST_SPAN = 0.05
"""The same just after a start."""
LAG = 0.075
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
        self._past: deque[tuple[float, Array]] = deque()
        self._place: Array | None = None
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

    def _late(self, tensor: Array) -> Array | None:
        """(3, 3) change of the curvature tensor over the path that an answer lags behind; None where there is none."""
        past = self._past
        while len(past) > 1 and self._travelled - past[1][0] >= SPAN * self._memory:
            past.popleft()
        if not past or self._travelled - past[0][0] < LEAST_SPAN * self._memory:
            return None
        then, before = past[0]
        result: Array = (tensor - before) * (LAG * self._memory / (self._travelled - then))
        return result


def less_certain(answer: SurfaceEstimate, *errors: Array) -> SurfaceEstimate:
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


def _with_error(root: Array, error: Array) -> Array:
    """A root (n, k) of an information once the last parameters have one more error (3,) of random size."""
    u = root[:, -len(error) :].dot(error)
    square = float(u.dot(u))
    if square == 0.0:
        return root
    share = (1.0 - 1.0 / math.sqrt(1.0 + square)) / square
    result: Array = root - (share * u)[:, None] * u.dot(root)
    return result
