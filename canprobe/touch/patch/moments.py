"""Second moments of tactile images: how the curvature under the probe makes them, and what the array adds and
remembers.

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
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.touch.linear_algebra import Array, positive, read_only, solved
from canprobe.touch.patch.image import PatchCalibration

LEVEL_COUNTS = 6
"""Taken off every taxel: the first count above the sensor's threshold of 2 %."""

Moments = tuple[float, float, float]
"""xx, xy, yy of a symmetric tensor in the tangent plane."""


class MomentImage:
    """Second central moments of the pressure above a level.

    A taxel at the patch's rim has the longest lever. Cut off at the threshold it enters and leaves with a jump, and
    the moments depend on where a resting patch lies on the grid: 2.5–4 % of the moment across a cylinder of 36 mm at
    2 N. With the level taken off it fades; there 0.6 % are left.

    """

    def __init__(self, calibration: PatchCalibration, level_counts: int = LEVEL_COUNTS) -> None:
        self.level_pa = float(calibration.pascals[level_counts])
        self._table = read_only(np.maximum(calibration.pascals - self.level_pa, 0.0))
        self._weights = calibration.weights
        self._square = calibration.pitch_m**2

    def moments(self, taxels: NDArray[np.uint8]) -> Moments | None:
        """Moments uu, uv, vv (m²) of an image (rows, columns) in pad coordinates; None where they are no ellipse."""
        total, u, v, uu, uv, vv = (self._table[taxels].reshape(-1) @ self._weights).tolist()
        if total <= 0.0:
            return None
        scale = self._square / total
        u, v = u / total, v / total
        uu, uv, vv = (
            scale * uu - self._square * u * u,
            scale * uv - self._square * u * v,
            scale * vv - self._square * v * v,
        )
        return (uu, uv, vv) if uu > 0.0 and uu * vv > uv * uv else None


# A calibrated forward model: from the curvature under the probe to the second moments of its image.

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
    """What a calibration found, free of units: `tests/support/array_calibration.py` makes it.

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
        memory: share of the patch's past ways on the pad (`PadMemory`) in the moments; taken off before all else.
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
    """A fit of the array's make on a probe of radius R_p (m); stiffness: K/h of the layer (N/m³); pitch: m.

    `level_pa` is taken off the image's pressure (`MomentImage`).
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
        """Ideal moments over the squared pitch, and the level over the peak pressure, for K11, K12, K22 (1/m) and a
        force (N).

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
        """1 where the calibration pressed such patches (K in 1/m, measured force in N), falling to 0 beyond."""
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
                slope(self.moments((k11, k12 + h, k22), f), math.sqrt(2.0) * h),
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


# What an array that creeps remembers of where the patch has been.
#
# A taxel's reading goes on growing under a constant load, by some percent a decade of time, and falls as slowly when
# the load is gone. So an image is the patch as it is, with a faint and blurred picture of where it was: the second
# moments of a patch that rolls over the pad are larger than those of one that rests, by a share of how far it has been
# away. The share is calibrated (`MomentFit.memory`); with it images at rest and on the move say the same of the
# surface.
#
# Model: memories that fade exponentially, a decade apart, all of one strength. It stops being true where the patch has
# been further away than its own size.
#
# Source: logarithmic creep as a sum of exponentials a decade apart: Findley, Lai and Onaran, "Creep and relaxation of
# nonlinear viscoelastic materials", ch. 5.

TIMES_S = (0.3, 3.0, 30.0)
"""Time constants of the memories."""


class PadMemory:
    """Places of the patch on the pad since the contact began, as faded memories."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Contact was lost."""
        self._t_s: float | None = None
        self._sums = [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for _ in TIMES_S]  # of 1, u, v, uu, uv, vv

    def add(self, t_s: float, u: float, v: float) -> Moments:
        """Take the centroid (m) of an image at a time (s).

        Returns uu, uv, vv of the way from here to where the patch was, mean over what each memory holds, added up, m².
        """
        dt = 0.0 if self._t_s is None else max(t_s - self._t_s, 0.0)
        self._t_s = t_s
        mass = su = sv = uu = uv = vv = 0.0
        for k, tau in enumerate(TIMES_S):
            kept = math.exp(-dt / tau)
            new = 1.0 - kept
            m, a, b, aa, ab, bb = self._sums[k]
            m, a, b = kept * m + new, kept * a + new * u, kept * b + new * v
            aa, ab, bb = kept * aa + new * u * u, kept * ab + new * u * v, kept * bb + new * v * v
            self._sums[k] = m, a, b, aa, ab, bb
            mass, su, sv, uu, uv, vv = mass + m, su + a, sv + b, uu + aa, uv + ab, vv + bb
        return (
            uu - 2.0 * u * su + u * u * mass,
            uv - u * sv - v * su + u * v * mass,
            vv - 2.0 * v * sv + v * v * mass,
        )


# The centroid on an array with hysteresis trails the contact over the pad; what is known of that is taken off.
#
# A taxel under the patch's front reads less than it should and one under its end more, and what has crept lags behind
# as well. So the centroid lies back along its own way, by some tens of micrometres: much more than its noise, and alike
# for millimetres of path over the object, which bends the normals that are felt.
#
# Model: with x the way from the mean place of the last `slow_s` to that of the last `quick_s`, the centroid lies `most
# · x / (|x| + reach)` back. It was fitted to scans at one speed; the bound keeps it harmless at others. It does not
# know the patch: of 0.1 mm to and fro the centroid shows 68 to 88 % by object, corrected 88 to 109 %.

GAP_S = 0.1
"""Time without contact after which the pad remembers nothing that counts."""


@dataclass(frozen=True, slots=True)
class Lag:
    """What a calibration of an array's make found.

    Attributes:
        most: largest distance, m.
        reach: way at which it is half of that, m.
        quick_s, slow_s: time constants of the places, s.
    """

    most: float
    reach: float
    quick_s: float = 0.02
    slow_s: float = 0.3


class PadLag:
    """Follows a contact over the pad and moves its centroid to where the contact most likely is.

    Args:
        lag: of the array.
    """

    def __init__(self, lag: Lag) -> None:
        self._lag = lag
        self._t_s = -math.inf
        self._quick = self._slow = (0.0, 0.0)

    def step(self, t_s: float, u: float, v: float) -> tuple[float, float]:
        """Take a centroid (m) at a time (s); where the contact is, m."""
        dt, self._t_s = t_s - self._t_s, t_s
        if dt > GAP_S:
            self._quick = self._slow = (u, v)
        self._quick = _nearer(self._quick, u, v, dt / self._lag.quick_s)
        self._slow = _nearer(self._slow, u, v, dt / self._lag.slow_s)
        x, y = self._quick[0] - self._slow[0], self._quick[1] - self._slow[1]
        share = self._lag.most / (math.hypot(x, y) + self._lag.reach)
        return u + share * x, v + share * y


def _nearer(mean: tuple[float, float], u: float, v: float, times: float) -> tuple[float, float]:
    """An exponential mean after so many time constants more."""
    new = 1.0 - math.exp(-max(times, 0.0))
    return mean[0] + new * (u - mean[0]), mean[1] + new * (v - mean[1])
