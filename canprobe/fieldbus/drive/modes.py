"""The table of all modes of operation. One more mode is one more class in it."""

from __future__ import annotations

from canprobe.fieldbus.drive.cyclic_position import CyclicPosition
from canprobe.fieldbus.drive.cyclic_torque import CyclicTorque
from canprobe.fieldbus.drive.cyclic_velocity import CyclicVelocity
from canprobe.fieldbus.drive.homing import HomingMode
from canprobe.fieldbus.drive.interpolated_position import InterpolatedPosition
from canprobe.fieldbus.drive.mode import DriveMode, DriveParts
from canprobe.fieldbus.drive.profile_position import ProfilePosition

MODES: tuple[type[DriveMode], ...] = (
    DriveMode,
    ProfilePosition,
    HomingMode,
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
