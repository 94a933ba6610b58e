"""The pose of a flange as the joints of a chain: three slides and three turns, for an arm that takes poses.

The coordinates are the position of the flange, m, and its yaw, pitch and roll from a home orientation, rad:
`R_base_flange = Rz(yaw) Ry(pitch) Rx(roll) R_home`. They are singular at a pitch of 90°, which the model leaves out.
"""

from __future__ import annotations

from math import atan2, hypot

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.robot.chain import Chain, forward
from canprobe.mechanics.robot.model import ArmModel, Joint
from canprobe.mechanics.types import Floats

COORDINATES = ("x", "y", "z", "yaw", "pitch", "roll")
COUNTS_PER_M, COUNTS_PER_RAD = 1e7, 1e6
"""Units in which the coordinates are counted: 0.1 µm and 1 µrad."""
_CYCLE = np.array(((0.0, 0.0, 1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
"""From a frame to the one whose z axis is its x axis; applied twice, its y axis."""


def flange_model(  # noqa: PLR0917
    name: str, T_base_mount: Floats, R_home: Floats, start: npt.ArrayLike, reach: Floats, speed: Floats
) -> ArmModel:
    """The model of an arm whose joints are the coordinates of its flange.

    Args:
        name: name of the arm.
        T_base_mount: (4, 4) base frame of the arm, m.
        R_home: (3, 3) orientation of the flange in that frame, from which the turns count.
        start: (3,) position of the flange there, m, from which the range counts.
        reach: (6,) largest distance of each coordinate from the start, m or rad.
        speed: (6,) highest speed of each coordinate, m/s or rad/s.
    """
    last = np.linalg.inv(_CYCLE)
    last[:3, :3] = last[:3, :3] @ R_home
    y = _CYCLE @ _CYCLE
    fixed = np.array((T_base_mount @ _CYCLE, _CYCLE, _CYCLE, np.eye(4), y, y))
    slides = (True,) * 3 + (False,) * 3
    middle = np.concatenate((np.asarray(start, dtype=float), np.zeros(3)))
    each = zip(COORDINATES, slides, middle.tolist(), reach.tolist(), speed.tolist(), strict=True)
    joints = tuple(Joint(joint, slide, at - far, at + far, fast) for joint, slide, at, far, fast in each)
    units = np.where(slides, COUNTS_PER_M, COUNTS_PER_RAD)
    return ArmModel(Chain(name, COORDINATES, slides, fixed, last), joints, np.diag(units), np.zeros(6))


def flange_joints(model: ArmModel, T_mount_flange: Floats) -> Floats:
    """Coordinates (6,), m and rad, of a pose (4, 4) of the flange in the base frame of the arm."""
    R = T_mount_flange[:3, :3] @ (_CYCLE[:3, :3] @ model.chain.T_last_flange[:3, :3]).T
    yaw, roll = atan2(R[1, 0], R[0, 0]), atan2(R[2, 1], R[2, 2])
    return np.array((*T_mount_flange[:3, 3], yaw, atan2(-R[2, 0], hypot(R[0, 0], R[1, 0])), roll))


def flange_pose(model: ArmModel, q: Floats) -> Floats:
    """Pose (4, 4) of the flange in the base frame of the arm, m, of its coordinates (6,): undoes `flange_joints`."""
    T_mount_base = _CYCLE @ np.linalg.inv(model.chain.fixed[0])
    return T_mount_base @ forward(model.chain, q)
