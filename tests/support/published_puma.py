"""The PUMA 260 in two published geometries, as numbers: what the packaged cells say, written again by hand.

Joint stops, speeds, torques and friction are those of the cell; the Denavit-Hartenberg rows are (a, alpha, d, theta).
"""

import math

import numpy as np

from canprobe.mechanics.robot.denavit_hartenberg import from_dh
from canprobe.mechanics.robot.model import ArmModel, Joint

RIGHT = math.pi / 2
_ROWS = {
    "puma260": (
        (0.0, RIGHT, 0.3302, 0.0),
        (0.2032, 0.0, -0.0635, 0.0),
        (0.0, -RIGHT, -0.0635, 0.0),
        (0.0, RIGHT, 0.2032, 0.0),
        (0.0, -RIGHT, 0.0, 0.0),
        (0.0, 0.0, 0.0635, 0.0),
    ),
    "puma260-unimate": (
        (0.0, RIGHT, 0.3302, 0.0),
        (0.19812, 0.0, -0.12446, 0.0),
        (-0.01905, -RIGHT, 0.0, 0.0),
        (0.0, RIGHT, 0.2032, 0.0),
        (0.0, -RIGHT, 0.0, 0.0),
        (0.0, 0.0, 0.05588, 0.0),
    ),
}
# stops and speed in degrees; rated torque Nm, rotor inertia at the joint kg m², Coulomb Nm, viscous Nm s
_JOINTS = (
    (-180.0, 110.0, 210.0, 6.4, 0.03, 2.2, 0.32),
    (-75.0, 240.0, 210.0, 6.4, 0.088, 1.1, 0.52),
    (-235.0, 60.0, 210.0, 6.4, 0.022, 0.57, 0.22),
    (-580.0, 40.0, 675.0, 1.4, 0.0072, 0.1, 0.023),
    (-30.0, 200.0, 675.0, 0.7, 0.0064, 0.083, 0.023),
    (-215.0, 295.0, 1350.0, 0.7, 0.0073, 0.064, 0.012),
)
# motor counts per turn of each joint, and of the wrist's motors per turn of a joint before theirs
_MOTOR_COUNTS = (1000, 1000, 1000, 800, 800, 800)
_GEARS = np.diag((46.72, 69.9733, 42.9867, 43.5111, 39.3846, 31.7692))
_COUPLING = {(4, 3): -9.8462, (5, 3): 1.0, (5, 4): -5.6}


def _model(name):
    names = tuple(f"joint_{number}" for number in range(1, 7))
    joints = [
        Joint(joint, False, *(math.radians(value) for value in numbers[:3]), *numbers[3:])
        for joint, numbers in zip(names, _JOINTS, strict=True)
    ]
    units = _GEARS.copy()
    for place, turns in _COUPLING.items():
        units[place] = turns
    units *= np.array(_MOTOR_COUNTS)[:, None] / (2 * math.pi)
    chain = from_dh(_ROWS[name], name=name)
    return ArmModel(chain, tuple(joints), units, np.zeros(6))


MODELS = {name: _model(name) for name in _ROWS}
UPENN = MODELS["puma260"]

ELBOW_FORM = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))
"""Well-conditioned, the flange pointing down at the scan region, rad."""
ELBOW_FORM.setflags(write=False)
