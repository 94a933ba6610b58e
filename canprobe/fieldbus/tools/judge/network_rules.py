"""Rules on the network: NMT and who speaks in whose name, SYNC, and whether drives notice that their master is gone."""

from __future__ import annotations

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveCommand, OperationMode, command_of
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, NmtCommand, NmtState
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, SECOND_NS, Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_PATIENCE_NS = 5_000_000_000
_UP = (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION)
_SLACK_NS = 2_000_000
_GONE = 20
"""A gap of so many times is a master that was ended and begins again."""
_JITTER_SHARE, _LEAST_INTERVALS = 0.05, 200
"""Share of the period by which 99 % of the intervals of SYNC may differ, and how many there must be."""
_ENOUGH_SYNCS, _PERIOD_SHARE = 5, 0.05
"""SYNCs from which on the period is known, and the share by which 60C2h may differ from it."""


@rule(22, answers=True)
def waits_for_boot_up(case: Case, node: SeenNode) -> Watch[events.OtherHeartbeatSeen | events.SyncSeen]:
    """The master waits for the boot-up of a node that is running."""
    first: BusFrame | None = None  # sign of the master
    while event := (yield):
        first = first or event.frame
    if first is None or case.bus.now_ns - first.t_ns < _PATIENCE_NS:
        return
    if node.nmt in (NmtState.INITIALISING, NmtState.PRE_OPERATIONAL):  # else somebody has started it before
        seconds = (case.bus.now_ns - first.t_ns) * 1e-9
        case.expect(node, node.addressed, f"the node runs, and in {seconds:.1f} s nothing was sent to it", first)


@rule(24)
def resets_enabled(case: Case) -> Watch[events.NmtSeen]:
    """A node is reset while its axis is enabled."""
    while event := (yield):
        if event.command not in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            continue
        case.looked += 1
        for node in event.nodes:
            if node.enabled and not node.silent(event.frame.t_ns):
                to = "all nodes" if event.to_all else "the node"
                what = f"NMT {event.command:02X}h to {to} while its drive is enabled"
                case.blame(node, what, node.known(cia402.STATUSWORD), event)


@rule(42)
def enables_not_operational(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """RPDOs enable a drive whose node is not operational."""
    while event := (yield):
        if event.pdo is None or node.nmt is None or command_of(event.word) not in _UP:
            continue
        deaf = node.nmt in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED)
        if case.in_a_row(node, deaf and event.frame.t_ns - node.nmt_ns > QUEUED_NS):
            what = f"6040h = {event.word:04X}h by RPDO while the node is {node.nmt.name.lower().replace('_', '-')}"
            case.blame(node, what, event)


@rule(43)
def guards_beside_heartbeat(case: Case, node: SeenNode) -> Watch[events.RemoteSeen | events.HeartbeatSeen]:
    """Node guarding is used beside the heartbeat."""
    asked: BusFrame | None = None
    unasked = False  # whether a heartbeat came that answers no request
    while event := (yield):
        if isinstance(event, events.HeartbeatSeen):
            # the answer to a remote request looks like a heartbeat: same identifier, one byte, toggle bit aside
            answer = asked is not None and event.frame.t_ns - asked.t_ns < QUEUED_NS
            unasked = unasked or (event.state is not NmtState.INITIALISING and not answer)
        elif event.frame.can_id & 0x7FF == HEARTBEAT_BASE + node.node_id:
            before, asked = asked, event.frame
            if case.in_a_row(node, unasked):
                case.blame(node, "remote requests for the state of a node that sends heartbeats", before, event)


@rule(44)
def second_producer(case: Case) -> Watch[events.ForgedSeen | events.SyncSeen]:
    """Somebody else sends what a node or the master sends."""
    last: events.SyncSeen | None = None
    while event := (yield):
        if isinstance(event, events.ForgedSeen):
            if case.in_a_row(event.node, True):
                what = f"{event.frame.can_id:03X} is sent by somebody else than node {event.node.node_id}"
                case.blame(event.node, what, event)
            continue
        before, last = last, event
        other = before is not None and (before.counter is None) is not (event.counter is None)
        if case.in_a_row("sync", other, 4):
            case.blame(None, "SYNCs with and without a counter take turns", before, event)


@rule(32)
def irregular_sync(case: Case) -> Watch[events.SyncSeen]:
    """SYNC comes irregularly."""
    last: BusFrame | None = None
    worst: tuple[int, BusFrame | None, BusFrame | None] = (0, None, None)
    while event := (yield):
        settled = any(node.settled for node in case.bus.nodes.values())
        before, last = last, event.frame if settled else None
        period_ns = case.bus.period_ns
        if before is None or not period_ns:
            continue
        interval_ns = event.frame.t_ns - before.t_ns
        if 0.5 * period_ns < interval_ns < 1.5 * period_ns:  # gaps are another rule's
            case.intervals_ns.append(interval_ns)
            if (off := abs(interval_ns - period_ns)) > worst[0]:
                worst = off, before, event.frame
    period_ns, intervals = case.bus.period_ns, case.intervals_ns
    if len(intervals) < _LEAST_INTERVALS or not period_ns:
        return
    off = sorted(abs(interval - period_ns) for interval in intervals)[int(0.99 * len(intervals))]
    within = f"99 % of {len(intervals)} intervals are within {off * 1e-3:.0f} µs of {period_ns * 1e-3:.0f} µs"
    share = f"{100 * off / period_ns:.1f} %"
    case.expect(None, off <= _JITTER_SHARE * period_ns, f"{within}: {share}", *worst[1:])


