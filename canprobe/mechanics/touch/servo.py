"""The tactile servo, from contact samples to the pose of the probe.

The surface stands still while the probe moves. So a local model of the surface (point, normal, curvature) is corrected
by every tactile sample *at the instant it was sampled*; the pose that will hold the wanted indentation is then read off
that model, however late the command takes effect. Why not close the loop on the force itself: with the whole delay of
about 27 ms feedback alone has 2 to 4.5 Hz of bandwidth, and at 25 mm/s a slope would lift the probe off.

Force is regulated as indentation: one elastic law turns measured force and wanted force into depth. Why not by a gain
in N/m: on a spherical probe the force grows with the square of the depth, so a fixed gain would be right at one force.
A wrong stiffness then leaves no steady error; it only changes the loop's gain. With a relative error e the delayed loop
has the gain |e|, so it is stable for any delay while the stiffness is known to better than a factor of two.

Source: Chen, Rink and Zhang, section 4.2 (five steps around (36)), with a damped inverse instead of ``J`` in step 4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.robot.motion_profile import smooth_step
from canprobe.mechanics.touch.checks import checked, positive
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.strategies import PathFollower, Strategy
from canprobe.mechanics.touch.tangent_frames import homogeneous, transported
from canprobe.mechanics.types import Floats

MIN_SLOPE_COSINE = 0.2
"""Least cosine between surface normal and approach direction, 78 degrees: a steeper slope is taken as this steep."""
LONGEST_GAP_S = 0.02
"""Longest gap between two contacts for the servo's surface: after a longer gap it does not rest on one sample alone."""
BLIND_S = 0.1
"""Time without a contact after which `TactileServo.step` holds the contact where it is, s."""
SETTLE_S = 0.5
"""Time at rest in contact before a scan, s."""
RAMP_S = 0.05
"""Time to reach the scan's speed, at its begin and where its path has turned back."""
BRAKE_M = 1e-3
"""Way on which `TactileServo.step` brakes before a path that turns back at once, m."""
SINK_SPEED = 4e-3
"""Speed of `TactileServo.step` out of a first touch that went too deep, m/s."""

TARGET_RATES = {"target_force_n": 2.0, "speed_m_s": 0.1}
"""Highest rates at which targets change, N/s and m/s²: a jump is a ramp in time. At 2 N/s the delay of 27 ms leaves the
force 0.05 N behind, as much as the servo errs at rest."""


@dataclass(frozen=True, slots=True)
class SurfaceGains:
    """How fast the servo's local surface follows the tactile samples.

    Args:
        height_hz: bandwidth of the height correction, Hz.
        tilt_hz: bandwidth of the normal's correction, Hz.
        curvature_hz: bandwidth with which a new curvature is adopted, Hz. Why not at once: the normal ahead of the
            last sample would jump by the change of curvature times that distance, and the probe with it.
    """

    height_hz: float = 8.0
    tilt_hz: float = 6.0
    curvature_hz: float = 5.0


