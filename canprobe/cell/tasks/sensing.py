"""Makes a contact of a measurement: joints at the sample's instant, patch, and the squeezed layer."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.patch_reader import PatchReader
from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.scene.setup import Arm, Array, Carrier, Probe
from canprobe.mechanics.robot.chain import ending_in, forward
from canprobe.mechanics.robot.model import ArmModel, position_sigma
from canprobe.mechanics.touch import MomentImage, contact_sample, indentation_from_force, make_patch_calibration
from canprobe.mechanics.touch.carrier import CarrierTrack
from canprobe.mechanics.touch.contact import HOLLOW_LIMIT_SHARE
from canprobe.mechanics.touch.image.moments import Moments
from canprobe.mechanics.touch.image.pad_lag import PadLag
from canprobe.mechanics.touch.image.silent_taxels import mended
from canprobe.mechanics.touch.layer_stiffness import stiffness_from_slope
from canprobe.mechanics.touch.stops import depth_on_bluntest
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch import ContactSample, Patch, Slope, SurfaceEstimate


MAX_STIFFNESS_RATIO = 6.0
"""Largest ratio of the measured slope and that of before any touch; the slope is limited to it. Squared for a flat
array, whose first slope knows neither layer nor object."""
HISTORY_CYCLES = 64
"""Cycles whose joints are kept."""
SPEED_OVER_NS = 10_000_000
"""Time over which the speed of the probe is taken."""


class JointHistory:
    """The last joint positions with their times, to be interpolated at a tactile sample's instant."""

    def __init__(self) -> None:
        self._times: deque[int] = deque(maxlen=HISTORY_CYCLES)
        self._joints: deque[Floats] = deque(maxlen=HISTORY_CYCLES)

    def add(self, t_ns: int, q: Floats) -> None:
        """Remember joint positions (n,), rad or m, at ``t_ns``; times must increase."""
        self._times.append(t_ns)
        self._joints.append(q)

    @property
    def newest(self) -> Floats:
        """Joint positions (n,), rad or m, that were added last."""
        return self._joints[-1]

    def at(self, t_ns: int) -> Floats | None:
        """Joint positions (n,), rad or m, at ``t_ns``, linear between SYNCs; None outside the history."""
        if not self._times or not self._times[0] <= t_ns <= self._times[-1]:
            return None
        i = bisect_right(self._times, t_ns) - 1
        if self._times[i] == t_ns:
            return self._joints[i]
        share = (t_ns - self._times[i]) / (self._times[i + 1] - self._times[i])
        return self._joints[i] + share * (self._joints[i + 1] - self._joints[i])


def curvature_sigma(estimate: SurfaceEstimate, i: int) -> float:
    """Standard deviation of principal curvature `i`, 1/m: that of K along its direction."""
    x, y = (estimate.T_frame_contact[:3, :2].T @ estimate.directions[i]).tolist()
    weight = np.array([x * x, 2.0 * x * y, y * y])
    return math.sqrt(max(float(weight @ estimate.covariance @ weight), 0.0))


def is_too_hollow(estimate: SurfaceEstimate, radius: float) -> bool:
    """Whether the object is, beyond doubt (3σ), as hollow as a probe of ``radius`` (m): no contact of one patch."""
    if not estimate.observed.all():
        return False
    return float(estimate.kappa[1]) + 3.0 * curvature_sigma(estimate, 1) < -HOLLOW_LIMIT_SHARE / radius


