"""A node from an EDS alone, of any make: the values of the file, and a drive where the file describes one."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary

from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.drive.ideal_axis import IdealAxis
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.eds.reading import is_drive
from canprobe.fieldbus.node.entry import key_of
from canprobe.fieldbus.node.slave_node import SlaveNode


def set_serial_number(node: SlaveNode, serial: int) -> None:
    """Give a device its serial number, in which two devices of one EDS differ; without 1018h:04 it has none."""
    if key_of(0x1018, 4) in node.dictionary:
        node.dictionary.set_default(0x1018, 4, serial)


def make_eds_node(
    od: ObjectDictionary,
    node_id: int,
    *,
    eds: str | Path | None = None,
    serial: int | None = None,
    position: int = 0,
) -> SlaveNode:
    """Make a conforming CiA 301 node with the values of its EDS; a CiA 402 drive moves an ideal axis.

    Args:
        od: parsed EDS, for this node id.
        node_id: node id, 1–127; with 255 the node waits for LSS to give it one.
        eds: name or path of the EDS, for a node that speaks LSS; None for one that does not.
        serial: serial number for 1018h:04, in the place of that of the file.
        position: place of the motor of a drive at first, counts.
    """
    od_of = None if eds is None else partial(load_eds, eds)
    drive = is_drive(od)
    axis = IdealAxis(position)
    node = make_drive_node(od, node_id, 0, axis, od_of) if drive else SlaveNode(od, node_id, od_of=od_of)
    if serial is not None:
        set_serial_number(node, serial)
    return node
