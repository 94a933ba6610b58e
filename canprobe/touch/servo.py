"""The tactile servo: from contact samples to the pose of the probe, 400 times a second.

One idea: the surface stands still, the probe does not. A local model of the surface (point, normal, curvature) is corrected by
every tactile sample *at the instant it was sampled*; the pose that will hold the wanted indentation at the instant a command
takes effect is then read off that model. Force is regulated as indentation: measured force and wanted force are turned into
depth by the same elastic law, so a wrong stiffness cannot leave a steady error, only change the loop's gain.

Source: Chen, Rink & Zhang, section 4.2 (the five steps around (36)), with a damped inverse instead of ``J`` in step 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.touch.strategy import PathFollower

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SurfaceGains:
    """How fast the servo's local surface follows the tactile samples.

    Args:
        height_hz: bandwidth of the height correction (Hz).
        tilt_hz: bandwidth of the normal's correction (Hz).
    """

    height_hz: float = 8.0
    tilt_hz: float = 6.0


class LocalSurface:
    """The surface near the contact: ``a + d − ½ (dᵀ K d) m`` over the tangent plane at ``a`` with outward normal ``m``.

    Second order only: true within a few millimetres of the last sample, which is all the servo looks ahead.

    Args:
        point: a point of the surface (3,), m.
        normal: outward unit normal there (3,).
        gains: correction bandwidths.
    """

    def __init__(self, point: Vector, normal: Vector, gains: SurfaceGains) -> None:
        self.point = np.array(point, dtype=float)
        self.normal = np.array(normal, dtype=float)
        self.curvature = np.zeros((3, 3))
        self._gains = gains

    def foot(self, x: Vector) -> tuple[Vector, Vector]:
        """Surface point and outward unit normal over the tangential position of ``x`` (3,), m."""
        d = x - self.point
        d = d - self.normal * float(self.normal @ d)
        bent = self.curvature @ d
        normal = self.normal + bent
        return self.point + d - self.normal * (0.5 * float(d @ bent)), normal / math.sqrt(float(normal @ normal))

    def correct(self, point: Vector, normal: Vector, dt: float) -> float:
        """Move the model to a measured contact and towards it.

        Args:
            point: measured surface point (3,), m.
            normal: measured outward unit normal (3,).
            dt: time since the previous sample, s.

        Returns:
            The height error before correction (m), positive where the surface was found higher than modelled.
        """
        foot, foot_normal = self.foot(point)
        error = float(foot_normal @ (point - foot))
        height = 1 - math.exp(-2 * math.pi * self._gains.height_hz * dt)
        tilt = 1 - math.exp(-2 * math.pi * self._gains.tilt_hz * dt)
        self.point = foot + foot_normal * (height * error)
        blended = foot_normal + (normal - foot_normal) * tilt
        self.normal = blended / math.sqrt(float(blended @ blended))
        return error

    def set_curvature(self, tensor: Vector) -> None:
        """Take the estimator's curvature tensor (3, 3), 1/m, in the same frame."""
        self.curvature = tensor


@dataclass(frozen=True, slots=True)
class ProbePose:
    """Where the probe sphere must be: its centre (3,), m, and the direction of its pole (3,), both in the base frame."""

    centre: Vector
    pole: Vector


class TactileServo:
    """Marches a reference contact over the local surface and turns it into a probe pose.

    Args:
        surface: the local surface, corrected by the caller with every tactile sample.
        follower: gives the heading in the scan plane; None only holds.
        axes: (3, 3) rows: heading, across, approach normal of the scan plane, in the base frame.
        origin: origin of the scan plane's curve (3,), m.
        probe_radius: radius of the undeformed probe, m.
        rolling_share: 0 the pad follows the normal, 1 it keeps its first orientation.
    """

    def __init__(
        self,
        surface: LocalSurface,
        follower: PathFollower | None,
        *,
        axes: Vector,
        origin: Vector,
        probe_radius: float,
        rolling_share: float,
    ) -> None:
        self.surface = surface
        self._follower = follower
        self._heading, self._across, self._up = axes
        self._origin = origin
        self._radius = probe_radius
        self._share = rolling_share
        self._reference = np.array(surface.point)
        self._first_pole = -np.array(surface.normal)

    def step(self, speed: float, depth: float, dt: float) -> ProbePose:
        """One servo cycle.

        Args:
            speed: contact speed over the surface, m/s.
            depth: wanted indentation, m.
            dt: servo period, s.

        Returns:
            The pose the probe must have when this cycle's command takes effect.
        """
        foot, normal = self.surface.foot(self._reference)
        if speed > 0 and self._follower is not None:
            foot, normal = self._march(self._follower, foot, normal, speed * dt)
        self._reference = foot
        pole = -(1 - self._share) * normal + self._share * self._first_pole
        return ProbePose(foot + normal * (self._radius - depth), pole / math.sqrt(float(pole @ pole)))

    def _march(
        self, follower: PathFollower, foot: Vector, normal: Vector, distance: float
    ) -> tuple[Vector, Vector]:
        offset = foot - self._origin
        steep = float(normal @ self._up)
        along, across = follower.step(
            float(self._heading @ offset), float(self._across @ offset), distance * max(steep, 0.2)
        )
        heading = self._heading * along + self._across * across
        tangent = heading - self._up * (float(normal @ heading) / max(steep, 0.2))
        tangent = tangent - normal * float(normal @ tangent)
        return self.surface.foot(foot + tangent * (distance / math.sqrt(float(tangent @ tangent))))