class ContactSensing:
    """Turns tactile samples into contacts in the frame in which the object stands still: base, or that of its carrier.

    Args:
        arm, probe, array: the arm, and what it touches with.
        force: wanted force, N.
        moments: the contacts have the second moments of their images.
        carrier: what the object moves with; None: it stands still.

    Attributes:
        model: the arm.
        flange_probe: transform (4, 4) from the probe's centre frame (z = pole) to the flange.
        radius: radius of the probe, m.
        stiffness: K/h of the layer, N/m³.
        slope: slope that the last touch showed; None before.
        track: where the carrier is in time; None without one.
    """

    def __init__(
        self, arm: Arm, probe: Probe, array: Array, force: float, *, moments: bool, carrier: Carrier | None = None
    ) -> None:
        calibration = make_patch_calibration(array.calibration, array.pad)
        self.model: ArmModel = arm.model
        self.flange_probe: Floats = probe.T_flange_probe
        self._chain = ending_in(arm.model.chain, probe.T_flange_probe)
        self.radius: float = probe.radius
        self.stiffness: float = probe.stiffness
        self.slope: Slope | None = None
        self._settled = True
        self.set_kappa(np.zeros(2))
        self._most_ratio = MAX_STIFFNESS_RATIO
        if probe.is_flat:  # how deep it goes is by the object's curvature, of which nothing is known before a touch
            self.set_depth_at_1_n(depth_on_bluntest(force, probe.stiffness, array.pad.reach_m) / math.sqrt(force))
            self._most_ratio **= 2
        self._first_slope = 1.0 / self._depth_at_1_n
        self.patch: Patch | None = None
        self.dropped = 0
        self.image_sigma: float | None = None
        """Standard deviation of the last centroid from image to image, m; None where the calibration states none."""
        self.reader = PatchReader(calibration)
        self._noise = array.calibration.noise
        moment_image = MomentImage(calibration)
        self._level_pa = moment_image.level_pa
        self._moment_image = moment_image if moments else None
        lag = array.calibration.centroid.lag
        self._lag = None if lag is None else PadLag(lag)
        self._history = JointHistory()
        self.track = None if carrier is None else CarrierTrack(carrier.motion)

    def step(self, measurement: Measurement) -> Patch | None:
        """Take one measurement; the patch of a new tactile sample, or None without one."""
        if measurement.q is not None:
            self._history.add(measurement.t_ns, measurement.q)
        if self.track is not None and measurement.carrier is not None:
            self.track.add(measurement.t_ns, measurement.carrier)
        if measurement.tactile is None:
            return None
        self.patch = self.reader.read(measurement.tactile)
        return self.patch

    def position_sigma(self, direction: Floats) -> float:
        """Standard deviation of the probe's position along a unit vector (3,), m: joints come in whole counts."""
        return position_sigma(self.model, self._history.newest, self.flange_probe, direction)

    def set_kappa(self, kappa: Floats, stiffness: float | None = None) -> None:
        """Take the object's principal curvatures (2,), 1/m, and the layer's stiffness as the estimator knows them.

        An estimate that is no contact of one patch any more (a hollow as tight as the probe) is taken at the limit.

        Args:
            kappa: principal curvatures, 1/m.
            stiffness: K/h, N/m³; None: the one that the last touch showed, or else as before.
        """
        possible = np.maximum(kappa, -HOLLOW_LIMIT_SHARE / self.radius)
        if stiffness is not None:
            self.stiffness = stiffness
        elif self.slope is not None and not self._settled:
            self.stiffness = stiffness_from_slope(self.slope.value, self.radius, possible)
        self._settled = True
        self._depth_at_1_n = float(indentation_from_force(1.0, self.stiffness, self.radius, possible))

    def set_depth_at_1_n(self, depth: float) -> None:
        """Place contacts as another sensing did that had this depth at 1 N, m."""
        self._depth_at_1_n = depth

    def set_slope(self, slope: Slope) -> None:
        """Take the slope that a touch showed; depths follow from it until the object's curvature is known."""
        least, most = self._first_slope / self._most_ratio, self._first_slope * self._most_ratio
        self.slope = slope._replace(value=min(max(slope.value, least), most))
        self._settled = False
        self._depth_at_1_n = 1.0 / self.slope.value

    def depth(self, force: float) -> float:
        """Indentation (m) of the layer at ``force`` (N) on the curvature known so far: the root of the force."""
        return self._depth_at_1_n * math.sqrt(force) if force > 0 else 0.0

    def probe_at(self, t_ns: int) -> Floats | None:
        """The probe (4, 4) at a time of the last cycles; None where joints or carrier of that time are unknown."""
        if (q := self._history.at(t_ns)) is None or (self.track is not None and not self.track.is_known):
            return None
        T_base_probe = forward(self._chain, q)
        if self.track is None:
            return T_base_probe
        return np.asarray(np.linalg.inv(self.track.T_base_carrier(t_ns)) @ T_base_probe)

    def contact(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        """The contact at the sample's instant, or None (counted) where the joints of that instant are unknown."""
        T_base_probe = self.probe_at(sample.t_sample_ns)
        if T_base_probe is None:
            self.dropped += 1
            return None
        t_s, uv = sample.t_sample_ns * 1e-9, (patch.u, patch.v)
        depth = self.depth(patch.force)
        # over the peak of the layer at this depth: that of one image has the noise of one taxel, and steers the servo
        lightness = self._level_pa / (self.stiffness * depth) if depth > 0.0 else 1.0
        image_sigma = self._noise.image(lightness)
        self.image_sigma = None if self._noise.assumed else image_sigma
        found = contact_sample(
            t_s=t_s,
            T_base_probe=T_base_probe,
            uv=uv if self._lag is None else self._lag.step(t_s, *uv, sigma=image_sigma),
            depth=depth,
            radius=self.radius,
            force_n=patch.force,
            sigma_point=self._noise.lateral(lightness),
            moments=self._moments(patch),
            doubts=patch.doubts,
            slope=self.slope,
            sigma_height=self._noise.height,
            sigma_slow=self._noise.slow,
        )
        if not sample.t_sigma_s:
            return found
        return replace(found, sigma_motion=sample.t_sigma_s * self._speed(sample.t_sample_ns, found))

    def _speed(self, t_ns: int, contact: ContactSample) -> float:
        """Speed of the probe at the contact, m/s: errors of the instant displace a contact by it; 0 without a past."""
        earlier = self.probe_at(t_ns - SPEED_OVER_NS)
        if earlier is None:
            return 0.0
        point = np.append(contact.r_probe, 1.0)
        way = ((contact.T_base_probe - earlier) @ point)[:3]
        return float(np.linalg.norm(way)) / (1e-9 * SPEED_OVER_NS)

    def leave_out_moments(self) -> None:
        """Give contacts no moments from here on: the images' model is another array's."""
        self._moment_image = None

    def _moments(self, patch: Patch) -> Moments | None:
        """Second moments of the image; None where they are not wanted, or not those of the whole patch."""
        if self._moment_image is None or patch.saturated or patch.cut_by_pad or patch.too_few:
            return None
        return self._moment_image.moments(mended(self.reader.image)[0] if patch.dead else self.reader.image)
