"""What else is on the bus: other nodes, another master, another SYNC producer.

The examination sends less where it is not alone, as what it does must not reach a machine that works. The bus is heard
for some time; only where nobody but the device was heard is every other node id asked for 1000h.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.presence import answering_nodes
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NMT_ID, SDO_RX_BASE, SDO_TX_BASE, SYNC_ID
from canprobe.fieldbus.protocol.lss import LSS_ANSWER_ID, LSS_REQUEST_ID

MAX_BASE_ID = 0x7FF
"""Highest identifier of 11 bits; with more the flags of a remote request or of 29 bits are set."""


@dataclass(slots=True)
class Surroundings:
    """What was heard on the bus before the examination.

    Attributes:
        others: ids of other nodes.
        sync: whether somebody sends SYNC.
        master: what showed that there is another master; empty: nothing did.
        strangers: identifiers of frames that belong to no service of a known node.
        states: NMT states by node id, as heartbeats reported them.
        lengths: lengths of the frames that may be PDOs of the device, by identifier.
    """

    others: set[int] = field(default_factory=set)
    sync: bool = False
    master: str = ""
    strangers: set[int] = field(default_factory=set)
    states: dict[int, int] = field(default_factory=dict)
    lengths: dict[int, set[int]] = field(default_factory=dict)

    @property
    def alone(self) -> bool:
        """Whether nobody else was heard."""
        return not (self.others or self.sync or self.master or self.strangers)

    def lacks(self, need: str) -> str:
        """Why a need of a point is not met here; empty where it is met."""
        if need == "nmt" and self.master:
            return f"another master is on the bus ({self.master}): the NMT state of the device is left as it is"
        if need == "sync" and self.sync:
            return "another node sends SYNC: a second SYNC producer would disturb it"
        if need == "sync" and self.master:
            return f"another master is on the bus ({self.master}): no SYNC is sent"
        if need == "alone" and not self.alone:
            return f"the device is not alone on the bus ({self.text()})"
        return ""

    def text(self) -> str:
        """What was heard, in words."""
        parts = [f"nodes {', '.join(map(str, sorted(self.others)))}"] if self.others else []
        parts += ["SYNC"] if self.sync else []
        parts += [self.master] if self.master else []
        parts += [f"identifiers {', '.join(f'{i:03X}h' for i in sorted(self.strangers)[:4])}"] if self.strangers else []
        return "; ".join(parts) or "nobody else"


def hear(port: Port, node_id: int, seconds: float) -> Surroundings:
    """Listen, and where nobody else is heard ask every other node id for 1000h."""
    end_ns = port.clock.now_ns() + round(seconds * 1e9)
    frames: list[TimedFrame] = list(port.drain())
    while port.clock.now_ns() < end_ns:
        frames += port.wait_and_drain(end_ns)
    found = surroundings_of(frames, node_id)
    if found.alone:
        others = (n for n in range(1, 128) if n != node_id)
        found.others.update(answering_nodes(PumpedNetwork(port), others, 0.05))
    return found


def surroundings_of(frames: Iterable[TimedFrame], node_id: int) -> Surroundings:
    """What frames show of others than one node."""
    found = Surroundings()
    for can_id, data, _ in frames:
        base, number = can_id & ~0x7F, can_id & 0x7F
        if 0x180 <= can_id < SDO_TX_BASE:
            found.lengths.setdefault(can_id, set()).add(len(data))
        if can_id == SYNC_ID:
            found.sync = True
        elif can_id == NMT_ID:
            found.master = "NMT commands"
        elif base == SDO_RX_BASE and number:
            found.master = f"SDO requests to node {number}"
        elif base in (HEARTBEAT_BASE, EMCY_BASE, SDO_TX_BASE) and number:
            found.others.add(number)
            if base == HEARTBEAT_BASE:
                found.states[number] = data[0] & 0x7F if data else 0
        elif number == node_id and ((0x180 <= base < 0x580 and base & 0x80) or can_id > MAX_BASE_ID):
            pass  # a default TPDO of the device, or a frame that it should not send
        elif can_id not in (LSS_REQUEST_ID, LSS_ANSWER_ID):
            found.strangers.add(can_id)
        else:
            found.master = "LSS"
    found.others.discard(node_id)
    return found
