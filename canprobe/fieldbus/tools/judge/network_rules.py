"""Rules on the network: NMT and who speaks in whose name, SYNC, and whether drives notice that their master is gone."""

from __future__ import annotations

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveCommand, OperationMode, command_of
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, NmtCommand, NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import (
    ControlSeen,
    ForgedSeen,
    HeartbeatSeen,
    NmtSeen,
    OtherHeartbeatSeen,
    RemoteSeen,
    RpdoSeen,
    StatusSeen,
    SyncSeen,
    TargetSeen,
)
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, BusRule, Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_PATIENCE_NS = 5_000_000_000
_UP = (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION)
_SECOND_NS = 1_000_000_000
_SLACK_NS = 2_000_000
_GONE = 20
"""A gap of so many times is a master that was ended and begins again."""


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
                    self.blame(node, what, node.known(cia402.STATUSWORD), event)


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


class IrregularSync(BusRule):
    """SYNC comes irregularly."""

    number, name, group, severity = 32, "SYNC jitter", "sync", Severity.WRONG
    source = "canopen#285; ros_canopen#293"
    expected = "intervals of SYNC within 5 % of the period, 99 in 100"
    hint = "send SYNC from a loop with absolute deadlines, at a real-time priority"
    _SHARE, _LEAST = 0.05, 200

    def watch(self) -> Watch[SyncSeen]:
        last: BusFrame | None = None
        worst: tuple[int, BusFrame | None, BusFrame | None] = (0, None, None)
        self.intervals_ns: list[int] = []
        while event := (yield):
            settled = any(node.settled for node in self.bus.nodes.values())
            before, last = last, event.frame if settled else None
            period_ns = self.bus.period_ns
            if before is None or not period_ns:
                continue
            interval_ns = event.frame.t_ns - before.t_ns
            if 0.5 * period_ns < interval_ns < 1.5 * period_ns:  # gaps are another rule's
                self.intervals_ns.append(interval_ns)
                if (off := abs(interval_ns - period_ns)) > worst[0]:
                    worst = off, before, event.frame
        period_ns, intervals = self.bus.period_ns, self.intervals_ns
        if len(intervals) < self._LEAST or not period_ns:
            return
        self.looked += 1
        off = sorted(abs(interval - period_ns) for interval in intervals)[int(0.99 * len(intervals))]
        if off > self._SHARE * period_ns:
            within = f"99 % of {len(intervals)} intervals are within {off * 1e-3:.0f} µs of {period_ns * 1e-3:.0f} µs"
            self.blame(None, f"{within}: {100 * off / period_ns:.1f} %", *worst[1:])


class SyncGaps(BusRule):
    """SYNCs are missing, double, or out of their count."""

    number, name, group, severity = 33, "SYNC gaps", "sync", Severity.WRONG
    source = "CiA 301, 1006h and 1019h"
    expected = "one SYNC a period, and a counter that goes up by 1 and begins again after 1019h"
    hint = "let one loop send SYNC and do nothing that takes longer than a period"
    _NEAR_NS = 1_000_000_000

    def watch(self) -> Watch[SyncSeen]:
        last: SyncSeen | None = None
        bad: BusFrame | None = None  # two within a second, or within three periods, are blamed
        while event := (yield):
            settled = any(node.settled for node in self.bus.nodes.values())
            before, last = last, event if settled else None
            period_ns = self.bus.period_ns
            if before is None or not settled or not period_ns:
                continue
            self.looked += 1
            interval_ns = event.frame.t_ns - before.frame.t_ns
            words = []
            if self.bus.now_ns and not 0.5 * period_ns <= interval_ns <= 1.5 * period_ns:  # 0: a log without times
                words.append(f"SYNC after {interval_ns * 1e-6:.2f} ms; the period is {period_ns * 1e-6:.2f} ms")
            if event.counter is not None and before.counter is not None:
                overflow = max((node.number(0x1019) or 0 for node in self.bus.nodes.values()), default=0)
                begins = event.counter == 1 and before.counter in (overflow, *([] if overflow else [before.counter]))
                if event.counter != before.counter + 1 and not begins:
                    words.append(f"counter {event.counter} after {before.counter}")
            if words:
                if bad is not None and event.frame.t_ns - bad.t_ns < max(self._NEAR_NS, 3 * period_ns):
                    self.blame(None, "; ".join(words), bad, before, event)
                bad = event.frame


