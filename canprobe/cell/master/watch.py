"""Boot-ups, heartbeats and emergencies of the nodes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, MASTER_NODE_ID
from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.emcy import SYNC_LOST_CODE, Emcy, describe, is_no_error
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NMT_ID, SYNC_ID, NmtState, unpack_heartbeat

MAX_NEW_ALARMS = 64
"""Alarms that are kept until `NodeWatch.news` is called."""


@dataclass(frozen=True, slots=True)
class EmcyEvent:
    """An emergency message with its sender and time."""

    node_id: int
    emcy: Emcy
    t_ns: int

    @property
    def what(self) -> str:
        """The message in words."""
        late = " (no SYNC in time)" if self.emcy.code == SYNC_LOST_CODE else ""
        return f"EMCY {self.emcy.code:04X}h, {describe(self.emcy.code)}{late}"

    def __str__(self) -> str:
        return f"node {self.node_id}: {self.what}"


class NodeWatch:
    """Follows the error control and emergency messages of the planned nodes.

    Args:
        node_ids: the nodes that are watched.

    Attributes:
        states: NMT state in each node's last heartbeat.
        boot_ups: boot-up messages of each node.
        last_emcy: the last EMCY of each node, the end of an error too.
        last_alarm: the last EMCY of each node that reports an error, not its end.
        device_alarm: first alarm since the start that is about a device rather than frames; None without one.
        alarmed: nodes that have sent such an alarm since the start.
        communication: count of alarms about frames.
        foreign: first frame of another master, in words; None without one.
        heard_ns: time of each node's last heartbeat, on the clock of the frames.
    """

    def __init__(self, node_ids: tuple[int, ...]) -> None:
        self.node_ids = node_ids
        self.states: dict[int, NmtState] = {}
        self.boot_ups: dict[int, int] = dict.fromkeys(node_ids, 0)
        self.last_emcy: dict[int, EmcyEvent] = {}
        self.last_alarm: dict[int, EmcyEvent] = {}
        self.device_alarm: EmcyEvent | None = None
        self.alarmed: set[int] = set()
        self.communication = 0
        self.foreign: str | None = None
        self._untold: deque[EmcyEvent] = deque(maxlen=MAX_NEW_ALARMS)
        self.heard_ns: dict[int, int] = {}

    def push(self, can_id: int, data: bytes, t_ns: int) -> bool:
        """Take a frame that is no PDO; True where it was a frame of error control, EMCY or another master."""
        node_id = can_id & 0x7F
        # no port gives back what it has sent, so these are of somebody else
        if can_id == HEARTBEAT_BASE + MASTER_NODE_ID:
            self.foreign = self.foreign or f"a heartbeat of node {MASTER_NODE_ID}, our own id"
        elif can_id in (SYNC_ID, NMT_ID):
            what = "SYNC" if can_id == SYNC_ID else "an NMT command"
            self.foreign = self.foreign or f"{what} from another master"
        elif can_id == HEARTBEAT_BASE + node_id and node_id in self.boot_ups:
            self._push_heartbeat(node_id, data, t_ns)
        elif can_id == EMCY_BASE + node_id and node_id in self.boot_ups:
            self._push_emcy(node_id, data, t_ns)
        else:
            return False
        return True

    def _push_heartbeat(self, node_id: int, data: bytes, t_ns: int) -> None:
        try:
            state = unpack_heartbeat(data)
        except ProtocolError:
            return
        self.heard_ns[node_id] = t_ns
        self.states[node_id] = state
        if state is NmtState.INITIALISING:
            self.boot_ups[node_id] += 1

    def _push_emcy(self, node_id: int, data: bytes, t_ns: int) -> None:
        try:
            event = EmcyEvent(node_id, Emcy.unpack(data), t_ns)
        except ProtocolError:
            return
        self.last_emcy[node_id] = event
        if is_no_error(event.emcy.code):
            return
        self.last_alarm[node_id] = event
        self._untold.append(event)
        if event.emcy.code >> 8 in (0x81, 0x82):  # it is about frames, by the error codes of CiA 301
            self.communication += 1
        else:
            self.device_alarm = self.device_alarm or event
            self.alarmed.add(node_id)

    def news(self) -> list[EmcyEvent]:
        """Alarms since the last call, the last `MAX_NEW_ALARMS` of them."""
        news = list(self._untold)
        self._untold.clear()
        return news

    @property
    def another_master(self) -> str | None:
        """A message that another master was heard, with its frame; None where none was heard."""
        return None if self.foreign is None else f"another master is on the bus: {self.foreign}"

    def last_words(self, node_id: int) -> str:
        """The node's last alarm, to be put behind an error; empty without one."""
        event = self.last_alarm.get(node_id)
        return "" if event is None else f"; {event}"

    def forget(self) -> None:
        """Start the heartbeat supervision afresh: no heartbeat has been received yet."""
        self.heard_ns.clear()
        self.states.clear()

    def start(self, t_ns: int) -> None:
        """Expect every node's heartbeat from now on; what a device reported until now is over."""
        self.device_alarm = None
        self.alarmed.clear()
        self.heard_ns = dict.fromkeys(self.node_ids, t_ns)

    def silent(self, t_ns: int) -> int | None:
        """A node that has been silent for longer than the time-out, or None."""
        limit = t_ns - HEARTBEAT_CONSUMED_MS * 1_000_000
        return next((node_id for node_id, heard in self.heard_ns.items() if heard < limit), None)

    def not_in(self, state: NmtState) -> int | None:
        """A node whose last heartbeat has another state than `state`, or None."""
        return next((node_id for node_id, seen in self.states.items() if seen is not state), None)
