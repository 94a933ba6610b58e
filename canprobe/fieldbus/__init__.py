"""A CANopen library that stands alone: bytes, device descriptions, buses, nodes and drives.

Nothing here knows a robot, a cell or a tactile task, and nothing needs numpy or scipy. A device that any EDS file
describes can be served on a bus, and a master that somebody else wrote can work with it:

    bus = LockstepBus(clock)                                   a bus whose time the program owns
    node = SlaveNode(5, load_eds("drive.eds", 5), ...)         a CiA 301 node
    serve(...)                                                 the same node on a real interface

What comes in are bytes and times; what goes out are bytes and deadlines:

- `protocol` packs and parses. It holds no state that outlives a message, but for the assemblers of tactile images.
- `eds` reads device descriptions of any vendor, and says what it had to mend.
- `bus` moves frames: `virtual` in virtual time, `real` over SocketCAN or any interface of python-can. Above both stand
  a `Clock` and a `Port`, and the requests that wait for an answer (SDO, LSS).
- `node` is a CiA 301 slave, `drive` a CiA 402 drive on it. Both take bytes and a time and return bytes and the next
  deadline; they never sleep and never open anything. `node.serve` puts nodes on an interface.
- `vcan` runs a command where a real vcan0 exists.

Invariants: times are integer nanoseconds; a decoder raises `ProtocolError` and nothing else; a port raises nothing for
what a bus does; the same seed gives the same frames on a virtual bus.

Imports point downward: protocol ← eds ← bus ← node ← drive. Of the rest of the package only `canprobe.errors` is seen.
Start reading at `protocol.frames`, then `bus.port`, then `node.slave_node`.
"""
