"""Verify a calibration by a few touches of a ball: whether images and the arm's way still show what the file says.

Two signs, as one alone cannot tell: images of a known curvature do not show newtons, but the arm's way between two
forces does, and gains that drift by a tenth change the stiffness that it shows by a tenth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from canprobe.mechanics.touch.array_calibration.calibrate import at_usual_lightness, force_of, side_seen
from canprobe.mechanics.touch.array_calibration.parameter_fit import moment_errors
from canprobe.mechanics.touch.array_calibration.push_fit import stiffness_by_depth
from canprobe.mechanics.touch.array_calibration.touches import LAST_IMAGE_S, Dwell, what_is_shown
from canprobe.mechanics.touch.image.calibration import ArrayCalibration
from canprobe.mechanics.touch.image.image_model import make_image_model, make_patch_calibration
from canprobe.mechanics.touch.image.patch import PatchCalibration
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.pad import Pad

SIGMAS = 2.5
"""Standard deviations of what the file states, beyond which it does not hold."""
MIN_STIFFNESS_SIGMA = 0.05
"""Least relative standard deviation of the stiffness by three touches: of one place, and with hysteresis."""


@dataclass(frozen=True, slots=True)
class Verification:
    """What some touches show beside a calibration.

    Attributes:
        moments: RMS relative error of the images' second moments by the calibration.
        moments_sigma: what the calibration states for them.
        stiffness, stiffness_sigma: stiffness by the arm's way between the forces, N/m³; NaN where it was not seen.
        stated, stated_sigma: that of the calibration's own touches, N/m³.
    """

    moments: float
    moments_sigma: float
    stiffness: float
    stiffness_sigma: float
    stated: float
    stated_sigma: float

    @property
    def holds(self) -> bool:
        """Whether images and the arm's way show what the calibration says; not where the way shows no stiffness."""
        sigma = math.hypot(self.stiffness_sigma / self.stiffness, self.stated_sigma / self.stated)
        way_holds = self.stiffness > 0.0 and abs(math.log(self.stiffness / self.stated)) <= SIGMAS * sigma
        return way_holds and self.moments <= SIGMAS * self.moments_sigma


def verify_calibration(calibration: ArrayCalibration, dwells: Sequence[Dwell], pad: Pad) -> Verification:
    """Compare touches of one place with a calibration.

    Args:
        calibration: the calibration of the array, with the stiffness by its own touches' way.
        dwells: touches of a known object at one place with different forces.
        pad: taxels of the array.

    Raises:
        UsageError: a touch shows no patch.
    """
    plain = replace(PatchCalibration(pad), gains=calibration.gains)
    touches = [what_is_shown(dwell, plain, LAST_IMAGE_S) for dwell in dwells]
    patch = make_patch_calibration(calibration, pad)
    forces = [force_of(patch, s) for s in touches]
    model = make_image_model(calibration, patch, seen=side_seen(dwells))
    errors = moment_errors(model, touches, forces)[:, :2]
    k = calibration.stiffness
    found, sigma, *_ = stiffness_by_depth(touches, forces, pad.radius_m, (k.moments, k.moments_sigma))
    return Verification(
        moments=rms(at_usual_lightness(errors, touches)),
        moments_sigma=math.sqrt(calibration.moments.moment),
        stiffness=found,
        stiffness_sigma=math.hypot(sigma, MIN_STIFFNESS_SIGMA * found),
        stated=k.depth,
        stated_sigma=k.depth_sigma,
    )
