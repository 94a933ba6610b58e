"""Rules on NMT: resets, states in which a node is commanded, and who speaks in whose name."""

from __future__ import annotations

from canprobe.fieldbus.protocol.cia402 import DriveCommand, command_of
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, NmtCommand, NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import frame_of
from canprobe.fieldbus.tools.judge.events import (
    BusEvent,
    ControlSeen,
    ForgedSeen,
    HeartbeatSeen,
    NmtSeen,
    OtherHeartbeatSeen,
    RemoteSeen,
    SyncSeen,
)
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, Rule, Severity
from canprobe.fieldbus.tools.judge.seen_node import STATUSWORD

_PATIENCE_NS = 5_000_000_000


class WaitsForBootUp(Rule):
    """The master waits for the boot-up of a node that is running."""

    number, name, group, severity = 22, "waits for boot-up", "nmt", Severity.REFUSED
    source = "ros2_canopen#204, #329"
    expected = "a node that is there already is asked for 1000h, or reset"
    hint = "do not wait for a boot-up that came before the master"
    hears = (OtherHeartbeatSeen, SyncSeen)
    answers = True

    def begin(self) -> None:
        """Remember nothing yet."""
        self._first: BusFrame | None = None

    def see(self, event: BusEvent) -> None:
        """Remember the first sign of the master."""
        self._first = self._first or event.frame

    def end(self) -> None:
        """Look for running nodes that were never addressed."""
        first = self._first
        if first is None or self.bus.now_ns - first.t_ns < _PATIENCE_NS:
            return
        for node in self.bus.nodes.values():
            waits = node.nmt in (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL)  # else somebody has started it before
            if not waits:
                continue
            self.looked += 1
            if not node.addressed:
                seconds = (self.bus.now_ns - first.t_ns) * 1e-9
                self.blame(f"the node runs, and in {seconds:.1f} s nothing was sent to it", first, node_id=node.node_id)


class ResetsEnabled(Rule):
    """A node is reset while its axis is enabled."""

    number, name, group, severity = 24, "reset of an enabled axis", "nmt", Severity.UNSAFE
    source = "ros2_canopen#146; yarp-devices#252"
    expected = "axes are disabled before 81h or 82h is sent to them or to all"
    hint = "disable the drives, or name the node that needs the reset"
    hears = (NmtSeen,)

    def see(self, event: BusEvent) -> None:
        """Look at the state of the drives that are reset."""
        assert isinstance(event, NmtSeen)
        if event.command not in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            return
        self.looked += 1
        for node in event.nodes:
            if node.enabled and not node.silent(event.frame.t_ns):
                to = "all nodes" if event.to_all else "the node"
                what = f"NMT {event.command:02X}h to {to} while its drive is enabled"
                self.blame(what, frame_of(node.known(STATUSWORD)), event.frame, node_id=node.node_id)


class EnablesNotOperational(Rule):
    """RPDOs enable a drive whose node is not operational."""

    number, name, group, severity = 42, "enabled before operational", "nmt", Severity.REFUSED
    source = "canopen#309"
    expected = "NMT start before a controlword by RPDO"
    hint = "start the node, and wait for its heartbeat"
    hears = (ControlSeen,)

    def see(self, event: BusEvent) -> None:
        """Look at the NMT state, for controlwords by RPDO."""
        assert isinstance(event, ControlSeen)
        node = event.node
        up = command_of(event.word) in (
            DriveCommand.SHUTDOWN,
            DriveCommand.SWITCH_ON,
            DriveCommand.ENABLE_OPERATION,
        )
        if event.pdo is None or node.nmt is None or not up:
            return
        deaf = node.nmt in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED)
        if self.in_a_row(node.node_id, deaf and event.frame.t_ns - node.nmt_ns > QUEUED_NS):
            what = f"6040h = {event.word:04X}h by RPDO while the node is {node.nmt.name.lower().replace('_', '-')}"
            self.blame(what, event.frame, node_id=node.node_id)


class GuardsBesideHeartbeat(Rule):
    """Node guarding is used beside the heartbeat."""

    number, name, group, severity = 43, "guarding beside heartbeat", "nmt", Severity.WRONG
    source = "CiA 301, error control: one of them"
    expected = "no remote requests to 700h + id of a node that sends heartbeats"
    hint = "use the heartbeat only"
    hears = (RemoteSeen, HeartbeatSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._asked: dict[int, BusFrame] = {}
        self._unasked: set[int] = set()

    def see(self, event: BusEvent) -> None:
        """Tell answers to a request from heartbeats."""
        if isinstance(event, HeartbeatSeen):
            node_id = event.node.node_id
            asked = self._asked.get(node_id)
            answer = asked is not None and event.frame.t_ns - asked.t_ns < QUEUED_NS
            if event.state is not NmtState.INITIALISING and not answer:
                self._unasked.add(node_id)
            return
        node_id = (event.frame.can_id & 0x7FF) - HEARTBEAT_BASE
        if node_id not in self.bus.nodes:
            return
        before = self._asked.get(node_id)
        self._asked[node_id] = event.frame
        if self.in_a_row(node_id, node_id in self._unasked):
            what = "remote requests for the state of a node that sends heartbeats"
            self.blame(what, before, event.frame, node_id=node_id)


class SecondProducer(Rule):
    """Somebody else sends what a node or the master sends."""

    number, name, group, severity = 44, "second producer", "nmt", Severity.UNSAFE
    source = "ros_canopen#78"
    expected = "one producer of SYNC, and nobody who sends under identifiers of nodes"
    hint = "give the master an id of its own; let one device produce SYNC"
    hears = (ForgedSeen, SyncSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._before: SyncSeen | None = None

    def see(self, event: BusEvent) -> None:
        """Look for forged frames, and for SYNCs with a counter between those without."""
        if isinstance(event, ForgedSeen):
            if self.in_a_row(event.node.node_id, True):
                what = f"{event.frame.can_id:03X} is sent by somebody else than node {event.node.node_id}"
                self.blame(what, event.frame, node_id=event.node.node_id)
        elif isinstance(event, SyncSeen):
            before, self._before = self._before, event
            other = before is not None and (before.counter is None) is not (event.counter is None)
            if self.in_a_row("sync", other, 4):
                self.blame("SYNCs with and without a counter take turns", before.frame if before else None, event.frame)


NMT_RULES: tuple[type[Rule], ...] = (
    WaitsForBootUp,
    ResetsEnabled,
    EnablesNotOperational,
    GuardsBesideHeartbeat,
    SecondProducer,
)
