"""A node from an EDS alone, of any make: the values of the file, and a drive where the file describes one."""

from __future__ import annotations

from canopen.objectdictionary import ObjectDictionary

from canprobe.eds.reading import device_profile
from canprobe.emulator.drive import make_drive_node
from canprobe.emulator.ideal_axis import IdealAxis
from canprobe.emulator.node import SlaveNode

DRIVE_PROFILE = 402
_DRIVE_OBJECTS = (0x6040, 0x6041)


def is_drive(od: ObjectDictionary) -> bool:
    """Whether the device profile of 1000h is CiA 402 and the objects of its state machine are there."""
    return device_profile(od) == DRIVE_PROFILE and all(index in od.indices for index in _DRIVE_OBJECTS)


def make_eds_node(od: ObjectDictionary, node_id: int) -> SlaveNode:
    """A conforming CiA 301 node with the values of its EDS; a CiA 402 drive moves an ideal axis of its own.

    Args:
        od: of any EDS, for this node id.
        node_id: 1–127.
    """
    if is_drive(od):
        return make_drive_node(od, node_id, 0, IdealAxis())
    return SlaveNode(od, node_id)
