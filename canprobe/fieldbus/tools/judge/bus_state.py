"""The state of a bus as its frames show it: frames in, events out. It knows nothing that was not on the bus."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol import cia402, frames
from canprobe.fieldbus.protocol.sdo import Place
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import BusEvent
from canprobe.fieldbus.tools.judge.sdo_channel import SdoChannel
from canprobe.fieldbus.tools.judge.seen_motor import SeenMotor
from canprobe.fieldbus.tools.judge.seen_node import TARGETS, PdoView, SeenNode

_STORE = 0x1010
_ARBITRATION_BITS = 135
"""Length of the longest frame, for which another has to wait."""


class BusState:
    """Follows a bus.

    Args:
        nodes: description of each node by its id.
        served: whether the nodes are emulated ones that are served here.
        bitrate: bit rate, bit/s.
        motors: motors that do not speak CANopen.

    Attributes:
        nodes: nodes by id.
        now_ns: time of the last frame.
        syncs_ns: times of the last SYNCs.
        sync_count: number of SYNCs so far.
        others: ids that are no node here, and send heartbeats.
        arbitration_ns: time for which a frame may have to wait for another.
    """

    def __init__(
        self,
        nodes: Mapping[int, Description],
        *,
        served: bool = False,
        bitrate: int = 1_000_000,
        motors: Sequence[SeenMotor] = (),
    ) -> None:
        self.motors = motors
        self.nodes = {node_id: SeenNode(node_id, what, served=served) for node_id, what in nodes.items()}
        self._channels = {node_id: SdoChannel(node) for node_id, node in self.nodes.items()}
        self.now_ns = 0
        self.syncs_ns: deque[int] = deque(maxlen=34)
        self.sync_count = 0
        self.others: set[int] = set()
        self.arbitration_ns = _ARBITRATION_BITS * 1_000_000_000 // bitrate

    @property
    def period_ns(self) -> int:
        """Period of SYNC: that of 1006h where it was seen, or else the median of the last ones; 0 where unknown."""
        for node in self.nodes.values():
            if period_us := node.number(0x1006):
                return period_us * 1000
        if len(self.syncs_ns) < 3:
            return 0
        times = list(self.syncs_ns)
        # not the mean, which one pause of the master shifts
        return sorted(b - a for a, b in pairwise(times))[(len(times) - 1) // 2]

    def take(self, frame: BusFrame) -> Iterator[BusEvent]:
        """Take a frame and yield what it means, all of which must be consumed before the next one.

        The state has changed when an event comes; NMT commands and boot-ups change the nodes afterwards.
        """
        self.now_ns = frame.t_ns
        for motor in self.motors:
            yield from motor.take(frame)
        can_id, data = frame.can_id, frame.data
        node, base = self.nodes.get(can_id & 0x7F), can_id & ~0x7F
        if can_id > 0x7FF:
            if can_id & frames.RTR_FLAG and can_id & 0x3FFFFFFF <= 0x7FF:
                yield events.RemoteSeen(frame)
        elif can_id == frames.NMT_ID:
            yield from self._nmt(frame)
        elif can_id == frames.SYNC_ID and len(data) <= 1:
            self.syncs_ns.append(frame.t_ns)
            self.sync_count += 1
            for one in self.nodes.values():
                one.syncs += one.started_ns is not None
            yield events.SyncSeen(frame, data[0] if data else None)
        elif base == frames.HEARTBEAT_BASE and can_id > base:
            yield from self._heartbeat(frame, can_id - base)
        elif node is not None and base in (frames.EMCY_BASE, frames.SDO_TX_BASE, frames.SDO_RX_BASE):
            yield from self._service(frame, node, base)
        else:
            yield from self._pdos(frame)

    def _service(self, frame: BusFrame, node: SeenNode, base: int) -> Iterator[BusEvent]:
        """EMCY or SDO of a node."""
        if base == frames.SDO_RX_BASE:
            node.addressed = True
            for event in self._channels[node.node_id].from_client(frame):
                if isinstance(event, events.RequestSeen):
                    node.asked = True
                    node.touched.add(event.place[0])
                yield event
            return
        yield from self._sent_by(node, frame)
        if base == frames.SDO_TX_BASE:
            for event in self._channels[node.node_id].from_server(frame):
                yield from self._transferred(event)
        elif len(frame.data) == 8:
            yield events.EmcySeen(frame, node, int.from_bytes(frame.data[:2], "little"))

    def _pdos(self, frame: BusFrame) -> Iterator[BusEvent]:
        for node in self.nodes.values():
            received, sent = node.rpdos.get(frame.can_id), node.tpdos.get(frame.can_id)
            if received is not None:
                node.addressed = True
                node.rpdo_counts[received.number] += 1
                values = _unpacked(received, frame)
                before = {place: node.sure_value(*place) for place in values}
                yield events.RpdoSeen(frame, node, received, values, before)
                yield from self._valued(node, values, frame, received, written=True)
            if sent is not None and frame.from_node is not False:
                node.hear(frame.t_ns)
                node.answers = True
                yield from self._valued(node, _unpacked(sent, frame), frame, sent, written=False)
            elif sent is not None and sent.certain and received is None:
                yield events.ForgedSeen(frame, node)

    def _sent_by(self, node: SeenNode, frame: BusFrame) -> Iterator[BusEvent]:
        node.hear(frame.t_ns)
        node.answers = node.answers or frame.can_id != frames.HEARTBEAT_BASE + node.node_id or frame.data != b"\0"
        if frame.from_node is False:
            yield events.ForgedSeen(frame, node)

    def _nmt(self, frame: BusFrame) -> Iterator[BusEvent]:
        if len(frame.data) != 2 or frame.data[0] not in frames.NmtCommand.__members__.values():
            return
        command, node_id = frames.NmtCommand(frame.data[0]), frame.data[1]
        nodes = tuple(node for node in self.nodes.values() if node_id in (0, node.node_id))
        yield events.NmtSeen(frame, command, nodes, node_id == 0)  # the nodes are as they were before it
        for node in nodes:
            node.addressed = True
            node.nmt, node.nmt_ns = frames.NMT_GOALS[command], frame.t_ns
            node.started_ns = frame.t_ns if command is frames.NmtCommand.START else None
            node.syncs = 0

    def _heartbeat(self, frame: BusFrame, node_id: int) -> Iterator[BusEvent]:
        node = self.nodes.get(node_id)
        if node is None:
            yield events.OtherHeartbeatSeen(frame, node_id)
            self.others.add(node_id)
            return
        yield from self._sent_by(node, frame)
        state = frame.data[0] & 0x7F if len(frame.data) == 1 else -1
        if state not in frames.NmtState.__members__.values() or frame.from_node is False:
            return
        before, node.nmt = node.nmt, frames.NmtState(state)
        if node.nmt is not before:
            node.nmt_ns = frame.t_ns
            if node.nmt is not frames.NmtState.OPERATIONAL:
                node.started_ns = None
        if node.nmt is frames.NmtState.INITIALISING:
            self._channels[node_id].reset()
        yield events.HeartbeatSeen(frame, node, node.nmt, before)  # the values are those before a boot-up
        if node.nmt is frames.NmtState.INITIALISING:
            node.boot()
            node.heartbeats_ns.clear()
        else:
            node.heartbeats_ns.append(frame.t_ns)
            if node.nmt is frames.NmtState.OPERATIONAL and node.started_ns is None:
                node.started_ns, node.syncs = frame.t_ns, 0

    def _transferred(self, event: BusEvent) -> Iterator[BusEvent]:
        """The end of a transfer, and what its value means."""
        yield event
        if not isinstance(event, events.AnswerSeen) or event.late:
            return
        node = event.node
        node.configured = node.configured or event.writes
        node.stored = node.stored or (event.writes and event.place[0] == _STORE)
        if event.value is None:
            return
        shown = event.request if event.writes else event.frame
        yield from self._valued(node, {event.place: event.value}, shown, None, written=event.writes)

    def _valued(
        self, node: SeenNode, values: Mapping[Place, int], frame: BusFrame, pdo: PdoView | None, *, written: bool
    ) -> Iterator[BusEvent]:
        """Take values of objects; targets come before the mode, and the controlword comes last."""
        before = {place: node.known(*place) for place in values}
        for place, value in values.items():
            node.take(place, value, frame)
        for place in sorted(values, key=lambda place: (place[0] == cia402.CONTROLWORD, place[0] == cia402.MODE, place)):
            index, subindex = place
            known = before[place]
            value, old = values[place], known.value if known is not None else None
            if index == cia402.STATUSWORD and not written:
                yield events.StatusSeen(frame, node, value)
            elif not written:
                continue
            elif index == cia402.CONTROLWORD:
                yield events.ControlSeen(frame, node, value, old, pdo)
            elif index == cia402.MODE:
                yield events.ModeSeen(frame, node, value, old)
            elif index in TARGETS and subindex == (1 if index == cia402.INTERPOLATION_DATA else 0):
                yield events.TargetSeen(frame, node, index, value, old, known.t_ns if known is not None else 0, pdo)


def _unpacked(pdo: PdoView, frame: BusFrame) -> dict[Place, int]:
    """The values in a PDO by object; empty where it is shorter than its mapping, or longer while that is uncertain."""
    length = len(frame.data)
    if length < pdo.layout.length or (length > pdo.layout.length and not pdo.certain):
        return {}
    numbers = pdo.layout.unpack(frame.data[: pdo.layout.length])
    return {(entry.index, entry.subindex): number for entry, number in zip(pdo.layout.signals, numbers, strict=True)}
