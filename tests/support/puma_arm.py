"""The PUMA 260 as its packaged cells describe it, and a posture that many tests begin in."""

import numpy as np

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve


def packaged_arm(cell):
    """Model of the arm of a packaged cell, and the bodies of its links."""
    truth = resolve(load_scene(cell)).truth
    return truth.model, truth.bodies


_BOTH = {cell: packaged_arm(cell) for cell in ("puma260", "puma260-unimate")}
MODELS = {cell: model for cell, (model, _) in _BOTH.items()}
BODIES = {cell: bodies for cell, (_, bodies) in _BOTH.items()}
UPENN = MODELS["puma260"]

ELBOW_FORM = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))
"""Well-conditioned, the flange pointing down at the scan region, rad: the start posture of the packaged cell."""
ELBOW_FORM.setflags(write=False)
