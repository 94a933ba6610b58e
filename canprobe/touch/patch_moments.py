"""From the curvature under the probe to the second moments of its image: a calibrated forward model of the sensor.

On a Winkler layer of stiffness k a probe of radius R_p leaves an elliptic patch on a surface with shape operator K:
with `A = ½ (I/R_p + K)` and `F = π k δ² / (2 √det A)` its second moments are `M = (δ/6) A⁻¹`. A real sensor blurs them,
loses the rim under the level that is taken off and the ends outside its window, so its moments are a fitted function of
the ideal ones. That function is isotropic, a polynomial of third degree, hence by Cayley and Hamilton `V = α I + β M`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import mul
from typing import Any

import numpy as np

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array, positive, solved
from canprobe.touch.patch_image import Moments

_ROOT2 = math.sqrt(2.0)
TAPER = 0.1
"""How far beyond the calibrated range a patch still counts, as a share of the range's end."""
_APART = 1e-4
"""Least difference of the principal moments, over their mean, that a slope is taken over; a round patch has none."""
_STEP = 1e-5
"""Relative step of the difference quotients, in units of 1/R_p and of the force."""


def terms(a: Any, b: Any, t: Any) -> tuple[Any, ...]:
    """What the moment along an axis is a sum of; numbers or arrays.

    Args:
        a, b: ideal moments along the axis and across it, over the squared pitch.
        t: level over peak pressure.
    """
    square = a * a
    return (1.0 + 0.0 * a, a, b, t, square, a * b, t * a, b * b,
            square * a, square * b, a * b * b, b * b * b, t * b, t * t, t * square)  # fmt: skip


@dataclass(frozen=True, slots=True)
class MomentFit:
    """What a calibration found, free of units: `canprobe.studies.patch_calibration` makes it.

    With i, j the principal axes of the patch, m the ideal moments over the squared pitch and t the level over
    the peak pressure, the image's moment V_i over the squared pitch is the sum of the coefficients times `terms`.

    Attributes:
        coefficients: as many as there are terms.
        force_ratio: mean of the measured force over the true one.
        floor: (4, 4) covariance, as rows, of the relative errors that no averaging removes (gains, hysteresis, creep,
            the form of the model) of V_1, V_2, of V_12 over √(V_1 V_2), and of the force; at the middle of `t_range`
            (geometric mean), growing in proportion to t: light touches cover few taxels above the level.
        frame_sigma: relative standard deviation of a moment from one frame to the next.
        m_range, t_range: least and largest m and t that were pressed.
        memory: share of the patch's past ways on the pad (`patch_memory`) in the moments; taken off before all else.
    """

    coefficients: tuple[float, ...]
    force_ratio: float
    floor: tuple[tuple[float, ...], ...]
    frame_sigma: float
    m_range: tuple[float, float]
    t_range: tuple[float, float]
    memory: float = 0.0

    @property
    def middle_t(self) -> float:
        """The geometric mean of `t_range`."""
        return math.sqrt(self.t_range[0] * self.t_range[1])

    def __post_init__(self) -> None:
        if len(self.coefficients) != len(terms(0.0, 0.0, 0.0)):
            raise UsageError(f"coefficients: expected {len(terms(0.0, 0.0, 0.0))}, got {len(self.coefficients)}")
        floor = np.array(self.floor)
        if floor.shape != (4, 4) or not np.all(np.linalg.eigvalsh(floor) > 0.0):
            raise UsageError("floor: expected a definite (4, 4) covariance")


