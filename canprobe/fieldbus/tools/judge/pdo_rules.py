"""Rules on PDOs: what the first one carries, how often they come, and how they are configured."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS, RPDOS, TO_MAPPING, is_mapping
from canprobe.fieldbus.protocol.sdo import place_text
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, SECOND_NS, Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_node import TARGETS, SeenNode

_HARMLESS = {cia402.CONTROLWORD, cia402.TARGET_VELOCITY, cia402.TARGET_TORQUE, 0x60B0, 0x60B1, 0x60B2, 0x60FE}
"""Objects of which 0 is a quiet value."""
_PROFILE = range(0x6040, 0x6100)
_CYCLIC_SYNCS = 10
"""SYNCs in a row with one RPDO each from which on one is expected at every SYNC."""
_WANTED_TARGETS = 10
"""Targets in a row that show that they are not bound to SYNC."""
_USUAL_GAPS = 10
"""Intervals of an RPDO whose median is the usual one."""
_BURST_FRAMES = 3
"""RPDOs behind a gap, each closer than half the usual interval, that are a backlog."""


@rule(6)
def zero_filled(case: Case, node: SeenNode) -> Watch[events.RpdoSeen | events.StatusSeen]:
    """The first RPDO has zeros in objects that were something else."""
    unjudged: BusFrame | None = None  # a target of 0, which is compared with the position once that is seen
    while event := (yield):
        if isinstance(event, events.StatusSeen):
            if unjudged is not None and node.known(cia402.POSITION) is not None:
                _judge_target(case, node, unjudged)
                unjudged = None
            continue
        if node.rpdo_counts[event.pdo.number] != 1:
            continue
        case.looked += 1
        for place, value in event.values.items():
            index = place[0]
            if value or index not in _PROFILE or index in _HARMLESS:
                continue
            if index == cia402.TARGET_POSITION:
                if node.known(cia402.POSITION) is None:
                    unjudged = event.frame
                else:
                    _judge_target(case, node, event.frame)
                continue
            shown = node.known(cia402.MODE_DISPLAY) if index == cia402.MODE else None
            if was := (shown.value if shown is not None else event.before[place]):
                what = f"{place_text(*place)} is 0 in the first RPDO {event.pdo.number}; it was {was}"
                case.blame(node, what, shown, event)


def _judge_target(case: Case, node: SeenNode, first: BusFrame) -> None:
    position = node.known(cia402.POSITION)
    if position is not None and abs(position.value) > node.tolerance(case.bus.period_ns):
        case.blame(node, f"607Ah is 0 in the first RPDO, and the axis is at {position.value}", position, first)


@rule(7)
def never_sent(case: Case, node: SeenNode) -> Watch[events.BusEvent]:
    """An RPDO that the master prepared is never sent."""
    yield  # the end of the bus: it hears no event
    started_ns = node.started_ns
    if not node.operational or started_ns is None or case.bus.now_ns - started_ns < SECOND_NS:
        return
    control = node.known(cia402.CONTROLWORD)
    by_sdo = control is not None and control.t_ns > started_ns and not any(node.rpdo_counts.values())
    for pdo in node.rpdos.values():
        if not pdo.used or not pdo.maps(cia402.CONTROLWORD, *TARGETS):
            continue
        sent = bool(node.rpdo_counts[pdo.number]) or (by_sdo and not pdo.maps(*TARGETS))
        seconds, kind = (case.bus.now_ns - started_ns) * 1e-9, f"type {pdo.layout.transmission_type}"
        what = f"RPDO {pdo.number} ({kind}) was not sent in {seconds:.1f} s of operational"
        case.expect(node, sent, what, node.known(RPDOS[pdo.number - 1], 1))


@rule(23)
def written_while_operational(case: Case, node: SeenNode) -> Watch[events.RequestSeen]:
    """PDO parameters are written after the NMT start."""
    while event := (yield):
        if not event.writes or event.place[0] not in PDO_OBJECTS or node.nmt is None:
            continue
        in_time = not node.operational or event.frame.t_ns - node.nmt_ns <= QUEUED_NS
        case.expect(node, in_time, f"{place_text(*event.place)} is written while the node is operational", event)


@rule(25)
def remapped_while_valid(case: Case, node: SeenNode) -> Watch[events.RequestSeen]:
    """A mapping is changed while the PDO is valid or sub-index 0 is not 0."""
    while event := (yield):
        index, subindex = event.place
        if not is_mapping(index) or not event.writes or not subindex or event.value == node.sure_value(index, subindex):
            continue
        parameters = index - TO_MAPPING
        cob_id, count = node.sure_value(parameters, 1), node.sure_value(index)
        valid = cob_id is not None and not cob_id & INVALID_FLAG
        why = f"{parameters:04X}h:01 is {cob_id:08X}h, valid" if valid else f"{index:04X}h:00 is {count}, not 0"
        shown, what = node.known(parameters, 1) if valid else node.known(index), place_text(*event.place)
        case.expect(node, not (valid or count), f"{what} is written while {why}", shown, event)


@rule(27)
def length_not_mapping(case: Case, node: SeenNode) -> Watch[events.RpdoSeen]:
    """RPDOs have another length than their mapping."""
    while event := (yield):
        if not event.pdo.certain:
            continue
        got, wanted = len(event.frame.data), event.pdo.layout.length
        if case.in_a_row((node, event.pdo.number), got != wanted):
            case.blame(node, f"RPDO {event.pdo.number} has {got} bytes; its mapping has {wanted}", event)


@rule(34)
def not_one_each_sync(case: Case, node: SeenNode) -> Watch[events.RpdoSeen | events.SyncSeen]:
    """Two RPDOs, or none, come between two SYNCs."""
    between: dict[int, list[BusFrame]] = {}  # frames since the last SYNC, by number of the RPDO
    cyclic: dict[int, int] = {}
    last: dict[int, deque[int]] = {}
    while event := (yield):
        if isinstance(event, events.RpdoSeen):
            if event.pdo.layout.synchronous and node.settled and event.pdo.maps(*TARGETS):
                between.setdefault(event.pdo.number, []).append(event.frame)
            continue
        for number, frames in between.items():
            count, between[number] = len(frames), []
            regular = cyclic.get(number, 0)
            cyclic[number] = regular + 1 if count == 1 or regular >= _CYCLIC_SYNCS else 0
            if regular < _CYCLIC_SYNCS or not node.settled or not node.enabled:
                last.pop(number, None)
                continue
            counts = last.setdefault(number, deque(maxlen=10))
            counts.append(count)
            case.looked += 1
            double = count > 1 and len(counts) > 1 and counts[-2] > 1
            gap = count and list(counts)[-3:-1] == [0, 0]  # an RPDO that never comes again is another rule's
            if double or gap or (count and sum(one != 1 for one in counts) > 4):
                what = f"RPDO {number} came {', '.join(map(str, counts))} times between SYNCs"
                case.blame(node, what, *frames, event)
                counts.clear()


@rule(35)
def outside_window(case: Case, node: SeenNode) -> Watch[events.RpdoSeen]:
    """Synchronous RPDOs come after the window of 1007h."""
    while event := (yield):
        window_us = node.number(0x1007)
        if not window_us or not event.pdo.layout.synchronous or not node.settled or not case.bus.syncs_ns:
            continue
        late_ns = event.frame.t_ns - case.bus.syncs_ns[-1]
        late = late_ns > window_us * 1000 + case.bus.arbitration_ns
        if case.in_a_row((node, event.pdo.number), late):
            what = f"RPDO {event.pdo.number} came {late_ns // 1000} µs after SYNC; 1007h is {window_us} µs"
            case.blame(node, what, event)


@rule(37)
def cyclic_without_sync(case: Case, node: SeenNode) -> Watch[events.TargetSeen]:
    """Targets of CSP are not bound to SYNC."""
    while event := (yield):
        pdo = event.pdo
        cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and node.enabled
        if pdo is None or not cyclic or event.index != cia402.TARGET_POSITION or not pdo.certain:
            continue
        kind = pdo.layout.transmission_type
        since_ns = event.frame.t_ns - max(case.bus.syncs_ns[-1] if case.bus.syncs_ns else 0, node.started_ns or 0)
        if case.in_a_row((node, "type"), kind >= 254, _WANTED_TARGETS):
            what = f"RPDO {pdo.number} with 607Ah has the transmission type {kind}: the drive takes it at any time"
            case.blame(node, what, node.known(RPDOS[pdo.number - 1], 2), event)
        if case.in_a_row((node, "sync"), pdo.layout.synchronous and since_ns > SECOND_NS, _WANTED_TARGETS):
            what = f"RPDO {pdo.number} of type {kind} is sent without a SYNC: the drive never takes it"
            case.blame(node, what, event)


@rule(45)
def backlog_sent(case: Case, node: SeenNode) -> Watch[events.RpdoSeen]:
    """After a silence, old RPDOs come all at once."""
    last: dict[int, deque[BusFrame]] = {}  # frames by number of the RPDO
    bursts: dict[int, int] = {}  # frames closer than half the usual interval, after a gap of four
    while event := (yield):
        number = event.pdo.number
        frames = last.setdefault(number, deque(maxlen=_USUAL_GAPS + 1))
        if len(frames) > _USUAL_GAPS:
            gaps = sorted(b.t_ns - a.t_ns for a, b in pairwise(frames))
            usual, gap = gaps[len(gaps) // 2], event.frame.t_ns - frames[-1].t_ns
            if gap > 4 * usual:
                bursts[number] = 1
            elif number in bursts:
                case.looked += 1
                bursts[number] = bursts[number] + 1 if gap < usual / 2 else 0
                if bursts[number] == _BURST_FRAMES:
                    what = f"after a silence RPDO {number} came {_BURST_FRAMES} times, {gap * 1e-6:.2f} ms apart"
                    case.blame(node, what, *list(frames)[-2:], event)
                if bursts[number] in (0, _BURST_FRAMES):
                    del bursts[number]
        frames.append(event.frame)
