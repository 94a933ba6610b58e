"""The table of modes of operation: number → what it needs of the EDS, and the class that does it.

Source: CiA 402-2, objects 6060h, 6061h, 6502h.
"""

from __future__ import annotations

from collections.abc import Iterable

from canprobe.emulator.drive_mode import DriveMode, DriveParts
from canprobe.emulator.drive_mode_csp import CyclicPosition
from canprobe.emulator.drive_mode_cst import CyclicTorque
from canprobe.emulator.drive_mode_csv import CyclicVelocity
from canprobe.emulator.drive_mode_homing import Homing
from canprobe.emulator.drive_mode_pp import ProfilePosition
from canprobe.protocol.cia402 import OperationMode

MODES: dict[OperationMode, tuple[type[DriveMode], tuple[int, ...]]] = {
    OperationMode.NONE: (DriveMode, ()),
    OperationMode.PROFILE_POSITION: (ProfilePosition, (0x607A, 0x6081)),
    OperationMode.HOMING: (Homing, (0x6098,)),
    OperationMode.CYCLIC_SYNC_POSITION: (CyclicPosition, (0x607A,)),
    OperationMode.CYCLIC_SYNC_VELOCITY: (CyclicVelocity, (0x60FF,)),
    OperationMode.CYCLIC_SYNC_TORQUE: (CyclicTorque, (0x6071,)),
}


def make_modes(parts: DriveParts) -> dict[int, DriveMode]:
    """The modes that a drive offers: known here, their objects in the EDS, and claimed by its 6502h if it has one."""
    dictionary = parts.node.dictionary
    claimed = dictionary.number(0x6502) or ~0
    return {
        int(mode): make(parts)
        for mode, (make, needs) in MODES.items()
        if not mode or (claimed >> mode - 1 & 1 and all(dictionary.has_index(index) for index in needs))
    }


def supported_bits(modes: Iterable[int]) -> int:
    """Object 6502h: bit n-1 for mode n."""
    return sum(1 << mode - 1 for mode in modes if mode)
