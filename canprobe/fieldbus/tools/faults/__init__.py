"""The registry of faults, and how they are thrown at emulated nodes: in studies, tests, commands and programs.

A `Fault` says what happens (its kind, a class in `registry.BUS_FAULTS`), to which node, when, for how long, and how
often. A `FaultyNode` stands between a node and a bus, in the node's place, on a lockstep bus and in a process that
serves nodes on a real one alike; it begins and ends its faults by the time of the bus, and lets the `Effect` of each
change the frames that come in and go out, or the node itself. `FaultyNodes` throws faults that are written as text:

    nodes.inject("node 3: heartbeat-off at 5 s for 200 ms")
    with inject(nodes, "node 3: delay ms=2 share=0.5 seed=7"): ...

Invariants: the same seed does the same; a fault holds from the next frame or deadline of its node on, so within one
cycle; when it ends, what it changed in the node is undone; a node without faults is the node itself.

    fault           what a fault is; the base class of the kinds, with their facts of kinds.toml
    faulty_node     the node that has them
    frame_faults    the link: lost, late, twice, changed, made up; power and bus-off
    service_faults  heartbeat, NMT, SDO, EMCY, mapping
    drive_faults    CiA 402: fault, torque off, encoder, brake, zero
    registry        the table of all kinds
    text, injection faults as text, and thrown at nodes; those of a test wait for their nodes
    control         the local channel by which `canprobe inject` reaches served nodes

Faults of the array are in `canprobe.cell.emulated.array_faults`. Start reading at `registry`, then `faulty_node`.
"""

from canprobe.fieldbus.tools.faults.fault import Fault, FaultKind, FaultSpan
from canprobe.fieldbus.tools.faults.faulty_node import FaultyNode
from canprobe.fieldbus.tools.faults.injection import FaultyNodes, inject
from canprobe.fieldbus.tools.faults.registry import BUS_FAULTS
from canprobe.fieldbus.tools.faults.text import parse_fault

__all__ = ["BUS_FAULTS", "Fault", "FaultKind", "FaultSpan", "FaultyNode", "FaultyNodes", "inject", "parse_fault"]
