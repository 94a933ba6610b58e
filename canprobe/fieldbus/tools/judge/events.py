"""What a frame on the bus means to the one who judges the master: one event each, after the state has taken it in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState
from canprobe.fieldbus.protocol.sdo import Place
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.seen_node import PdoView, SeenNode

# One is made for each frame, and frozen they would cost 15 ms of every start: nobody changes or compares them.


@dataclass(slots=True, eq=False)
class BusEvent:
    """Base of all events.

    Attributes:
        frame: the frame.
    """

    frame: BusFrame

    def among(self, nodes: Iterable[SeenNode]) -> Iterable[object]:
        """Those of the nodes that it is about, or a motor: all nodes, unless it names some."""
        return nodes


@dataclass(slots=True, eq=False)
class NodeSeen(BusEvent):
    """Base of the events of one node.

    Attributes:
        node: the node.
    """

    node: SeenNode

    def among(self, nodes: Iterable[SeenNode]) -> Iterable[SeenNode]:
        return (self.node,)


@dataclass(slots=True, eq=False)
class SyncSeen(BusEvent):
    """A SYNC, with its counter, or None."""

    counter: int | None


@dataclass(slots=True, eq=False)
class NmtSeen(BusEvent):
    """An NMT command to nodes that are judged; `to_all` where it names node 0."""

    command: NmtCommand
    nodes: tuple[SeenNode, ...]
    to_all: bool

    def among(self, nodes: Iterable[SeenNode]) -> Iterable[SeenNode]:
        return self.nodes


@dataclass(slots=True, eq=False)
class HeartbeatSeen(NodeSeen):
    """A heartbeat of a node that is judged; a boot-up is the state INITIALISING."""

    state: NmtState
    before: NmtState | None


@dataclass(slots=True, eq=False)
class OtherHeartbeatSeen(BusEvent):
    """A heartbeat of somebody else, as of the master."""

    node_id: int


@dataclass(slots=True, eq=False)
class EmcySeen(NodeSeen):
    """An emergency message."""

    code: int


@dataclass(slots=True, eq=False)
class RemoteSeen(BusEvent):
    """A remote request."""


@dataclass(slots=True, eq=False)
class ForgedSeen(NodeSeen):
    """A frame from outside under an identifier that belongs to a served node."""


@dataclass(slots=True, eq=False)
class RpdoSeen(NodeSeen):
    """A frame for an RPDO of a node; `before` has what the objects in it were; empty where its length does not fit."""

    pdo: PdoView
    values: Mapping[Place, int]
    before: Mapping[Place, int | None]


@dataclass(slots=True, eq=False)
class ControlSeen(NodeSeen):
    """A controlword, by RPDO or by an SDO write that was confirmed."""

    word: int
    before: int | None
    pdo: PdoView | None


@dataclass(slots=True, eq=False)
class TargetSeen(NodeSeen):
    """A target: 607Ah, 60C1h:01, 60FFh or 6071h."""

    index: int
    value: int
    before: int | None
    before_ns: int
    pdo: PdoView | None


@dataclass(slots=True, eq=False)
class ModeSeen(NodeSeen):
    """A mode of operation that the master asked for (6060h)."""

    mode: int
    before: int | None


@dataclass(slots=True, eq=False)
class StatusSeen(NodeSeen):
    """A statusword."""

    word: int


@dataclass(slots=True, eq=False)
class RequestSeen(NodeSeen):
    """The first frame of an SDO transfer; `pending` is a request on this channel that has no answer yet."""

    writes: bool
    place: Place
    value: int | None
    pending: BusFrame | None


@dataclass(slots=True, eq=False)
class AnswerSeen(NodeSeen):
    """The end of an SDO transfer without an abort; `late`: after the client had aborted it."""

    writes: bool
    place: Place
    value: int | None
    request: BusFrame
    late: bool = False


@dataclass(slots=True, eq=False)
class AbortSeen(NodeSeen):
    """An SDO abort; `place` is that of the transfer, `named` that in the abort."""

    writes: bool
    place: Place | None
    named: Place
    code: int
    by_client: bool
    request: BusFrame | None
