"""The calibrations of the emulated array's make, as `tests/support/array_calibration.py` found them."""

from __future__ import annotations

import math

from canprobe.touch.pad import Pad
from canprobe.touch.patch.image import PatchCalibration
from canprobe.touch.patch.moments import Lag, MomentFit, MomentImage, MomentModel

FORCE_GAINS = {100e3: (0.905, 0.0714), 300e3: (0.835, 0.2444)}
"""Force gain and edge gain (√N) by full scale (Pa): six arrays, four shapes, 0.5–3 N, after 9 s of rolling contact.
On other arrays the force is then right within 0.2 % on average, 0.6 % (100 kPa) and 1.3 % (300 kPa) RMS."""

PAD_LAG = Lag(most=121e-6, reach=200e-6)
"""Least squares over scans of seven scenes, one array: centroids are then off by 24–40 µm RMS instead of 24–55 µm."""


def array_calibration(pad: Pad) -> PatchCalibration:
    """Calibration of an array of this make; a full scale that was never pressed takes its nearest neighbour's gains."""
    nearest = min(FORCE_GAINS, key=lambda pressed: abs(math.log(pressed / pad.full_scale_pa)))
    force_gain, edge_gain = FORCE_GAINS[nearest]
    return PatchCalibration(pad, force_gain=force_gain, edge_gain=edge_gain)


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
        (
            0.4593,
            0.8814,
            0.07226,
            -4.532,
            0.06385,
            0.06232,
            -2.071,
            -0.04385,
            -0.01477,
            -0.009868,
            -0.007266,
            0.007115,
            0.1049,
            22.99,
            0.1006,
        ),
        0.9972,
        _floor(0.000104, 1.48e-05, 3.97e-05, 8.65e-06, 0.000338),
        0.0118,
        (0.485, 3.19),
        (0.0243, 0.0966),
        0.0288,
    ),
    (100e3, False): MomentFit(
        (
            0.4369,
            0.9644,
            0.06109,
            -4.604,
            0.004902,
            0.03966,
            -2.049,
            -0.02964,
            -0.000787,
            -0.002535,
            -0.005085,
            0.003983,
            0.1025,
            23.95,
            0.05449,
        ),
        0.9989,
        _floor(8.52e-05, 9.83e-06, 3.65e-05, 1.66e-06, 0.000283),
        0.0117,
        (0.485, 4.83),
        (0.0243, 0.0966),
        0.0294,
    ),
    (300e3, True): MomentFit(
        (
            0.3864,
            0.8312,
            0.09098,
            -2.334,
            0.02763,
            0.08321,
            -1.04,
            -0.05888,
            -0.003025,
            -0.004111,
            -0.01446,
            0.01011,
            0.1107,
            3.554,
            -0.03444,
        ),
        1.0089,
        _floor(0.000248, 2.62e-05, 0.000125, 4.09e-05, 0.000541),
        0.0271,
        (0.485, 3.19),
        (0.073, 0.29),
        0.0199,
    ),
    (300e3, False): MomentFit(
        (
            0.4063,
            0.8383,
            0.05245,
            -2.372,
            0.02267,
            0.07951,
            -1.03,
            -0.03563,
            -0.001353,
            -0.004803,
            -0.01229,
            0.005401,
            0.126,
            3.575,
            -0.04089,
        ),
        1.0078,
        _floor(0.000251, 2.35e-05, 0.000126, 4.32e-05, 0.000559),
        0.0273,
        (0.485, 4.83),
        (0.073, 0.29),
        0.0201,
    ),
}
"""By full scale (Pa) and whether only the 8×8 window is seen: 600 presses each (seed 1), every one on an array of its
own, κ −12 … 60 1/m, 0.7–3.2 N, 2.5–12 s at rest or rolling. Single presses are off by 0.9 % (100 kPa) and 1.4 %
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
