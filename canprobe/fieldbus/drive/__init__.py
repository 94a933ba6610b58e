"""A CiA 402 drive: its states and faults, its modes of operation, and the motion that it asks of the plant.

Controlword, mode and targets come in through the dictionary of a node; statusword and actual values go out through it,
and a reference goes to one axis of the plant. `drive.DriveApplication` is the application of the node. It follows the
table of states in `protocol.cia402` and runs one mode at a time.

    drive                   states, faults, options, the table of all modes and which one is active
    from_eds                a node from an EDS alone; where the file describes a drive, on an axis without a plant
    parameters              limits, ramps and options, read from the dictionary whenever one is written
    units                   position units of the master ↔ counts of the axis
    parts                   what the modes share: actual values, the plant's position loop, the watch on the master
    mode                    what all modes share
    cyclic_modes            modes with a target for every SYNC: position, velocity, torque, interpolated position
    profile_position        set-points by handshake, each a trapezoidal move
    homing                  limit switches, index pulses, or the present position
    profile                 trapezoids and other motion as pieces of constant acceleration
    reference               ramps, trajectories, holds and stops of one axis

Invariants: outside operation enabled the drive holds. Loss of SYNC, RPDOs or heartbeat quick-stops it (6007h, 605Ah): a
dead master never leaves it moving. An object that the EDS lacks has a default. Start reading at `drive`, then `mode`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.fieldbus.drive.drive import make_drive_node as make_drive_node
    from canprobe.fieldbus.drive.from_eds import IdealAxis as IdealAxis
    from canprobe.fieldbus.drive.from_eds import make_eds_node as make_eds_node
    from canprobe.fieldbus.drive.profile import MotorDynamics as MotorDynamics
    from canprobe.fieldbus.drive.reference import AxisPlant as AxisPlant

__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "drive.drive": ("make_drive_node",),
        "drive.from_eds": ("IdealAxis", "make_eds_node"),
        "drive.profile": ("MotorDynamics",),
        "drive.reference": ("AxisPlant",),
    },
)
