"""The calibration of the emulated array's make, as `canprobe.studies.force_calibration` found it."""

from __future__ import annotations

import math

from canprobe.touch.pad_lag import Lag
from canprobe.touch.patch import PatchCalibration

FORCE_GAINS = {100e3: (0.905, 0.0714), 300e3: (0.835, 0.2444)}
"""Force gain and edge gain (√N) by full scale (Pa): six arrays, four shapes, 0.5–3 N, after 9 s of rolling contact.
On other arrays the force is then right within 0.2 % on average, 0.6 % (100 kPa) and 1.3 % (300 kPa) RMS."""

PAD_LAG = Lag(most=121e-6, reach=200e-6)
"""Least squares over scans of seven scenes, one array: centroids are then off by 24–40 µm RMS instead of 24–55 µm."""


def array_calibration(full_scale_pa: float, radius_m: float = 0.040) -> PatchCalibration:
    """Calibration of an array of this make; a full scale that was never pressed takes its nearest neighbour's gains.

    Args:
        full_scale_pa: as 2004h tells it.
        radius_m: of the probe that the array is wrapped on.
    """
    nearest = min(FORCE_GAINS, key=lambda pressed: abs(math.log(pressed / full_scale_pa)))
    force_gain, edge_gain = FORCE_GAINS[nearest]
    return PatchCalibration(full_scale_pa=full_scale_pa, radius_m=radius_m, force_gain=force_gain, edge_gain=edge_gain)
