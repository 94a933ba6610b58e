"""What an online estimator is, and the gate that every sample passes."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array, positive
from canprobe.touch.batch import Touches, make_touches
from canprobe.touch.contact import ContactSample, Doubt
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.noise import make_noise


@dataclass(slots=True)
class Dropped:
    """Samples that were not used, by reason.

    Attributes:
        not_finite: a NaN or infinite time, place or normal.
        repeated: the time of the sample before.
        backwards: a time before that of the sample before.
        zero_sigma: a standard deviation of 0 or less, or not finite.
        not_unit: a normal that is not a unit vector.
    """

    not_finite: int = 0
    repeated: int = 0
    backwards: int = 0
    zero_sigma: int = 0
    not_unit: int = 0

    @property
    def total(self) -> int:
        """All of them."""
        return self.not_finite + self.repeated + self.backwards + self.zero_sigma + self.not_unit


WIDER = {Doubt.SATURATED: 3.0, Doubt.CUT: 3.0, Doubt.SMALL: 3.0, Doubt.DEAD: 1.5}
"""Factor of both standard deviations of a contact whose image is in doubt."""
DOUBTS_OF = 160
"""Last contacts whose doubts an estimate tells."""


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
    """Lets through what an estimator can use and counts the rest.

    Args:
        sigma_point: effective standard deviation of a point per axis, m.
        sigma_normal: of a normal per tangent axis, rad.

    Raises:
        UsageError: when either is not above 0.
    """

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
            wider * (self.sigma_point if sample.sigma_point is None else sample.sigma_point),
            wider * (self.sigma_normal if sample.sigma_normal is None else sample.sigma_normal),
        )


def _usable(sigma: float | None) -> bool:
    return sigma is None or (math.isfinite(sigma) and sigma > 0.0)


class WindowEstimator:
    """Base of the estimators that keep their last samples and solve them as a batch when asked.

    Args:
        sigma_point, sigma_normal: see `Gate`.
        window: samples that are kept.
        coupling: of the errors of point and normal (`Noise`), 1/m.
    """

    least = 2
    """Fewer samples give no answer."""

    def __init__(self, *, sigma_point: float, sigma_normal: float, window: int, coupling: float = 0.0) -> None:
        if window < self.least:
            raise UsageError(f"window: expected at least {self.least} samples, got {window}")
        self.dropped = Dropped()
        self._gate = Gate(sigma_point, sigma_normal)
        self._coupling = coupling
        self._samples: deque[ContactSample] = deque(maxlen=window)
        self._answer: SurfaceEstimate | None = None

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        if self._gate.passes(sample, self.dropped):
            self._samples.append(sample)
            self._answer = None

    def estimate(self) -> SurfaceEstimate | None:
        """The answer over the samples kept; None from fewer than `least`, or where they face more than 90° apart."""
        if self._answer is None and len(self._samples) >= self.least:
            touches = self._touches()
            if float((touches.normals @ touches.normals[-1]).min()) > 0.0:
                answer = self._solve(touches)
                self._answer = replace(answer, notes=answer.notes + self._gate.notes())
        return self._answer

    def reset(self) -> None:
        """Forget all samples."""
        self._samples.clear()
        self._gate.reset()
        self._answer = None

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        raise NotImplementedError

    def _touches(self) -> Touches:
        points: Array = np.array([s.p_base for s in self._samples])
        normals: Array = np.array([s.n_base for s in self._samples])
        sigmas = np.array([self._gate.sigmas(s) for s in self._samples])
        return make_touches(points, normals, make_noise(len(points), sigmas[:, 0], sigmas[:, 1], self._coupling))
