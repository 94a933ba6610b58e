"""The forward model of an array: force and second moments of its image, from the curvature under the probe.

On a Winkler layer of stiffness k a probe of radius R_p leaves an elliptic patch on a surface with shape operator K:
with `A = ½ (I/R_p + K)` and `F = π k δ² / (2 √det A)` the pressure is `k (δ − xᵀ A x)₊`, and its second moments are
`(δ/6) A⁻¹`. The array blurs that pressure, spreads some of it over rows and columns, scales it, and shows the part
above a level. Five parameters describe it: stiffness, scale, blur, crosstalk, and memory, the share of earlier places
in the image (`moments.PadMemory`). The level and the pitch are those of the device.

The blurred patch has no closed form: the pressure is computed on a grid of thirds of a pitch over one quadrant, in the
principal axes, and blurred by a folded Gaussian matrix. The model is not true where taxels saturate, where the patch is
no paraboloid (an edge, a hollow nearly as tight as the probe), and where only some taxels are above the level.

Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch.image.calibration import NO_ERRORS, ArrayCalibration, ImageParameters, MomentErrors
from canprobe.mechanics.touch.image.force_errors import USUAL_LIGHTNESS
from canprobe.mechanics.touch.image.moments import LEVEL_COUNTS, Moments
from canprobe.mechanics.touch.image.patch import PatchCalibration
from canprobe.mechanics.touch.pad import COUNTS_MAX, Pad
from canprobe.mechanics.types import Floats

STEPS_PER_PITCH = 3
"""Grid points in a pitch: with more of them a moment changes by 0.1 %."""
MIN_MOMENT_PITCH2 = 0.4
"""Least moment of the ideal layer over the squared pitch, of a patch three pitches wide; blur hides a smaller one."""
MAX_MOMENT_SHARE = 0.2
"""Largest moment of the ideal layer over the squared half-width of the window: the patch just fits."""
MAX_LIGHTNESS = 0.3
"""Largest level over peak pressure; beyond it too little of a patch is above the level."""
TAPER_SHARE = 0.1
"""Share of these limits within which, beyond them, the trust in a patch falls to 0."""
MOMENT_ERROR_POWER = 0.3
"""Power of the lightness with which variances of moments grow: light touches cover few taxels. Over 45 random scenes
the errors are 1.0 % at a lightness of 0.05 and 1.4 % at 0.15; one calibration has too few touches to show it."""
GAIN_LIGHTNESS = 0.25
"""Largest level over peak pressure of the forces of `force_gains`; smaller forces are made larger."""
_DIFFERENCE_STEP = 1e-3
"""Relative step of the difference quotients, of the curvature relative to the probe and of the force."""
_ROOT2 = math.sqrt(2.0)
_MIN_CURVATURE_DIFFERENCE = 1e-4
"""Least difference of the principal curvatures, relative, at which the shear of the image is a quotient."""
LIST_BLUR_TAXELS = 0.1
"""Blur of taxels that are separate, in pitches: the least of the image model."""
GAIN_FORCES_N = (0.5, 1.0, 2.0, 4.0)
GAIN_CURVATURES = ((0.0, 0.0), (0.8, 0.8), (1.6, 1.6), (1.2, 0.0), (0.6, -0.5))
"""Forces, and principal curvatures over that of the probe, between which the force gains hold: plane, balls, cylinder,
saddle."""


class ImageModel:
    """The images of one array on one probe.

    Args:
        parameters: parameters of the array.
        errors: errors of the moments.
        pad: its taxels.
        seen: number of taxels along a side of the window that moments are taken of; None for all.

    Attributes:
        parameters, errors, seen: as given.
        radius: radius R_p of the probe, m.
        pitch: distance of neighbouring taxels, m.
        level: pressure that is subtracted from every taxel before moments are taken (`MomentImage`), Pa: the first
            count above the array's threshold.
        count: pressure of one count, Pa.
        side: number of taxels along a side of the array.
    """

    def __init__(self, parameters: ImageParameters, errors: MomentErrors, pad: Pad, seen: int | None = None) -> None:
        self.parameters, self.errors, self.radius, self.pitch = parameters, errors, pad.radius_m, pad.pitch_m
        self.count, self.side = pad.full_scale_pa / COUNTS_MAX, max(pad.shape)
        self.level, self.seen = LEVEL_COUNTS * self.count, self.side if seen is None else seen
        half = 0.5 * self.seen
        # as far as the largest patch reaches: its moment is a sixth of the square of its half-axis
        source: Floats = (
            np.arange(math.ceil(math.sqrt(6.0 * MAX_MOMENT_SHARE) * half * STEPS_PER_PITCH) + 1) + 0.5
        ) / STEPS_PER_PITCH
        x = (np.arange(math.ceil(half * STEPS_PER_PITCH)) + 0.5) / STEPS_PER_PITCH
        width = self.parameters.blur / self.pitch
        far = np.arange(-20 * STEPS_PER_PITCH, 20 * STEPS_PER_PITCH + 1) / STEPS_PER_PITCH
        folded = [np.exp(-0.5 * ((x[:, None] - sign * source) / width) ** 2) for sign in (1.0, -1.0)]
        # why not √(2π) width: on thirds of a pitch the least blur, 0.1 pitches, would make pressures a third too high
        blur: Floats = (folded[0] + folded[1]) / np.exp(-0.5 * (far / width) ** 2).sum()
        # crosstalk is linear in rows and columns as the blur is: a row spreads its sum, which the blur leaves as it is
        share = self.parameters.crosstalk / (self.side - 1)
        blur = (1.0 - self.side * share) * blur + share * 2.0 / STEPS_PER_PITCH
        self._moments = np.stack(np.broadcast_arrays(1.0, (x * x)[:, None], x * x), axis=-1).reshape(-1, 3)
        self._squares, self._blur, self._turned_blur = source * source, blur, np.ascontiguousarray(blur.T)

    def with_stiffness(self, stiffness: float) -> ImageModel:
        """The same array on a layer of another stiffness (N/m³).

        The blur matrices do not depend on the stiffness and are kept; this runs in the loop.
        """
        other, p = copy(self), self.parameters
        other.parameters = ImageParameters(stiffness, p.scale, p.blur, p.crosstalk, p.memory)
        return other

    # the forward model

    def depth(self, force: float, det: float) -> float:
        """Indentation, m, under a force, N, with det A, 1/m²."""
        return math.sqrt(2.0 * force * math.sqrt(det) / (math.pi * self.parameters.stiffness))

    def shown(self, depth: Floats, a: Floats, b: Floats) -> Floats:
        """Pressure that the array shows in a quadrant of the patch.

        Args:
            depth: (n,) indentation, m.
            a, b: (n,) eigenvalues of A, 1/m.

        Returns:
            (n, m, m) Pa, the first of the last two axes along that of a, a third of a pitch apart.
        """
        p, square = self.parameters, self.pitch**2
        peak = p.scale * p.stiffness * depth
        per_square = peak * (square / depth)
        fall, drop = per_square * a, per_square * b
        field = (peak[:, None] - fall[:, None] * self._squares)[:, :, None] - (drop[:, None] * self._squares)[:, None]
        np.maximum(field, 0.0, out=field)
        return self._blur @ field @ self._turned_blur

    def moments_of(self, shown: Floats) -> list[tuple[float, float]]:
        """Second moments above the level along both axes, m², of each of the n that `shown` gives.

        Raises:
            ValueError: nothing is above the level.
        """
        above = np.maximum(shown - self.level, 0.0).reshape(len(shown), -1)
        square = self.pitch**2
        sums = above.dot(self._moments).tolist()
        if not all(total > 0.0 for total, _, _ in sums):
            raise ValueError("no patch: nothing above the level")
        return [(square * xx / total, square * yy / total) for total, xx, yy in sums]

    def sum_of(self, shown: Floats) -> Floats:
        """(n,) pressure times area of the taxels at or above the level, N, of what `shown` gives.

        Noise lets some taxels below it through and cuts some above it: the edge is one count wide.
        """
        share = np.clip((shown - self.level) / self.count + 1.0, 0.0, 1.0)
        sums: Floats = (shown * share).sum(axis=(1, 2)) * (2.0 * self.pitch / STEPS_PER_PITCH) ** 2
        return sums

    def moments(self, k: Moments, force: float) -> Moments:
        """Second moments of the image (m²) for a shape operator (K11, K12, K22; 1/m) and a force (N).

        Raises:
            ValueError: the surface is as hollow as the probe, or nothing is above the level.
        """
        (a, b), axes, det = self._principal(k)
        depth = self.depth(force, det)
        v1, v2 = self.moments_of(self.shown(np.array([depth]), np.array([a]), np.array([b])))[0]
        return _in_axes(v1, v2, axes)

    def _principal(self, k: Moments) -> tuple[tuple[float, float], tuple[float, float], float]:
        """Eigenvalues of A, cosine and sine of the direction of the first, det A."""
        mean, off = 0.5 * (k[0] + k[2]), 0.5 * (k[0] - k[2])
        half = math.hypot(off, k[1])
        a, b = 0.5 * (1.0 / self.radius + mean + half), 0.5 * (1.0 / self.radius + mean - half)
        if b <= 0.0:
            raise ValueError("no patch: hollower than the probe")
        angle = 0.5 * math.atan2(k[1], off)
        return (a, b), (math.cos(angle), math.sin(angle)), a * b

    # its inverse: what an image says about force and K

    def force_gains(self, forces: Sequence[float], curvatures: Sequence[tuple[float, float]]) -> tuple[float, float]:
        """Gains g, e (√N) with which the force is `g S + e √S`, S the sum of pressure times area.

        The second term stands for what the patch loses at its rim. Least squares of relative errors, within 1 %.

        Args:
            forces: forces, N; all are made larger where the second would hardly show on a plane.
            curvatures: principal curvatures over that of the probe; each is pressed with each force.
        """
        light = self._lightness(self.depth(forces[1], 0.25 / self.radius**2))
        forces = [force * max(1.0, light / GAIN_LIGHTNESS) ** 2 for force in forces]
        F, K = np.repeat(forces, len(curvatures)), np.tile(curvatures, (len(forces), 1))
        ab = 0.5 / self.radius * (1.0 + K)
        depths = np.array([self.depth(*pair) for pair in zip(F.tolist(), ab.prod(axis=1).tolist(), strict=True)])
        S = self.sum_of(self.shown(depths, ab[:, 0], ab[:, 1]))
        gains, *_ = np.linalg.lstsq(np.stack([S, np.sqrt(S)], axis=1) / F[:, None], np.ones(len(F)), rcond=None)
        return float(gains[0]), float(gains[1])

    def trust(self, k: Moments, force: float) -> float:
        """1 where the model holds (K in 1/m, force in N), falling to 0 beyond its limits of moment and lightness.

        A model with its peak beyond full scale contradicts an image that is not saturated: its stiffness is wrong.
        """
        (a, b), _, det = self._principal(k)
        depth = self.depth(force, det)
        least, most = (depth / (6.0 * x * self.pitch**2) for x in (a, b))
        light = self._lightness(depth)
        brightest = self.level / (COUNTS_MAX * self.count)
        ends = (
            MIN_MOMENT_PITCH2 / least,
            most / (MAX_MOMENT_SHARE * (0.5 * self.seen) ** 2),
            light / MAX_LIGHTNESS,
            brightest / light,
        )
        return min(max(1.0 - (max(ends) - 1.0) / TAPER_SHARE, 0.0), 1.0)

    def _lightness(self, depth: float) -> float:
        """Level over the peak pressure that the array shows."""
        return self.level / (self.parameters.scale * self.parameters.stiffness * depth)

    def start(self, v: Moments, force: float) -> Moments | None:
        """K (1/m) to start from, by moments (m²) in their principal axes and force (N); None where they are only blur.

        It is that of the ideal layer with half of the blur: the level subtracts about what the rest adds.
        """
        blur = 0.5 * self.parameters.blur**2
        x, y = v[0] - blur, v[2] - blur
        if x <= 0.0 or y <= 0.0:
            return None
        root_det = 2.0 * force / (36.0 * math.pi * self.parameters.stiffness * x * y)
        depth = self.depth(force, root_det * root_det)
        return depth / (3.0 * x) - 1.0 / self.radius, 0.0, depth / (3.0 * y) - 1.0 / self.radius

    def linearised(self, v: Moments, force: float, frames: float, k: Moments) -> tuple[Floats, Floats, Floats]:
        """Relative residual at K, its Jacobian, and the information of the residual.

        Args:
            v: measured moments, m², in their principal axes, so that the second is 0.
            force: measured force, N.
            frames: number of frames that were averaged.
            k: K11, K12, K22 in the same axes, 1/m.

        Returns:
            J (3, 3) on q = (K11, √2 K12, K22), m; residual (3,); its inverse covariance (3, 3).

        Raises:
            ValueError: the surface is as hollow as the probe, or nothing is above the level.
        """
        (a, b), (c, s), det = self._principal(k)
        h = _DIFFERENCE_STEP * a
        depth = self.depth(force, det)
        bent = depth * (1.0 + h / a) ** 0.25, depth * (1.0 + h / b) ** 0.25  # at the same force
        shown = self.shown(np.array((depth, *bent)), np.array((a, a + h, a)), np.array((b, b, b + h)))
        (v1, v2), (a1, a2), (b1, b2) = self.moments_of(shown)
        # derivatives by K in its principal axes, K = 2 A − I/R_p; moments turn with K, which gives that by K12 (shear)
        d11, d21, d12, d22 = (0.5 * d / h for d in (a1 - v1, a2 - v2, b1 - v1, b2 - v2))
        apart = 2.0 * (a - b)
        shear = (v1 - v2) / apart if apart > _MIN_CURVATURE_DIFFERENCE * a else d11 - d12
        scale = 1.0 / v[0], 1.0 / math.sqrt(v[0] * v[2]), 1.0 / v[2]
        cc, cs, ss = c * c, c * s, s * s
        rows = []
        for weight, (x, y, z) in zip(scale, ((cc, -2.0 * cs, ss), (cs, cc - ss, -cs), (ss, 2.0 * cs, cc)), strict=True):
            by1, by2, by12 = x * d11 + z * d21, x * d12 + z * d22, y * shear
            k11 = weight * (by1 * cc + by2 * ss - by12 * cs)
            k22 = weight * (by1 * ss + by2 * cc + by12 * cs)
            rows.append((k11, weight * _ROOT2 * ((by1 - by2) * cs + 0.5 * by12 * (cc - ss)), k22))
        here = _in_axes(v1, v2, (c, s))
        residual = np.array([weight * (m - m0) for weight, m, m0 in zip(scale, v, here, strict=True)])
        return np.array(rows), residual, self._information(frames, self._lightness(depth))

    def _information(self, frames: float, lightness: float) -> Floats:
        """(3, 3) inverse covariance of the relative residuals of V11, V12, V22."""
        e = self.errors
        noise, more = e.frame_sigma**2 / max(frames, 1.0), (lightness / USUAL_LIGHTNESS) ** MOMENT_ERROR_POWER
        moment, both = more * e.moment + noise, more * e.both
        det, shear = moment * moment - both * both, 1.0 / (more * e.shear + noise)
        return np.array(((moment / det, 0.0, -both / det), (0.0, shear, 0.0), (-both / det, 0.0, moment / det)))


def _in_axes(v1: float, v2: float, axes: tuple[float, float]) -> Moments:
    """xx, xy, yy of a tensor with principal values v1, v2, the direction of the first given by cosine and sine."""
    c, s = axes
    return c * c * v1 + s * s * v2, c * s * (v1 - v2), s * s * v1 + c * c * v2


def make_patch_calibration(calibration: ArrayCalibration, pad: Pad) -> PatchCalibration:
    """From counts to force, for an array of these taxels.

    At another full scale than that of the calibration, level, threshold and noise are the same counts of another
    pressure; layer, blur, crosstalk and scale stay.
    """
    plain = PatchCalibration(
        pad,
        gains=() if pad.is_flat else calibration.gains,
        dead=calibration.dead,
        force_errors=calibration.force,
        reference_sigma=0.0 if calibration.nominal else calibration.force_sigma,
    )
    return with_force_gains(plain, calibration.image)


def with_force_gains(plain: PatchCalibration, image: ImageParameters) -> PatchCalibration:
    """The same array with the gains of the force that these parameters give it.

    On a flat array, which has no image model, the force is the plain sum of pressure times area over the scale. The
    taxels of a list are separate: their model has the least blur.
    """
    pad = plain.pad
    if pad.is_flat:
        return replace(plain, force_gain=1.0 / image.scale)
    if not pad.is_grid:
        image = replace(image, blur=min(image.blur, LIST_BLUR_TAXELS * pad.pitch_m))
    gain, edge = ImageModel(image, NO_ERRORS, pad).force_gains(GAIN_FORCES_N, GAIN_CURVATURES)
    return replace(plain, force_gain=gain, edge_gain=edge, blur_m=image.blur)


def make_image_model(calibration: ArrayCalibration, patch: PatchCalibration, *, seen: int | None) -> ImageModel:
    """The image model of an array; `seen` is the number of taxels along the side of the window, None for all."""
    return ImageModel(calibration.image, calibration.moments, patch.pad, seen)
