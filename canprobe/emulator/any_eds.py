"""A node from an EDS alone, of any make: the values of the file, and a drive where the file describes one."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary

from canprobe.eds import load_eds
from canprobe.eds.reading import is_drive
from canprobe.emulator.drive import make_drive_node
from canprobe.emulator.ideal_axis import IdealAxis
from canprobe.emulator.lss import set_serial_number
from canprobe.emulator.node import SlaveNode


def make_eds_node(
    od: ObjectDictionary, node_id: int, *, eds: str | Path | None = None, serial: int | None = None
) -> SlaveNode:
    """A conforming CiA 301 node with the values of its EDS; a CiA 402 drive moves an ideal axis of its own.

    Args:
        od: of any EDS, for this node id.
        node_id: 1–127; or 255: it waits for LSS to give it one.
        eds: the file, for a node that speaks LSS; None for one that does not.
        serial: number for 1018h:04, in the place of the file's.
    """
    od_of = None if eds is None else partial(load_eds, eds)
    drive = is_drive(od)
    node = make_drive_node(od, node_id, 0, IdealAxis(), od_of) if drive else SlaveNode(od, node_id, od_of=od_of)
    if serial is not None:
        set_serial_number(node, serial)
    return node
