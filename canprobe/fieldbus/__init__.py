"""A CANopen library that stands alone: bytes, device descriptions, buses, nodes and drives.

Nothing here knows a robot, a cell or a tactile task, and nothing needs numpy or scipy. A device that any EDS file
describes is served on a bus whose time the program owns, or on a real one, and a master that somebody else wrote works
with it:

    bus = LockstepBus(VirtualClock())
    bus.attach(make_eds_node(load_eds("drive.eds", 5), 5))
    drive = PortNetwork(bus.port()).add_node(5, load_eds("drive.eds", 5))
    drive.sdo[0x6041].raw

What comes in are bytes and times; what goes out are bytes and deadlines:

- `protocol` packs and parses. It holds no state that outlives a message, but for the assemblers of tactile images.
- `eds` reads device descriptions of any vendor, and says what it had to mend.
- `bus` moves frames: `virtual` in virtual time, `real` over SocketCAN or any interface of python-can. Above both stand
  a `Clock` and a `Port`, and the requests that wait for an answer (SDO, LSS).
- `node` is a CiA 301 slave, `drive` a CiA 402 drive on it. Both take bytes and a time and return bytes and the next
  deadline; they never sleep and never open anything. `node.serve` puts nodes on an interface.
- `motor` is motors that speak no CANopen, as functions of frames and time like `node`.
- `tools` are for other people's nodes and masters: faults that happen on demand.
- `vcan` runs a command where a real vcan0 exists.

Invariants: times are integer nanoseconds; a decoder raises `ProtocolError` and nothing else; a port raises nothing for
what a bus does; the same seed gives the same frames on a virtual bus.

Imports point downward: protocol < eds < bus < node < drive < motor < tools. Of the rest of the package only
`canprobe.errors` is seen. Start reading at `protocol.frames`, then `bus.port`, then `node.slave_node`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.fieldbus.bus.candump import CandumpWriter as CandumpWriter
    from canprobe.fieldbus.bus.candump import read_candump as read_candump
    from canprobe.fieldbus.bus.canopen_network import PortNetwork as PortNetwork
    from canprobe.fieldbus.bus.clock import MonotonicClock as MonotonicClock
    from canprobe.fieldbus.bus.clock import VirtualClock as VirtualClock
    from canprobe.fieldbus.bus.real.opening import open_port as open_port
    from canprobe.fieldbus.bus.real.socketcan import SocketCanPort as SocketCanPort
    from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus as LockstepBus
    from canprobe.fieldbus.bus.virtual.timed import TimedBus as TimedBus
    from canprobe.fieldbus.drive.from_eds import make_eds_node as make_eds_node
    from canprobe.fieldbus.eds.description import Description as Description
    from canprobe.fieldbus.eds.packaged import check_eds as check_eds
    from canprobe.fieldbus.eds.packaged import eds_path as eds_path
    from canprobe.fieldbus.eds.packaged import load_eds as load_eds
    from canprobe.fieldbus.node.serve import serve as serve
    from canprobe.fieldbus.node.slave_node import SlaveNode as SlaveNode

__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "bus.candump": ("CandumpWriter", "read_candump"),
        "bus.canopen_network": ("PortNetwork",),
        "bus.clock": ("MonotonicClock", "VirtualClock"),
        "bus.real.opening": ("open_port",),
        "bus.real.socketcan": ("SocketCanPort",),
        "bus.virtual.lockstep": ("LockstepBus",),
        "bus.virtual.timed": ("TimedBus",),
        "drive.from_eds": ("make_eds_node",),
        "eds.description": ("Description",),
        "eds.packaged": ("check_eds", "eds_path", "load_eds"),
        "node.serve": ("serve",),
        "node.slave_node": ("SlaveNode",),
    },
)
