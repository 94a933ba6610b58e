"""Rules on NMT: resets, states in which a node is commanded, and who speaks in whose name."""

from __future__ import annotations

from canprobe.fieldbus.protocol.cia402 import DriveCommand, command_of
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, NmtCommand, NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import (
    ControlSeen,
    ForgedSeen,
    HeartbeatSeen,
    NmtSeen,
    OtherHeartbeatSeen,
    RemoteSeen,
    SyncSeen,
)
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, BusRule, Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import STATUSWORD, SeenNode

_PATIENCE_NS = 5_000_000_000
_UP = (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION)


class WaitsForBootUp(Rule):
    """The master waits for the boot-up of a node that is running."""

    number, name, group, severity = 22, "waits for boot-up", "nmt", Severity.REFUSED
    source = "ros2_canopen#204, #329"
    expected = "a node that is there already is asked for 1000h, or reset"
    hint = "do not wait for a boot-up that came before the master"
    answers = True

    def watch(self, node: SeenNode) -> Watch[OtherHeartbeatSeen | SyncSeen]:
        first: BusFrame | None = None  # sign of the master
        while event := (yield):
            first = first or event.frame
        if first is None or self.bus.now_ns - first.t_ns < _PATIENCE_NS:
            return
        if node.nmt in (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL):  # else somebody has started it before
            self.looked += 1
            if not node.addressed:
                seconds = (self.bus.now_ns - first.t_ns) * 1e-9
                self.blame(node, f"the node runs, and in {seconds:.1f} s nothing was sent to it", first)


class ResetsEnabled(BusRule):
    """A node is reset while its axis is enabled."""

    number, name, group, severity = 24, "reset of an enabled axis", "nmt", Severity.UNSAFE
    source = "ros2_canopen#146; yarp-devices#252"
    expected = "axes are disabled before 81h or 82h is sent to them or to all"
    hint = "disable the drives, or name the node that needs the reset"

    def watch(self) -> Watch[NmtSeen]:
        while event := (yield):
            if event.command not in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
                continue
            self.looked += 1
            for node in event.nodes:
                if node.enabled and not node.silent(event.frame.t_ns):
                    to = "all nodes" if event.to_all else "the node"
                    what = f"NMT {event.command:02X}h to {to} while its drive is enabled"
                    self.blame(node, what, node.known(STATUSWORD), event)


class EnablesNotOperational(Rule):
    """RPDOs enable a drive whose node is not operational."""

    number, name, group, severity = 42, "enabled before operational", "nmt", Severity.REFUSED
    source = "canopen#309"
    expected = "NMT start before a controlword by RPDO"
    hint = "start the node, and wait for its heartbeat"

    def watch(self, node: SeenNode) -> Watch[ControlSeen]:
        while event := (yield):
            if event.pdo is None or node.nmt is None or command_of(event.word) not in _UP:
                continue
            deaf = node.nmt in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED)
            if self.in_a_row(node, deaf and event.frame.t_ns - node.nmt_ns > QUEUED_NS):
                what = f"6040h = {event.word:04X}h by RPDO while the node is {node.nmt.name.lower().replace('_', '-')}"
                self.blame(node, what, event)


class GuardsBesideHeartbeat(Rule):
    """Node guarding is used beside the heartbeat."""

    number, name, group, severity = 43, "guarding beside heartbeat", "nmt", Severity.WRONG
    source = "CiA 301, error control: one of them"
    expected = "no remote requests to 700h + id of a node that sends heartbeats"
    hint = "use the heartbeat only"

    def watch(self, node: SeenNode) -> Watch[RemoteSeen | HeartbeatSeen]:
        asked: BusFrame | None = None
        unasked = False  # whether a heartbeat came that answers no request
        while event := (yield):
            if isinstance(event, HeartbeatSeen):
                answer = asked is not None and event.frame.t_ns - asked.t_ns < QUEUED_NS
                unasked = unasked or (event.state is not NmtState.INITIALISING and not answer)
            elif event.frame.can_id & 0x7FF == HEARTBEAT_BASE + node.node_id:
                before, asked = asked, event.frame
                if self.in_a_row(node, unasked):
                    self.blame(node, "remote requests for the state of a node that sends heartbeats", before, event)


class SecondProducer(BusRule):
    """Somebody else sends what a node or the master sends."""

    number, name, group, severity = 44, "second producer", "nmt", Severity.UNSAFE
    source = "ros_canopen#78"
    expected = "one producer of SYNC, and nobody who sends under identifiers of nodes"
    hint = "give the master an id of its own; let one device produce SYNC"

    def watch(self) -> Watch[ForgedSeen | SyncSeen]:
        last: SyncSeen | None = None
        while event := (yield):
            if isinstance(event, ForgedSeen):
                if self.in_a_row(event.node, True):
                    what = f"{event.frame.can_id:03X} is sent by somebody else than node {event.node.node_id}"
                    self.blame(event.node, what, event)
                continue
            before, last = last, event
            other = before is not None and (before.counter is None) is not (event.counter is None)
            if self.in_a_row("sync", other, 4):
                self.blame(None, "SYNCs with and without a counter take turns", before, event)
