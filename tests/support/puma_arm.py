"""The PUMA 260 as its packaged cells describe it, and a posture and a place that many tests begin in."""

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.probe_poses import start_posture


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

POINT, TOOL = np.array((-0.120, -0.1225, 0.374)), tool_z_offset(80.0)
"""Place of the packaged scenes' objects, m, and the probe's centre in the flange frame."""


def pressing(shape, depth, point=POINT, **settings):
    """A plant's configuration: the probe of 40 mm above a point, and as deep in the object there, m."""
    q0 = start_posture(UPENN, point, (0, 0, 1), ELBOW_FORM, radius_m=0.04, T_flange_probe=TOOL, clearance_m=-depth)
    return PlantConfig(UPENN, q0, object=shape, bodies=BODIES["puma260"], **settings)