class InterpolationTime(Rule):
    """60C2h is not the period of SYNC."""

    number, name, group, severity = 36, "interpolation time", "sync", Severity.UNSAFE
    source = "maxon_epos_ethercat_sdk PR 3"
    expected = "in CSP, 60C2h equals the period of SYNC"
    hint = "write 60C2h:01 and :02 for the period, and read them back"
    _ENOUGH, _SHARE = 5, 0.05

    def watch(self, node: SeenNode) -> Watch[TargetSeen]:
        judged = False
        while event := (yield):
            cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and event.index == cia402.TARGET_POSITION
            cyclic = cyclic and command_of(node.number(cia402.CONTROLWORD) or 0) is DriveCommand.ENABLE_OPERATION
            synchronous = event.pdo is not None and event.pdo.synchronous
            if judged or not (cyclic and synchronous) or node.syncs < self._ENOUGH:
                continue
            value, power = (node.value(cia402.INTERPOLATION_TIME, sub) for sub in (1, 2))
            if not value or power is None or not node.is_sure(cia402.INTERPOLATION_TIME):
                continue
            judged = True
            self.looked += 1
            period_ns, time_ns = self.bus.period_ns, value * 10.0 ** (power + 9)
            if abs(time_ns - period_ns) > self._SHARE * period_ns:
                what = f"60C2h is {time_ns * 1e-6:.3f} ms; SYNC comes every {period_ns * 1e-6:.3f} ms"
                self.blame(node, what, node.known(cia402.INTERPOLATION_TIME, 1), event)


class NoWatchdog(Rule):
    """An enabled drive cannot notice that its master is gone."""

    number, name, group, severity = 18, "no watchdog", "supervision", Severity.UNSAFE
    source = "ros_canopen#367"
    expected = "1016h with a heartbeat of the master, 14xxh:05, node guarding, or 1006h with SYNC"
    hint = "write 1016h:01 and produce a heartbeat, or set 14xxh:05"

    def watch(self, node: SeenNode) -> Watch[StatusSeen]:
        first: BusFrame | None = None
        judged = False
        while event := (yield):
            if not node.enabled:
                first = None
                continue
            first = first or event.frame
            if judged or event.frame.t_ns - first.t_ns < _SECOND_NS or not node.is_sure(0x1016):
                continue
            judged = True
            self.looked += 1
            if not self._is_watched(node):
                what = "enabled for a second, and neither 1016h, 14xxh:05, guarding nor 1006h watches the master"
                self.blame(node, what, first, event)

    def _is_watched(self, node: SeenNode) -> bool:
        consumers = (node.value(0x1016, sub) or 0 for sub in range(1, 9))
        heartbeat = any(word & 0xFFFF and (word >> 16 & 0x7F) in self.bus.others_ns for word in consumers)
        timers = any(pdo.event_timer_ms and node.rpdo_counts.get(pdo.number) for pdo in node.rpdos.values())
        guarding = node.value(0x100C) and node.value(0x100D)
        return bool(heartbeat or timers or guarding or (node.value(0x1006) and self.bus.syncs_ns))


class StarvesWatchdog(Rule):
    """The master is late for the watchdog that it has set up."""

    number, name, group, severity = 48, "watchdog starved", "supervision", Severity.WRONG
    source = "ros_odrive#32"
    expected = "the master's heartbeat within 1016h, and RPDOs within 14xxh:05"
    hint = "send heartbeat and RPDOs from a loop that nothing blocks"

    def watch(self, node: SeenNode) -> Watch[OtherHeartbeatSeen | RpdoSeen]:
        last: dict[int, BusFrame] = {}  # by number of the RPDO, -1 for the heartbeat
        while event := (yield):
            if isinstance(event, OtherHeartbeatSeen):
                key, allowed_ms = -1, _consumer_ms(node, event.node_id)
                what = f"heartbeat {event.node_id:02X}h; 1016h allows"
            else:
                key, allowed_ms = event.pdo.number, event.pdo.event_timer_ms
                what = f"RPDO {event.pdo.number}; 14xxh:05 allows"
            if not allowed_ms or not node.operational:
                continue
            before, last[key] = last.get(key), event.frame
            if before is None or node.started_ns is None or before.t_ns < node.started_ns:
                continue
            self.looked += 1
            gap_ns, allowed_ns = event.frame.t_ns - before.t_ns, allowed_ms * 1_000_000
            if allowed_ns + _SLACK_NS + self.bus.arbitration_ns < gap_ns < _GONE * allowed_ns:
                self.blame(node, f"{gap_ns * 1e-6:.0f} ms without {what} {allowed_ms} ms", before, event)


def _consumer_ms(node: SeenNode, producer_id: int) -> int:
    """Time of 1016h for a producer, ms; 0 where the node does not consume its heartbeat."""
    words = (node.value(0x1016, sub) or 0 for sub in range(1, 9))
    return next((word & 0xFFFF for word in words if word >> 16 & 0x7F == producer_id), 0)
