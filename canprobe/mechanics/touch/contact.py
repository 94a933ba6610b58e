"""Contact of a spherical probe with an object: its place and normal, and the stiffness of the layer from a touch.

`n_f`, `n_o` are OUTWARD unit normals of probe ("finger") and object, `n_f = −n_o` (14). Source: Chen, Rink and Zhang,
(13), (14), (20).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.linear_algebra import Array, positive
from canprobe.mechanics.touch.stops import MOST_SPREAD


class Doubt(Enum):
    """Why a contact's place is worth less than others."""

    SATURATED = "a saturated patch"
    CUT = "a patch cut by the pad's edge"
    SMALL = "hardly a patch"
    DEAD = "a dead taxel in the patch"


class Slope(NamedTuple):
    """How √F grows with the indentation in a touch, √N/m, and its standard deviation (`PushFit`)."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class ContactSample:
    """One contact, as the estimators take it.

    Attributes:
        t_s: time, s.
        p_base: (3,) contact point on the object, m, in base.
        n_base: (3,) outward unit normal of the object there, in base.
        T_base_probe: (4, 4) probe frame (origin at the sphere's centre, z through the pole of the pad) to base.
        r_probe: (3,) contact point in the probe frame, m.
        force_n: contact force, N.
        sigma_point: effective standard deviation of the point per axis, m; None for the estimator's own.
        sigma_normal: that of the normal per tangent axis, rad; None for the estimator's own.
        moments: second moments uu, uv, vv of the patch along the pad's axes, m² (`patch.moments`); or None.
        doubts: about the image; estimators give the contact less weight and note it.
        sigma_motion: standard deviation of the point from an instant that is not known well while the probe moves, m;
            it comes on top of that of the point.
        slope: of √F over the indentation in its touch; None where it was not measured.
    """

    t_s: float
    p_base: Array
    n_base: Array
    T_base_probe: Array
    r_probe: Array
    force_n: float
    sigma_point: float | None = None
    sigma_normal: float | None = None
    moments: tuple[float, float, float] | None = None
    doubts: tuple[Doubt, ...] = ()
    sigma_motion: float = 0.0
    slope: Slope | None = None


def pad_to_direction(u: float, v: float, radius: float) -> Array:
    """Direction (3,) of a pad point (u, v), m, as seen from the sphere's centre, in the probe frame.

    The flat array is wrapped azimuthal-equidistantly: the exponential map of (u, v)/R_p at the pole, R_p the radius.
    """
    return np.array(_direction(u, v, radius))


def _direction(u: float, v: float, radius: float) -> tuple[float, float, float]:
    angle = math.hypot(u, v) / radius
    scale = 1.0 / radius if angle < 1e-9 else math.sin(angle) / (angle * radius)
    return u * scale, v * scale, math.cos(angle)


def direction_to_pad(direction: Sequence[float] | Array, radius: float) -> tuple[float, float]:
    """Pad coordinates (u, v) in m of a direction (3,) in the probe frame: the logarithmic map at the pole."""
    x, y, z = float(direction[0]), float(direction[1]), float(direction[2])
    sine = math.hypot(x, y)
    scale = radius if sine < 1e-12 and z > 0.0 else radius * math.atan2(sine, z) / max(sine, 1e-300)
    return x * scale, y * scale


def contact_on_object(
    T_base_probe: Array, direction: Sequence[float], radius: float, depth: float
) -> tuple[Array, Array]:
    """The object's contact point and outward normal in base, through the squeezed layer (13), (14), (20).

    `p = centre + (R_p − δ) n_f` and `n_o = −n_f`, (3,) each, n_f along a direction (3,) of the probe frame (4, 4).
    """
    u, v, w = direction
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = T_base_probe.tolist()
    nx, ny, nz = a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w
    reach = radius - depth
    return np.array([x + reach * nx, y + reach * ny, z + reach * nz]), np.array([-nx, -ny, -nz])


def contact_sample(
    *,
    t_s: float,
    T_base_probe: Array,
    uv: Sequence[float] | Array,
    depth: float,
    radius: float,
    force_n: float,
    sigma_point: float | None = None,
    moments: tuple[float, float, float] | None = None,
    doubts: tuple[Doubt, ...] = (),
    slope: Slope | None = None,
) -> ContactSample:
    """A sample from the centroid uv (2,) on the pad (m), the indentation (m) and the probe's radius (m).

    The other arguments are those of `ContactSample`; taxels and pose are of one time.
    """
    u, v = uv
    x, y, z = direction = _direction(u, v, radius)
    point, normal = contact_on_object(T_base_probe, direction, radius, depth)
    reach = radius - depth
    arm = np.array((reach * x, reach * y, reach * z))
    return ContactSample(
        t_s, point, normal, T_base_probe, arm, force_n, sigma_point, moments=moments, doubts=doubts, slope=slope
    )


def indentation_from_force(force: float, stiffness_n_m3: float, radius: float, kappa: ArrayLike) -> float:
    """Indentation δ (m) of the elastic layer under a force.

    Winkler layer, `p = k (δ − A x² − B y²)₊`, hence `F = π k δ² / (2 √(AB))` with `A, B = ½ (1/R_p + κ1,2)`.

    Args:
        force: F, N; 0 or less gives 0.
        stiffness_n_m3: k = K/h, N/m³.
        radius: R_p, m.
        kappa: (2,) principal curvatures of the object, 1/m; a NaN (not observed) counts as flat.

    Raises:
        UsageError: where the object is concave and as tight as the probe or tighter: there is no patch.
    """
    k1, k2 = (0.0 if math.isnan(k) else float(k) for k in np.asarray(kappa, dtype=np.float64))
    positive("stiffness_n_m3", stiffness_n_m3)
    ab = (0.5 / radius + 0.5 * k1) * (0.5 / radius + 0.5 * k2)
    if min(1.0 / radius + k1, 1.0 / radius + k2) <= 0.0:
        raise UsageError(f"kappa: expected above {-1.0 / radius:.4g} per m (the probe's own curvature), got {k1}, {k2}")
    return math.sqrt(max(force, 0.0) * 2.0 * math.sqrt(ab) / (math.pi * stiffness_n_m3))


# The layer's compliance from a touch: how the force grows while the probe is pushed into an object that stands still.
#
# On a Winkler layer `F = π k δ² / (2 √(AB))`, so the root of the force is a straight line over the push, whatever the
# curvatures: its slope b is what the servo needs, `δ = √F / b`; with the curvatures known it gives `k = 2 √(AB) b² /
# π`. Stops being true where the patch is cut by the pad's edge or the object slides away.

SIGMA_ROOT = 0.03
"""Noise of √F, √N: a force of 1 N known to 6 %, its slow errors (hysteresis, creep) included."""
MOST_SCATTER = 3.3
"""RMS distance from the line over the noise above which it is none."""
LEAST_FORCE_N = 0.1
"""Below it threshold and noise of the array bend the line."""
SAMPLES_OF_A_PUSH = 6


class PushFit:
    """Straight line of √F over the push, from running means (Welford): constant time and memory.

    Both have errors, and on a stiff contact a micrometre of the push is a large force. The line is that of the root on
    the push as it was measured, which errors make flatter: it predicts the force where the encoders see the probe.

    Example: `fit.add(push, force)` for every tactile frame of a touch; `fit.slope` once `fit.certain(0.1)`.

    Args:
        push_sigma: standard deviation of a push, m, independent from sample to sample.
    """

    def __init__(self, push_sigma: float = 0.0) -> None:
        self._push_variance = push_sigma * push_sigma
        self._n = 0
        self._push = self._root = 0.0  # means
        self._spread = self._joint = self._root_spread = 0.0  # sums of products about them

    def add(self, push: float, force: float) -> None:
        """Take a push of the probe towards the object (m, from any zero) and the force (N); a small one is left out."""
        if not (force >= LEAST_FORCE_N and math.isfinite(push)):
            return
        root = math.sqrt(force)
        self._n += 1
        from_mean = push - self._push
        self._push += from_mean / self._n
        root_from_mean = root - self._root
        self._root += root_from_mean / self._n
        self._spread += from_mean * (push - self._push)
        self._joint += from_mean * (root - self._root)
        self._root_spread += root_from_mean * (root - self._root)

    @property
    def slope(self) -> float:
        """b, √N per m; NaN where there is none yet."""
        return self._joint / self._spread if self._determined else math.nan

    @property
    def start(self) -> float:
        """Push at which the line has no force any more, m: where the touch began; NaN where there is no slope yet."""
        return self._push - self._root / self.slope if self._determined else math.nan

    @property
    def sigma(self) -> float:
        """Its standard deviation, √N per m; infinite where there is no slope."""
        return self._noise / math.sqrt(self._spread) if self._determined else math.inf

    def certain(self, share: float) -> bool:
        """Whether the slope is positive, known to this share of itself (1σ), and the samples lie on the line.

        A sensor that sends nonsense has a slope too; its samples are off the line.
        """
        return self.slope > 0.0 and self.sigma < share * self.slope and self.scatter < MOST_SCATTER * self._noise

    @property
    def scatter(self) -> float:
        """RMS distance of √F from the line, √N; infinite where there is no slope."""
        if not self._determined:
            return math.inf
        return math.sqrt(max(self._root_spread - self._joint**2 / self._spread, 0.0) / (self._n - 2))

    @property
    def _noise(self) -> float:
        """Of a sample about the line, √N: that of the root and that of the push, seen along the slope."""
        return math.sqrt(SIGMA_ROOT**2 + self.slope**2 * self._push_variance)

    @property
    def _determined(self) -> bool:
        return self._n >= SAMPLES_OF_A_PUSH and self._spread > 0.0


def stiffness_from_slope(slope: float, radius: float, kappa: ArrayLike) -> float:
    """K/h of the layer (N/m³) from the slope b (√N per m) on an object of known curvature (2,) above −1/R_p, 1/m.

    The inverse of `indentation_from_force`.
    """
    k1, k2 = (float(k) for k in np.asarray(kappa, dtype=np.float64))
    return 2.0 * math.sqrt(0.25 * (1.0 / radius + k1) * (1.0 / radius + k2)) * slope * slope / math.pi


# What the samples of a touch at rest say against going on: a force that swings, an array that cannot show it.

MOST_SATURATED = 0.75
"""Share of saturated samples above which the measured force is only a lower bound of the true one.

That alone is no reason: up to 40 kN/m the bound is near enough. Where √F did not grow on a line either, it is not.
"""
SAMPLES_AT_REST = 10


class AtRest:
    """Spread and saturation from running means (Welford): constant time and memory."""

    def __init__(self) -> None:
        self._n = self._saturated = 0
        self._mean = self._spread = 0.0

    def add(self, force: float, saturated: bool) -> None:
        """Take a force (N), and whether a taxel was at its largest count."""
        self._n += 1
        self._saturated += saturated
        from_mean = force - self._mean
        self._mean += from_mean / self._n
        self._spread += from_mean * (force - self._mean)

    def doubt(self, target: float, felt: bool) -> str | None:
        """Why the force is not the wanted one (N); None where all is well or not known.

        `felt`: the touch showed the layer's stiffness (`PushFit`).
        """
        if self._n < SAMPLES_AT_REST:
            return None
        if not felt and self._saturated > MOST_SATURATED * self._n:
            return (
                f"the array is saturated in {100.0 * self._saturated / self._n:.0f} % of the samples and no stiffness "
                f"was felt: the true force is above the {self._mean:.1f} N measured; raise sensor.full_scale_kpa or "
                "lower task.force_n"
            )
        sigma = math.sqrt(self._spread / (self._n - 1))
        if sigma > MOST_SPREAD * target:
            return (
                f"the force does not settle: {self._mean:.1f} ± {sigma:.1f} N where {target:.1f} N are wanted; the "
                "contact is too stiff for the arm's encoder counts, or servo.surface_height_hz too high"
            )
        return None
