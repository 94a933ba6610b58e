"""The table of all modes of operation, with one class for each mode."""

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
    """Modes of a drive, by number: the EDS has their objects, and lists them in 6502h if it has that."""
    dictionary = parts.node.dictionary
    claimed = dictionary.number(0x6502) or ~0
    return {
        int(mode.number): mode(parts)
        for mode in MODES
        if not mode.number or (claimed >> mode.number - 1 & 1 and all(key in dictionary for key in mode.needs))
    }
