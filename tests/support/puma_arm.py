"""A posture of the PUMA 260 that many tests begin in."""

import numpy as np

ELBOW_FORM = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))
"""Well-conditioned, the flange pointing down at the scan region, rad: the start posture of the packaged cell."""
ELBOW_FORM.setflags(write=False)
