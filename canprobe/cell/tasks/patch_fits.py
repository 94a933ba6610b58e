"""What `canprobe.studies.patch_calibration` found for the emulated array's make, and the model that it makes."""

from __future__ import annotations

import math

from canprobe.touch.patch import PatchCalibration
from canprobe.touch.patch_image import MomentImage
from canprobe.touch.patch_moments import MomentFit, MomentModel


def _floor(moment: float, both: float, shear: float, with_force: float, force: float) -> tuple[tuple[float, ...], ...]:
    """Relative covariance of the moments along both axes of the patch, of its shear and of the force."""
    return (
        (moment, both, 0.0, with_force),
        (both, moment, 0.0, with_force),
        (0.0, 0.0, shear, 0.0),
        (with_force, with_force, 0.0, force),
    )


MOMENT_FITS = {
    (100e3, True): MomentFit(
        (0.3225, 1.053, 0.07395, -1.89, -0.01902, 0.005803, -2.041, -0.01627),
        0.9972,
        _floor(0.000167, 2.87e-05, 5.11e-05, -2.57e-06, 0.00024),
        0.0118,
        (0.485, 3.19),
        (0.0243, 0.0966),
    ),
    (100e3, False): MomentFit(
        (0.3716, 1.008, 0.04256, -1.949, -0.002796, 0.01135, -2.06, -0.008528),
        0.9989,
        _floor(0.000162, 3.3e-05, 4.83e-05, -8.45e-06, 0.00021),
        0.0117,
        (0.485, 4.83),
        (0.0243, 0.0966),
    ),
    (300e3, True): MomentFit(
        (0.2264, 0.9509, 0.097, -0.9113, -0.002006, 0.01917, -1.235, -0.02384),
        1.0089,
        _floor(0.000308, 5.8e-05, 0.000121, 1.02e-05, 0.00042),
        0.0271,
        (0.485, 3.19),
        (0.073, 0.29),
    ),
    (300e3, False): MomentFit(
        (0.2532, 0.9495, 0.05852, -0.8901, -0.0003916, 0.02044, -1.265, -0.01259),
        1.0078,
        _floor(0.000328, 6.33e-05, 0.000117, 6.33e-06, 0.00042),
        0.0273,
        (0.485, 4.83),
        (0.073, 0.29),
    ),
}
"""By full scale (Pa) and whether only the 8×8 window is seen: 600 presses each (seed 1), every one on an array of its
own, κ −12 … 60 1/m, 0.7–3.2 N, 2.5–12 s at rest or rolling. Single presses are off by 1.3 % (100 kPa) and 1.8 %
(300 kPa) RMS in a moment and by 1.5 and 2 % in the force: that is the floor."""


def moment_model(calibration: PatchCalibration, stiffness_n_m3: float, *, windowed: bool) -> MomentModel:
    """Model of an array of this make; a full scale that was never pressed takes its nearest neighbour's fit.

    Args:
        calibration: of the array.
        stiffness_n_m3: K/h of the layer.
        windowed: only the 8×8 window is seen.
    """
    full_scale = calibration.full_scale_pa
    pressed = min((f for f, _ in MOMENT_FITS), key=lambda f: abs(math.log(f / full_scale)))
    level_pa = MomentImage(calibration).level_pa
    return MomentModel(
        MOMENT_FITS[pressed, windowed], calibration.radius_m, stiffness_n_m3, level_pa, calibration.pitch_m
    )
