"""The PUMA 260 as data: two published geometries with joint ranges, speeds, motors, friction, encoder counts, bodies.

The geometries disagree by millimetres, which makes their difference a realistic calibration error. Zero positions and
ranges of the joints follow the UPenn convention in both.

Source: gear ratios and wrist coupling of the PUMA 200 series as used by YARP's Babybot driver; motors and friction of a
PUMA 560 (Corke & Armstrong-Helouvry 1994) scaled by size; continuous torques of a CRS A255-like arm. No maker ever
published the masses of the links: they are the 560's too, lengths times 0.4706 and masses times 0.17.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from canprobe.robot.chain import Array, from_dh
from canprobe.robot.model import ArmModel, Body, Joint

_INCH = 0.0254
_Q_MIN_DEG = (-180.0, -75.0, -235.0, -580.0, -30.0, -215.0)
_Q_MAX_DEG = (110.0, 240.0, 60.0, 40.0, 200.0, 295.0)
_QD_MAX_DEG_S = (210.0, 210.0, 210.0, 675.0, 675.0, 1350.0)
_TORQUE_NM = (6.4, 6.4, 6.4, 1.4, 0.7, 0.7)
_ROTOR_KG_M2 = (0.030, 0.088, 0.022, 0.0072, 0.0064, 0.0073)
_COULOMB_NM = (2.2, 1.1, 0.57, 0.10, 0.083, 0.064)
_VISCOUS_NMS = (0.32, 0.52, 0.22, 0.023, 0.023, 0.012)
_COUNTS_PER_TURN = (1000, 1000, 1000, 800, 800, 800)
_MOTOR_TURNS = (
    (46.72, 0.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 69.9733, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 42.9867, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 43.5111, 0.0, 0.0),
    (0.0, 0.0, 0.0, -9.8462, 39.3846, 0.0),  # joint 4 drags the motors of joints 5 and 6 along,
    (0.0, 0.0, 0.0, 1.0, -5.6, 31.7692),  # joint 5 that of joint 6
)
"""Of each motor (row) per turn of each joint (column)."""
_MASS_KG = (0.0, 2.97, 0.82, 0.140, 0.058, 0.015)
_COM_MM = (
    (0.0, 0.0, 0.0),
    (-171.0, 2.8, -107.0),  # z is counted from joint 1's axis: the 560's, mirrored
    (-9.6, 6.6, 33.0),  # y mirrored
    (0.0, 8.9, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 15.0),
)
"""In the frames of standard Denavit-Hartenberg rows, which lie behind the links; of link 2 z as noted."""
_INERTIA_KG_MM2 = (
    (0.0, 13180.0, 0.0),
    (4890.0, 19730.0, 20290.0),
    (2480.0, 3240.0, 470.0),
    (68.0, 49.0, 68.0),
    (11.0, 15.0, 11.0),
    (5.6, 5.6, 1.5),
)
"""About the centres of mass, along the axes of the same frames."""


def _dh_rows(*, a2: float, a3: float, d2: float, d3: float, d6: float) -> Array:
    right = math.pi / 2
    a, alpha = (0.0, a2, a3, 0.0, 0.0, 0.0), (right, 0.0, -right, right, -right, 0.0)
    return np.column_stack((a, alpha, (13 * _INCH, d2, d3, 8 * _INCH, 0.0, d6), np.zeros(6)))


DH_ROWS: Mapping[str, Array] = MappingProxyType(
    {
        "upenn": _dh_rows(a2=8 * _INCH, a3=0.0, d2=-2.5 * _INCH, d3=-2.5 * _INCH, d6=2.5 * _INCH),
        "unimate": _dh_rows(a2=7.8 * _INCH, a3=-0.75 * _INCH, d2=-4.9 * _INCH, d3=0.0, d6=2.2 * _INCH),
    }
)
"""Standard Denavit-Hartenberg rows a, alpha, d, theta by the name of the geometry, m and rad."""


def _model(name: str) -> ArmModel:
    data = (_Q_MIN_DEG, _Q_MAX_DEG, _QD_MAX_DEG_S, _TORQUE_NM, _ROTOR_KG_M2, _COULOMB_NM, _VISCOUS_NMS)
    chain = from_dh(DH_ROWS[name], name=name)
    joints = [
        Joint(joint, False, math.radians(low), math.radians(high), math.radians(speed), *drive)
        for joint, low, high, speed, *drive in zip(chain.joints, *data, strict=True)
    ]
    units_per_q = np.diag(_COUNTS_PER_TURN) @ np.array(_MOTOR_TURNS) / (2 * math.pi)
    return ArmModel(chain, tuple(joints), units_per_q, np.zeros(6))


UPENN = _model("upenn")
"""UPenn MEAM 520: upper arm 203.2 mm, no elbow offset, shoulder offset 127.0 mm, flange 63.5 mm."""

UNIMATE = _model("unimate")
"""After the Unimate manual (RPI 260B, YARP Babybot): 198.1 mm, -19.05 mm elbow, 124.5 mm shoulder, 55.9 mm flange.

The elbow offset is taken as the DH length a3, at right angles to the forearm.
"""

MODELS: Mapping[str, ArmModel] = MappingProxyType({"upenn": UPENN, "unimate": UNIMATE})


def dh_rows(model: ArmModel) -> Array | None:
    """(6, 4) standard Denavit-Hartenberg rows of a PUMA 260, by its geometry; None of another arm.

    Args:
        model: the arm.
    """
    for name, puma in MODELS.items():
        if model.n == puma.n and np.allclose(puma.chain.fixed, model.chain.fixed, rtol=0.0, atol=1e-9):
            return DH_ROWS[name]
    return None


def _bodies(name: str) -> tuple[Body, ...]:
    """The links in the frames of their joints; how the geometry splits the shoulder's offset does not move link 2."""
    chain, com = MODELS[name].chain, 1e-3 * np.array(_COM_MM)
    com[1, 2] -= DH_ROWS[name][1, 2]
    behind = (*chain.fixed[1:], chain.T_last_flange)
    return tuple(
        Body(mass, at, np.diag(1e-6 * np.array(tensor))).moved(T)
        for mass, at, tensor, T in zip(_MASS_KG, com, _INERTIA_KG_MM2, behind, strict=True)
    )


BODIES: Mapping[str, tuple[Body, ...]] = MappingProxyType({name: _bodies(name) for name in MODELS})
"""Bodies of the bare arm by the name of the geometry."""
