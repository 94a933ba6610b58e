"""A node from an EDS alone, of any make: the values of the file, and a drive where the file describes one."""

from __future__ import annotations

from canopen.objectdictionary import ObjectDictionary

from canprobe.eds.reading import is_drive
from canprobe.emulator.drive import make_drive_node
from canprobe.emulator.ideal_axis import IdealAxis
from canprobe.emulator.node import SlaveNode


def make_eds_node(od: ObjectDictionary, node_id: int) -> SlaveNode:
    """A conforming CiA 301 node with the values of its EDS; a CiA 402 drive moves an ideal axis of its own.

    Args:
        od: of any EDS, for this node id.
        node_id: 1–127.
    """
    if is_drive(od):
        return make_drive_node(od, node_id, 0, IdealAxis())
    return SlaveNode(od, node_id)