class LocalSurface:
    """The surface near the contact: ``a + d − ½ (dᵀ K d) m`` over the tangent plane at ``a`` with outward normal ``m``.

    It is of second order only: true within a few millimetres of the last sample, and the servo looks no further ahead.
    Why not the estimator's surface itself: that is 0.4 ms of work and comes after some path, while height and tilt must
    follow every sample from the first one on. Only its curvature is taken over (`set_curvature`).

    Args:
        point: a point of the surface (3,), m.
        normal: outward unit normal there (3,).
        gains: correction bandwidths.
    """

    def __init__(self, point: Floats, normal: Floats, gains: SurfaceGains) -> None:
        self._point: Sequence[float]
        self._normal: Sequence[float]
        self.move_to(point, normal)
        self._curvature = self._wanted = [0.0] * 6  # xx, xy, xz, yy, yz, zz
        self._gains = gains

    @property
    def point(self) -> Floats:
        """Point (3,) of the surface at which the model is expanded, m."""
        return np.array(self._point)

    @property
    def normal(self) -> Floats:
        """Outward unit normal (3,) there."""
        return np.array(self._normal)

    def foot(self, x: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        """Surface point (m) and outward unit normal where a line along the model's normal through a point (m) meets it.

        Plain floats are used, as numpy costs ten times as much on 3-vectors.
        """
        a0, a1, a2 = self._point
        m0, m1, m2 = self._normal
        d0, d1, d2 = x[0] - a0, x[1] - a1, x[2] - a2
        height = d0 * m0 + d1 * m1 + d2 * m2
        d0, d1, d2 = d0 - height * m0, d1 - height * m1, d2 - height * m2
        k00, k01, k02, k11, k12, k22 = self._curvature
        b0 = k00 * d0 + k01 * d1 + k02 * d2
        b1 = k01 * d0 + k11 * d1 + k12 * d2
        b2 = k02 * d0 + k12 * d1 + k22 * d2
        sag = 0.5 * (d0 * b0 + d1 * b1 + d2 * b2)
        n0, n1, n2 = m0 + b0, m1 + b1, m2 + b2
        size = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        return (
            (a0 + d0 - sag * m0, a1 + d1 - sag * m1, a2 + d2 - sag * m2),
            (n0 / size, n1 / size, n2 / size),
        )

    def correct(self, point: Floats, normal: Floats, dt: float) -> float:
        """Expand the model at a measured contact, and correct its height, normal and curvature towards it.

        Each is corrected by the share `1 − exp(−2π f dt)` of a first-order filter of its bandwidth f, which is right
        for samples at any spacing.

        Args:
            point: (3,) measured contact point, m.
            normal: (3,) measured outward unit normal.
            dt: time since the last sample, s.

        Returns:
            Height error before the correction, m, positive where the surface was found higher than modelled.

        Raises:
            UsageError: `dt` is negative.
        """
        if dt < 0:
            raise UsageError(f"dt: expected a time that has passed, got {dt:g} s")
        p0, p1, p2 = p = point.tolist()
        n0, n1, n2 = normal.tolist()
        (f0, f1, f2), (m0, m1, m2) = self.foot(p)
        error: float = m0 * (p0 - f0) + m1 * (p1 - f1) + m2 * (p2 - f2)
        height = 1 - math.exp(-2 * math.pi * self._gains.height_hz * dt)
        tilt = 1 - math.exp(-2 * math.pi * self._gains.tilt_hz * dt)
        self._point = f0 + m0 * height * error, f1 + m1 * height * error, f2 + m2 * height * error
        self._normal = _unit((m0 + (n0 - m0) * tilt, m1 + (n1 - m1) * tilt, m2 + (n2 - m2) * tilt))
        share = 1 - math.exp(-2 * math.pi * self._gains.curvature_hz * dt)
        self._curvature = [k + share * (w - k) for k, w in zip(self._curvature, self._wanted, strict=True)]
        return error

    def raise_by(self, height: float) -> None:
        """Move the model outward along its normal by a height, m, as when all samples so far turn out to lie higher."""
        (a0, a1, a2), (m0, m1, m2) = self._point, self._normal
        self._point = a0 + height * m0, a1 + height * m1, a2 + height * m2

    def move_to(self, point: Floats, normal: Floats) -> None:
        """Expand the model at another point (3,), m, with an outward unit normal (3,); the curvature is kept."""
        self._point = tuple(point.tolist())
        self._normal = _unit(normal.tolist())

    def set_curvature(self, tensor: Floats) -> None:
        """Adopt, with the next samples, a curvature tensor (3, 3), symmetric, 1/m, in the same frame."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor.tolist()
        self._wanted = [xx, xy, xz, yy, yz, zz]


@dataclass(frozen=True, slots=True)
class ProbePose:
    """Pose of the probe but for the turn about its pole: centre (3,), m, and unit vector (3,) of the pole, in base."""

    centre: Floats
    pole: Floats

    def moved(self, T: Floats) -> ProbePose:
        """The pose that a transform (4, 4) makes of this one."""
        return ProbePose(T[:3, :3] @ self.centre + T[:3, 3], T[:3, :3] @ self.pole)


class TactileServo:
    """Marches a reference contact over the local surface and gives the pose of the probe that holds it.

    The reference is carried from cycle to cycle and does not start from the measured contact. Why not from that one:
    its noise and its delay would enter the speed, and each cycle would step back by the path of the delay.

    Alone, for any arm that takes poses, it begins on a first contact, and a cycle is one step:

        weave = Weave(0.030, 0.008, 0.012)
        servo = TactileServo.on(contact, weave, (1.0, 0.0, 0.0), radius=0.040, depth=0.4e-3)
        servo.speed = 0.020
        T_base_flange = servo.step(contact, dt) @ np.linalg.inv(T_flange_probe)

    A cell has phases of its own round `take` and `next_pose`, of which a step is made. Limits of force, way and joints
    are the caller's, and so is the way off the object.

    Args:
        surface: the local surface, corrected by the caller with every tactile sample.
        follower: path that gives the heading in the scan plane; None to hold the contact where it is.
        axes: (3, 3) rows: heading, across, approach normal of the scan plane, in the base frame.
        origin: (3,) origin of the scan plane's curve, m.
        probe_radius: radius of the undeformed probe, m.
        rolling_share: 0 if the pad follows the normal, 1 if it keeps its first orientation, or between. Why not always
            0: to follow the normal takes joint speeds that an arm may not have.

    Attributes:
        taken_s: time of the last contact that was taken, s; −∞ before.
        depth: indentation that `step` holds, m; of a force (N) it is `indentation_from_force`.
        speed: speed of the contact over the surface in `step`, m/s; 0 at first. It counts from `SETTLE_S` after the
            first step on.
        travelled: path of the reference contact over the surface, m.
    """

    depth = speed = _t = _blind = 0.0
    _first: ContactSample

    def __init__(
        self,
        surface: LocalSurface,
        follower: PathFollower | None,
        *,
        axes: Floats,
        origin: Floats,
        probe_radius: float,
        rolling_share: float = 0.0,
    ) -> None:
        self.surface = surface
        self.travelled = 0.0
        self._follower = follower
        self._heading, self._across, self._up = axes.tolist()
        self._origin = origin.tolist()
        self._radius = probe_radius
        self._share = rolling_share
        self._reference: Sequence[float] = tuple(surface.point.tolist())
        self._first_pole = (-surface.normal).tolist()
        self.taken_s = -math.inf

    @classmethod
    def on(
        cls, contact: ContactSample, strategy: Strategy | None, along: ArrayLike, *, radius: float, depth: float
    ) -> TactileServo:
        """A servo that begins on a first contact, for `step`; the pad follows the normal.

        Args:
            contact: the contact; its plane is the scan plane, its place the origin of the curve.
            strategy: curve to follow (`Weave`, `Circle`, `Straight`, or your own); None holds the contact.
            along: (3,) direction in base of the curve's heading; it is laid on the scan plane.
            radius: radius of the undeformed probe, m.
            depth: indentation to hold, m; it is reached 0.3 s after the first step.

        Raises:
            UsageError: a value is no finite number, or the radius is not above 0.
        """
        point, normal = checked("contact.p_base", contact.p_base, (3,)), checked("contact.n_base", contact.n_base, (3,))
        axes = np.array([*transported(checked("along", along, (3,)).tolist(), normal.tolist()), normal])
        surface = LocalSurface(point, normal, SurfaceGains())
        follower = None if strategy is None else PathFollower(strategy, BRAKE_M)
        servo = cls(surface, follower, axes=axes, origin=point, probe_radius=positive("radius", radius))
        servo.depth, servo._first = positive("depth", depth), contact
        return servo

    def step(self, contact: ContactSample | None, dt: float) -> Floats:
        """The pose of the probe for the next command, from a servo that was made by `on`.

        Feed-forward of the curvature is `surface.set_curvature(estimate.curvature_tensor_base())`, with an estimate
        that has observed all of it.

        Args:
            contact: the newest contact, in base; None in a cycle without one. One that is not newer than the last, or
                that an image without a patch gave (NaN), counts as none. After `BLIND_S` without any the contact is
                held where it is.
            dt: time since the last step, s.

        Returns:
            T_base_probe (4, 4), m: origin at the sphere's centre, z through the pole of the pad, x as near to that of
            the first contact as z allows.

        Raises:
            UsageError: dt is not above 0.
        """
        self._t, self._blind = self._t + positive("dt", dt), self._blind + dt
        if contact is not None and contact.t_s > self.taken_s and np.isfinite((contact.p_base, contact.n_base)).all():
            self.take(contact, dt)
            self._blind = 0.0
        pace = min(max(self._t - SETTLE_S, 0.0) / RAMP_S, 1.0) if self._blind < BLIND_S else 0.0
        x_axis, _, pole, centre = self._first.T_base_probe[:3].T
        sinking = Sinking(self._first, ProbePose(centre, pole), self._radius)
        share = sinking.share(self._t, self.depth, SINK_SPEED)
        pose = sinking.pose(self, share, self.depth, dt, self.speed * pace)
        return homogeneous(np.array([*transported(x_axis.tolist(), pose.pole.tolist()), pose.pole]).T, pose.centre)

    def take(self, contact: ContactSample, first_s: float) -> None:
        """Correct the surface by a contact, of which the first counts for a time, s, and none for more than a gap."""
        elapsed = contact.t_s - self.taken_s if self.taken_s > -math.inf else first_s
        self.surface.correct(contact.p_base, contact.n_base, min(elapsed, LONGEST_GAP_S))
        self.taken_s = contact.t_s

    def rest_on(self, point: Floats, normal: Floats) -> None:
        """Continue from another contact: its point (3,), m, and outward unit normal (3,); the curvature is kept."""
        self.surface.move_to(point, normal)
        self._reference = tuple(point.tolist())

    def next_pose(self, speed: float, depth: float, dt: float) -> ProbePose:
        """The pose that the probe must have when this cycle's command takes effect.

        Args:
            speed: speed of the contact over the surface, m/s.
            depth: wanted indentation, m.
            dt: servo period, s.
        """
        foot, normal = self.surface.foot(self._reference)
        if speed > 0 and self._follower is not None:
            distance = speed * self._follower.pace * dt
            foot, normal = self._march(self._follower, foot, normal, distance)
            self.travelled += distance
        self._reference = foot
        reach, share = self._radius - depth, self._share
        (f0, f1, f2), (n0, n1, n2), (p0, p1, p2), flat = foot, normal, self._first_pole, 1 - share
        pole = _unit((share * p0 - flat * n0, share * p1 - flat * n1, share * p2 - flat * n2))
        return ProbePose(np.array((f0 + reach * n0, f1 + reach * n1, f2 + reach * n2)), np.array(pole))

    def _march(
        self, follower: PathFollower, foot: Sequence[float], normal: Sequence[float], distance: float
    ) -> tuple[Sequence[float], Sequence[float]]:
        """One step along the heading, lifted from the scan plane into the tangent plane."""
        # on a slope the step in the scan plane is shorter than the distance, so that the speed over the surface is the
        # wanted one
        (h0, h1, h2), (c0, c1, c2), (u0, u1, u2) = self._heading, self._across, self._up
        (f0, f1, f2), (n0, n1, n2), (o0, o1, o2) = foot, normal, self._origin
        d0, d1, d2 = f0 - o0, f1 - o1, f2 - o2
        steep = max(n0 * u0 + n1 * u1 + n2 * u2, MIN_SLOPE_COSINE)
        slope_along = (n0 * h0 + n1 * h1 + n2 * h2) / steep
        slope_across = (n0 * c0 + n1 * c1 + n2 * c2) / steep
        # the slope is that along the last heading: for the next one the follower must know the distance first
        along, across = follower.heading
        in_plane = distance / math.hypot(1.0, slope_along * along + slope_across * across)
        along, across = follower.step(h0 * d0 + h1 * d1 + h2 * d2, c0 * d0 + c1 * d1 + c2 * d2, in_plane)
        x, y, z = along * h0 + across * c0, along * h1 + across * c1, along * h2 + across * c2
        fall = slope_along * along + slope_across * across
        x, y, z = x - fall * u0, y - fall * u1, z - fall * u2
        # 0 but where `MIN_SLOPE_COSINE` has limited the slope: there the lifted step is not in the tangent plane
        out = n0 * x + n1 * y + n2 * z
        x, y, z = _unit((x - out * n0, y - out * n1, z - out * n2))
        return self.surface.foot((f0 + distance * x, f1 + distance * y, f2 + distance * z))


class Sinking:
    """The way from a first touch to the wanted depth, without a bump: it begins as deep and with the pole as it was.

    Args:
        contact: the first contact.
        pose: pose of the probe then.
        radius: radius of the probe, m.
        lever: distance from the probe's centre to the point that its pole turns about, m: a sphere turns about its
            centre. A flat pad turns about its tip: about a centre 10 m away a count of an encoder is a millimetre.

    Attributes:
        depth: depth at which it begins, m.
    """

    def __init__(self, contact: ContactSample, pose: ProbePose, radius: float, lever: float = 0.0) -> None:
        self.depth = radius - float(contact.n_base @ (pose.centre - contact.p_base))
        self._pole, self._lever = pose.pole, lever

    def share(self, t: float, depth: float, speed: float) -> float:
        """Share of the way to a depth, m, after a time, s. Out of a touch that went too deep it is as fast as in."""
        too_deep = self.depth - depth
        if too_deep <= 0.0:
            return smooth_step(t / (0.6 * SETTLE_S))
        return min(1.0, t * speed / too_deep)

    def pose(self, servo: TactileServo, share: float, depth: float, dt: float, speed: float = 0.0) -> ProbePose:
        """The servo's next pose at a speed, m/s, with a share of the way to a depth, m, gone."""
        pose = servo.next_pose(speed, self.depth + share * (depth - self.depth), dt)
        pole = self._pole + share * (pose.pole - self._pole)
        pole /= np.linalg.norm(pole)
        return ProbePose(pose.centre + self._lever * (pose.pole - pole), pole)


def _unit(v: Sequence[float]) -> Sequence[float]:
    x, y, z = v
    size = math.sqrt(x * x + y * y + z * z)
    return x / size, y / size, z / size