@dataclass(frozen=True, slots=True)
class MomentModel:
    """A fit on a certain probe.

    Attributes:
        fit: of the array's make.
        radius: R_p, m.
        stiffness: k = K/h of the layer, N/m³.
        level_pa: taken off the image's pressure (`patch_image`).
        pitch: m.
    """

    fit: MomentFit
    radius: float
    stiffness: float
    level_pa: float
    pitch: float = 1.5875e-3

    def __post_init__(self) -> None:
        for name in ("radius", "stiffness", "level_pa", "pitch"):
            positive(name, getattr(self, name))

    def ideal(self, k: Moments, force: float) -> tuple[Moments, float]:
        """Ideal moments over the squared pitch, and the level over the peak pressure.

        Args:
            k: K11, K12, K22, 1/m.
            force: N.

        Raises:
            ValueError: where the surface is as hollow as the probe.
        """
        axx, axy, ayy = 0.5 * (1.0 / self.radius + k[0]), 0.5 * k[1], 0.5 * (1.0 / self.radius + k[2])
        det = axx * ayy - axy * axy
        if det <= 0.0 or axx <= 0.0:
            raise ValueError("no patch: hollower than the probe")
        depth = math.sqrt(2.0 * force * math.sqrt(det) / (math.pi * self.stiffness))
        scale = depth / (6.0 * det * self.pitch**2)
        return (scale * ayy, -scale * axy, scale * axx), self.level_pa / (self.stiffness * depth)

    def moments(self, k: Moments, force: float) -> Moments:
        """Second moments of the image (m²) for a shape operator (1/m) and a force (N)."""
        (xx, xy, yy), t = self.ideal(k, force)
        mean = 0.5 * (xx + yy)
        half = max(math.hypot(0.5 * (xx - yy), xy), _APART * mean)
        long, short = self._along(mean + half, mean - half, t), self._along(mean - half, mean + half, t)
        beta = 0.5 * (long - short) / half
        alpha = 0.5 * (long + short) - beta * mean
        square = self.pitch**2
        return square * (alpha + beta * xx), square * beta * xy, square * (alpha + beta * yy)

    def _along(self, a: float, b: float, t: float) -> float:
        return math.fsum(map(mul, self.fit.coefficients, terms(a, b, t)))

    def trust(self, k: Moments, force: float) -> float:
        """1 where the calibration pressed such patches (K in 1/m, measured force in N), falling to 0 beyond.

        Raises:
            ValueError: where the surface is as hollow as the probe.
        """
        (xx, xy, yy), t = self.ideal(k, force / self.fit.force_ratio)
        mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        (m0, m1), (t0, t1) = self.fit.m_range, self.fit.t_range
        beyond = max(m0 / (mean - half), (mean + half) / m1, t0 / t, t / t1) - 1.0
        return min(max(1.0 - beyond / TAPER, 0.0), 1.0)

    def start(self, v: Moments, force: float) -> Moments | None:
        """K (1/m) to begin with, from moments (m²) and measured force (N), by the ideal layer and two coefficients.

        The moments must be given in their principal axes: the second is taken as 0. None where blur is all there is.
        """
        c0, c1 = self.fit.coefficients[:2]
        x, y = ((m / self.pitch**2 - c0) / c1 * self.pitch**2 for m in (v[0], v[2]))
        if x <= 0.0 or y <= 0.0:
            return None
        force = force / self.fit.force_ratio
        root_det = 2.0 * force / (36.0 * math.pi * self.stiffness * x * y)
        depth = math.sqrt(2.0 * force * root_det / (math.pi * self.stiffness))
        return 2.0 * depth / (6.0 * x) - 1.0 / self.radius, 0.0, 2.0 * depth / (6.0 * y) - 1.0 / self.radius

    def linearised(self, v: Moments, force: float, frames: float, k: Moments) -> tuple[Array, Array, Array]:
        """Relative residual at K, its Jacobian, and the information of the residual.

        Args:
            v: measured moments (m²) in their principal axes, so that the second is 0.
            force: measured, N.
            frames: how many were averaged.
            k: K11, K12, K22 in the same axes, 1/m.

        Returns:
            J (3, 3) on q = (K11, √2 K12, K22), m; residual (3,); its inverse covariance (3, 3).

        Raises:
            ValueError: where the surface is as hollow as the probe.
        """
        f, h = force / self.fit.force_ratio, _STEP / self.radius
        scale = (1.0 / v[0], 1.0 / math.sqrt(v[0] * v[2]), 1.0 / v[2])
        here = self.moments(k, f)

        def slope(moved: Moments, step: float) -> list[float]:
            return [s * (m - m0) / step for s, m, m0 in zip(scale, moved, here, strict=True)]

        k11, k12, k22 = k
        J = np.array(
            [
                slope(self.moments((k11 + h, k12, k22), f), h),
                slope(self.moments((k11, k12 + h, k22), f), _ROOT2 * h),
                slope(self.moments((k11, k12, k22 + h), f), h),
            ]
        ).T
        residual = np.array([s * (m - m0) for s, m, m0 in zip(scale, v, here, strict=True)])
        by_force = slope(self.moments(k, f * (1.0 + _STEP)), _STEP)
        lightness = self.ideal(k, f)[1] / self.fit.middle_t
        return J, residual, solved(self._covariance(by_force, frames, lightness), np.eye(3))

    def _covariance(self, by_force: list[float], frames: float, lightness: float) -> Array:
        """(3, 3) of the relative residuals of V11, V12, V22: an error of the force moves the prediction with it."""
        floor, noise = self.fit.floor, self.fit.frame_sigma**2 / max(frames, 1.0)
        parts = tuple(zip((0, 2, 1), by_force, strict=True))
        last = floor[3]
        covariance = [[floor[i][j] - b * last[j] - a * last[i] + a * b * last[3] for j, a in parts] for i, b in parts]
        result: Array = lightness * np.array(covariance)
        result.flat[::4] += noise
        return result
