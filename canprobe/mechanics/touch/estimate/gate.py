"""The gate that every sample of an online estimator passes, and the errors that it has behind it."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.checks import positive
from canprobe.mechanics.touch.contact import ContactSample, Doubt
from canprobe.mechanics.touch.estimate.noise import Noise, SlowErrors
from canprobe.mechanics.touch.estimate.path_length import PathLength
from canprobe.mechanics.types import Floats


@dataclass(slots=True)
class Dropped:
    """Numbers of samples that were not used, by reason."""

    not_finite: int = 0
    """Samples with a NaN or infinite time, place or normal."""
    repeated: int = 0
    """Samples with the time of the sample before."""
    backwards: int = 0
    """Samples with an earlier time than the sample before."""
    zero_sigma: int = 0
    """Samples with a standard deviation of 0 or less, or not finite."""
    not_unit: int = 0
    """Samples with a normal that is not a unit vector."""

    @property
    def total(self) -> int:
        """Number of all dropped samples."""
        return self.not_finite + self.repeated + self.backwards + self.zero_sigma + self.not_unit


DOUBT_SIGMA_SCALE = {Doubt.SATURATED: 3.0, Doubt.CUT: 3.0, Doubt.SMALL: 3.0, Doubt.DEAD: 1.5}
"""Factor on both standard deviations of a contact whose image is in doubt."""
DOUBT_WINDOW_SAMPLES = 160
"""Number of last contacts whose doubts an estimate reports."""


class Gate:
    """Passes the samples that an estimator can use, counts the rest, and states the errors of each that passed.

    It follows the contacts over the pad, along whose way their slow errors change.

    Args:
        sigma_point: standard deviation of a point that states none, m.
        sigma_normal: standard deviation of a normal that states none, rad.

    Raises:
        UsageError: a standard deviation is not above 0.
    """

    def __init__(self, sigma_point: float, sigma_normal: float) -> None:
        self.sigma_point = positive("sigma_point", sigma_point)
        self.sigma_normal = positive("sigma_normal", sigma_normal)
        self._doubts: deque[tuple[Doubt, ...]] = deque(maxlen=DOUBT_WINDOW_SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Accept any time and place again."""
        self._last_t = -math.inf
        self._doubts.clear()
        self._path_length = PathLength(self.sigma_point)  # noise at rest makes no way

    def notes(self) -> tuple[str, ...]:
        """Notes on the doubts about the images of the last contacts."""
        if not any(self._doubts):
            return ()
        counts = Counter(doubt for doubts in self._doubts if doubts for doubt in doubts)
        return tuple(f"{n} of the last {len(self._doubts)} contacts: {doubt.value}" for doubt, n in counts.items())

    def passes(self, sample: ContactSample, dropped: Dropped) -> bool:
        """Whether a sample can be used; a sample that cannot is counted in `dropped`."""
        t = sample.t_s
        x, y, z = sample.p_base.tolist()
        nx, ny, nz = sample.n_base.tolist()
        square = nx * nx + ny * ny + nz * nz
        # the sum is finite only if all terms are: 0.1 µs a sample, where six tests take 0.3
        if not math.isfinite(x * x + y * y + z * z + square + t):
            dropped.not_finite += 1
        elif abs(square - 1.0) > 1e-6:
            dropped.not_unit += 1
        elif not all(
            s is None or 0.0 < s < math.inf for s in (sample.sigma_point, sample.sigma_height, sample.sigma_normal)
        ):
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

    def sigmas(self, sample: ContactSample) -> tuple[float, float, float]:
        """Standard deviations of a sample: point along the surface and along the normal (m), normal (rad)."""
        wider = _widening(sample)
        point = math.hypot(self.sigma_point if sample.sigma_point is None else sample.sigma_point, sample.sigma_motion)
        return (
            wider * point,
            wider * (point if sample.sigma_height is None else sample.sigma_height),
            wider * (self.sigma_normal if sample.sigma_normal is None else sample.sigma_normal),
        )

    def measured(self, sample: ContactSample, coupling: float = 0.0) -> MeasuredContact:
        """The next contact with its errors, and their coupling, 1/m."""
        self._path_length.add(sample.r_probe)
        point, height, normal = self.sigmas(sample)
        slow = min(_widening(sample) * sample.sigma_slow / point, 1.0)
        way = self._path_length.total
        return MeasuredContact(sample.p_base, sample.n_base, point, height, normal, coupling, slow, way)


class MeasuredContact(NamedTuple):
    """A contact with its errors, as estimators take it.

    Attributes:
        point: (3,) contact point in base, m.
        normal: (3,) outward unit normal of the object there, in base.
        sigma_point: standard deviation of the point along the surface, per axis, m.
        sigma_height: standard deviation of the point along the normal, m.
        sigma_normal: standard deviation of the normal per tangent axis, rad.
        coupling: coupling of their errors (`Noise.coupling`), 1/m.
        slow: share of its slow errors (`SlowErrors.share`).
        way: way over the pad up to this contact, m.
        weight: weight by its place alone (`PathLength`).
    """

    point: Floats
    normal: Floats
    sigma_point: float
    sigma_height: float
    sigma_normal: float
    coupling: float = 0.0
    slow: float = 0.0
    way: float = 0.0
    weight: float = 1.0

    def widened(self, factor: float) -> MeasuredContact:
        """The contact with standard deviations that are `factor` times as large."""
        point, height, normal = (factor * s for s in (self.sigma_point, self.sigma_height, self.sigma_normal))
        return self._replace(sigma_point=point, sigma_height=height, sigma_normal=normal)


def noise_of(touches: Sequence[MeasuredContact]) -> Noise:
    """Noise of contacts."""
    point, height, normal = np.array([(t.sigma_point, t.sigma_height, t.sigma_normal) for t in touches]).T
    return Noise(point, normal, touches[0].coupling, height)


def slow_errors(touches: Sequence[MeasuredContact]) -> SlowErrors:
    """Slow errors of contacts."""
    share, way = np.array([(t.slow, t.way) for t in touches]).T
    return SlowErrors(share, way)


def _widening(sample: ContactSample) -> float:
    """Factor on the standard deviations of a contact by the doubts about its image."""
    return max([DOUBT_SIGMA_SCALE[doubt] for doubt in sample.doubts], default=1.0)