@rule(33)
def sync_gaps(case: Case) -> Watch[events.SyncSeen]:
    """SYNCs are missing, double, or out of their count."""
    last: events.SyncSeen | None = None
    bad: BusFrame | None = None  # two within a second, or within three periods, are blamed
    while event := (yield):
        settled = any(node.settled for node in case.bus.nodes.values())
        before, last = last, event if settled else None
        period_ns = case.bus.period_ns
        if before is None or not settled or not period_ns:
            continue
        case.looked += 1
        interval_ns = event.frame.t_ns - before.frame.t_ns
        words = []
        if case.bus.now_ns and not 0.5 * period_ns <= interval_ns <= 1.5 * period_ns:  # 0: a log without times
            words.append(f"SYNC after {interval_ns * 1e-6:.2f} ms; the period is {period_ns * 1e-6:.2f} ms")
        if event.counter is not None and before.counter is not None:
            overflow = max((node.number(0x1019) or 0 for node in case.bus.nodes.values()), default=0)
            begins = event.counter == 1 and before.counter in (overflow, *([] if overflow else [before.counter]))
            if event.counter != before.counter + 1 and not begins:
                words.append(f"counter {event.counter} after {before.counter}")
        if words:
            if bad is not None and event.frame.t_ns - bad.t_ns < max(SECOND_NS, 3 * period_ns):
                case.blame(None, "; ".join(words), bad, before, event)
            bad = event.frame


@rule(36)
def interpolation_time(case: Case, node: SeenNode) -> Watch[events.TargetSeen]:
    """60C2h is not the period of SYNC."""
    judged = False
    while event := (yield):
        cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and event.index == cia402.TARGET_POSITION
        cyclic = cyclic and command_of(node.number(cia402.CONTROLWORD) or 0) is DriveCommand.ENABLE_OPERATION
        synchronous = event.pdo is not None and event.pdo.layout.synchronous
        if judged or not (cyclic and synchronous) or node.syncs < _ENOUGH_SYNCS:
            continue
        value, power = (node.value(cia402.INTERPOLATION_TIME, sub) for sub in (1, 2))
        if not value or power is None or not node.is_sure(cia402.INTERPOLATION_TIME):
            continue
        judged = True
        period_ns, time_ns = case.bus.period_ns, value * 10.0 ** (power + 9)
        near = abs(time_ns - period_ns) <= _PERIOD_SHARE * period_ns
        what = f"60C2h is {time_ns * 1e-6:.3f} ms; SYNC comes every {period_ns * 1e-6:.3f} ms"
        case.expect(node, near, what, node.known(cia402.INTERPOLATION_TIME, 1), event)


@rule(18)
def no_watchdog(case: Case, node: SeenNode) -> Watch[events.StatusSeen]:
    """An enabled drive cannot notice that its master is gone."""
    first: BusFrame | None = None
    judged = False
    while event := (yield):
        if not node.enabled:
            first = None
            continue
        first = first or event.frame
        if judged or event.frame.t_ns - first.t_ns < SECOND_NS or not node.is_sure(0x1016):
            continue
        judged = True
        what = "enabled for a second, and neither 1016h, 14xxh:05, guarding nor 1006h watches the master"
        case.expect(node, _is_watched(case, node), what, first, event)


def _is_watched(case: Case, node: SeenNode) -> bool:
    consumers = (node.value(0x1016, sub) or 0 for sub in range(1, 9))
    heartbeat = any(word & 0xFFFF and (word >> 16 & 0x7F) in case.bus.others for word in consumers)
    timers = any(pdo.event_timer_ms and node.rpdo_counts[pdo.number] for pdo in node.rpdos.values())
    guarding = node.value(0x100C) and node.value(0x100D)
    return bool(heartbeat or timers or guarding or (node.value(0x1006) and case.bus.syncs_ns))


@rule(48)
def starves_watchdog(case: Case, node: SeenNode) -> Watch[events.OtherHeartbeatSeen | events.RpdoSeen]:
    """The master is late for the watchdog that it has set up."""
    last: dict[int, BusFrame] = {}  # by number of the RPDO, -1 for the heartbeat
    while event := (yield):
        if isinstance(event, events.OtherHeartbeatSeen):
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
        gap_ns, allowed_ns = event.frame.t_ns - before.t_ns, allowed_ms * 1_000_000
        late = allowed_ns + _SLACK_NS + case.bus.arbitration_ns < gap_ns < _GONE * allowed_ns
        case.expect(node, not late, f"{gap_ns * 1e-6:.0f} ms without {what} {allowed_ms} ms", before, event)


def _consumer_ms(node: SeenNode, producer_id: int) -> int:
    """Time of 1016h for a producer, ms; 0 where the node does not consume its heartbeat."""
    words = (node.value(0x1016, sub) or 0 for sub in range(1, 9))
    return next((word & 0xFFFF for word in words if word >> 16 & 0x7F == producer_id), 0)
