"""The modes of operation: cyclic synchronous position, velocity and torque, interpolated and profile position.

A target that is further from the one before than 607Fh and 6080h let the motor go in the time between them is not
followed: reference limit, a fault. A target that was corrupted on its way is one, unless it is off by less.
Offsets of velocity and torque (60B1h, 60B2h) are feed-forwards of a dynamic plant; the ideal one needs none.
Source: CiA 402-2, "Cyclic synchronous position mode", objects 607Ah, 607Dh, 607Fh, 6080h, 60B0h–60B2h,
60C2h; error code 8612h.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.cyclic_position import CyclicPosition
from canprobe.fieldbus.drive.cyclic_torque import CyclicTorque
from canprobe.fieldbus.drive.cyclic_velocity import CyclicVelocity
from canprobe.fieldbus.drive.homing import Homing
from canprobe.fieldbus.drive.interpolated_position import InterpolatedPosition
from canprobe.fieldbus.drive.mode import DriveMode, DriveParts
from canprobe.fieldbus.drive.profile_position import ProfilePosition

MODES: tuple[type[DriveMode], ...] = (
    DriveMode,
    ProfilePosition,
    Homing,
    InterpolatedPosition,
    CyclicPosition,
    CyclicVelocity,
    CyclicTorque,
)


def make_modes(parts: DriveParts) -> dict[int, DriveMode]:
    """The modes that a drive offers: known here, their objects in the EDS, and claimed by its 6502h if it has one."""
    dictionary = parts.node.dictionary
    claimed = dictionary.number(0x6502) or ~0
    return {
        int(mode.number): mode(parts)
        for mode in MODES
        if not mode.number or (claimed >> mode.number - 1 & 1 and all(key in dictionary for key in mode.needs))
    }
