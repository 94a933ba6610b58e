"""Rules on PDOs: what the first one carries, how often they come, and how they are configured."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.sdo import place_text
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import BusEvent, RequestSeen, RpdoSeen, StatusSeen, SyncSeen, TargetSeen
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import TARGETS, SeenNode

_SECOND_NS = 1_000_000_000
_HARMLESS = {cia402.CONTROLWORD, cia402.TARGET_VELOCITY, cia402.TARGET_TORQUE, 0x60B0, 0x60B1, 0x60B2, 0x60FE}
"""Objects of which 0 is a quiet value."""
_PROFILE = range(0x6040, 0x6100)


class ZeroFilled(Rule):
    """The first RPDO has zeros in objects that were something else."""

    number, name, group, severity = 6, "first RPDO zero-filled", "pdo", Severity.UNSAFE
    source = "measured with canopen 2.4.1, BaseNode402"
    expected = "the first RPDO has the actual values of all objects in it"
    hint = "fill in 6061h as 6060h and 6064h as 607Ah before the RPDO is sent"

    def watch(self, node: SeenNode) -> Watch[RpdoSeen | StatusSeen]:
        unjudged: BusFrame | None = None  # a target of 0, which is compared with the position once that is seen
        while event := (yield):
            if isinstance(event, StatusSeen):
                if unjudged is not None and node.known(cia402.POSITION) is not None:
                    self._judge_target(node, unjudged)
                    unjudged = None
                continue
            if node.rpdo_counts[event.pdo.number] != 1:
                continue
            self.looked += 1
            for place, value in event.values.items():
                index = place[0]
                if value or index not in _PROFILE or index in _HARMLESS:
                    continue
                if index == cia402.TARGET_POSITION:
                    if node.known(cia402.POSITION) is None:
                        unjudged = event.frame
                    else:
                        self._judge_target(node, event.frame)
                    continue
                shown = node.known(cia402.MODE_DISPLAY) if index == cia402.MODE else None
                if was := (shown.value if shown is not None else event.before[place]):
                    what = f"{place_text(*place)} is 0 in the first RPDO {event.pdo.number}; it was {was}"
                    self.blame(node, what, shown, event)

    def _judge_target(self, node: SeenNode, first: BusFrame) -> None:
        position = node.known(cia402.POSITION)
        if position is not None and abs(position.value) > node.tolerance(self.bus.period_ns):
            what = f"607Ah is 0 in the first RPDO, and the axis is at {position.value}"
            self.blame(node, what, position, first)


class NeverSent(Rule):
    """An RPDO that the master prepared is never sent."""

    number, name, group, severity = 7, "RPDO never sent", "pdo", Severity.REFUSED
    source = "measured with canopen 2.4.1: types up to F0h count as periodic"
    expected = "an RPDO with 6040h or a target that the master has read or configured is sent in operational"
    hint = "start the RPDO, or transmit it after each change, or make it invalid"

    def watch(self, node: SeenNode) -> Watch[BusEvent]:
        yield  # the end of the bus: it hears no event
        started_ns = node.started_ns
        if not node.operational or started_ns is None or self.bus.now_ns - started_ns < _SECOND_NS:
            return
        control = node.known(cia402.CONTROLWORD)
        by_sdo = control is not None and control.t_ns > started_ns and not any(node.rpdo_counts.values())
        for pdo in node.rpdos.values():
            if not pdo.used or not pdo.maps(cia402.CONTROLWORD, *TARGETS):
                continue
            sent = bool(node.rpdo_counts.get(pdo.number)) or (by_sdo and not pdo.maps(*TARGETS))
            seconds, kind = (self.bus.now_ns - started_ns) * 1e-9, f"type {pdo.layout.transmission_type}"
            what = f"RPDO {pdo.number} ({kind}) was not sent in {seconds:.1f} s of operational"
            self.expect(node, sent, what, node.known(0x13FF + pdo.number, 1))


class WrittenWhileOperational(Rule):
    """PDO parameters are written after the NMT start."""

    number, name, group, severity = 23, "PDO written in operational", "pdo", Severity.WRONG
    expected = "1400h to 1BFFh are written in pre-operational"
    hint = "configure all PDOs, and start the node after that"

    def watch(self, node: SeenNode) -> Watch[RequestSeen]:
        while event := (yield):
            if not event.writes or event.place[0] not in range(0x1400, 0x1C00) or node.nmt is None:
                continue
            in_time = not node.operational or event.frame.t_ns - node.nmt_ns <= QUEUED_NS
            self.expect(node, in_time, f"{place_text(*event.place)} is written while the node is operational", event)


class RemappedWhileValid(Rule):
    """A mapping is changed while the PDO is valid or sub-index 0 is not 0."""

    number, name, group, severity = 25, "remapped while valid", "pdo", Severity.REFUSED
    source = "canopen PR 3; CiA 301, 1600h, 1A00h"
    expected = "COB-ID with bit 31, sub-index 0 = 0, the entries, sub-index 0, COB-ID without bit 31"
    hint = "disable the PDO and write 0 to sub-index 0 of its mapping first"

    def watch(self, node: SeenNode) -> Watch[RequestSeen]:
        while event := (yield):
            index, subindex = event.place
            mapping = 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00
            if not mapping or not event.writes or not subindex or event.value == node.sure_value(index, subindex):
                continue
            parameters = index - 0x200
            cob_id, count = node.sure_value(parameters, 1), node.sure_value(index)
            valid = cob_id is not None and not cob_id & INVALID_FLAG
            why = f"{parameters:04X}h:01 is {cob_id:08X}h, valid" if valid else f"{index:04X}h:00 is {count}, not 0"
            shown, what = node.known(parameters, 1) if valid else node.known(index), place_text(*event.place)
            self.expect(node, not (valid or count), f"{what} is written while {why}", shown, event)


class LengthNotMapping(Rule):
    """RPDOs have another length than their mapping."""

    number, name, group, severity = 27, "RPDO length", "pdo", Severity.WRONG
    source = "ros2_canopen#36; ros_canopen#425; CiA 301, 8210h and 8220h"
    expected = "as many bytes as the mapping has"
    hint = "compute the length from 1600h"

    def watch(self, node: SeenNode) -> Watch[RpdoSeen]:
        while event := (yield):
            if not event.pdo.certain:
                continue
            got, wanted = len(event.frame.data), event.pdo.layout.length
            if self.in_a_row((node, event.pdo.number), got != wanted):
                self.blame(node, f"RPDO {event.pdo.number} has {got} bytes; its mapping has {wanted}", event)


class NotOneEachSync(Rule):
    """Two RPDOs, or none, come between two SYNCs."""

    number, name, group, severity = 34, "RPDOs between SYNCs", "pdo", Severity.WRONG
    source = "yarp-devices#254"
    expected = "one RPDO of each synchronous number between two SYNCs, once they come with each"
    hint = "send the RPDOs from the loop that sends SYNC, after the TPDOs"
    _CYCLIC = 10

    def watch(self, node: SeenNode) -> Watch[RpdoSeen | SyncSeen]:
        between: dict[int, list[BusFrame]] = {}  # frames since the last SYNC, by number of the RPDO
        cyclic: dict[int, int] = {}
        last: dict[int, deque[int]] = {}
        while event := (yield):
            if isinstance(event, RpdoSeen):
                if event.pdo.synchronous and node.settled and event.pdo.maps(*TARGETS):
                    between.setdefault(event.pdo.number, []).append(event.frame)
                continue
            for number, frames in between.items():
                count, between[number] = len(frames), []
                regular = cyclic.get(number, 0)
                cyclic[number] = regular + 1 if count == 1 or regular >= self._CYCLIC else 0
                if regular < self._CYCLIC or not node.settled or not node.enabled:
                    last.pop(number, None)
                    continue
                counts = last.setdefault(number, deque(maxlen=10))
                counts.append(count)
                self.looked += 1
                double = count > 1 and len(counts) > 1 and counts[-2] > 1
                gap = count and list(counts)[-3:-1] == [0, 0]  # an RPDO that never comes again is another rule's
                if double or gap or (count and sum(one != 1 for one in counts) > 4):
                    what = f"RPDO {number} came {', '.join(map(str, counts))} times between SYNCs"
                    self.blame(node, what, *frames, event)
                    counts.clear()


class OutsideWindow(Rule):
    """Synchronous RPDOs come after the window of 1007h."""

    number, name, group, severity = 35, "RPDO outside the window", "pdo", Severity.WRONG
    source = "CiA 301, 1007h"
    expected = "synchronous RPDOs within 1007h after SYNC"
    hint = "send earlier, or write a longer 1007h"

    def watch(self, node: SeenNode) -> Watch[RpdoSeen]:
        while event := (yield):
            window_us = node.number(0x1007)
            if not window_us or not event.pdo.synchronous or not node.settled or not self.bus.syncs_ns:
                continue
            late_ns = event.frame.t_ns - self.bus.syncs_ns[-1]
            late = late_ns > window_us * 1000 + self.bus.arbitration_ns
            if self.in_a_row((node, event.pdo.number), late):
                what = f"RPDO {event.pdo.number} came {late_ns // 1000} µs after SYNC; 1007h is {window_us} µs"
                self.blame(node, what, event)


class CyclicWithoutSync(Rule):
    """Targets of CSP are not bound to SYNC."""

    number, name, group, severity = 37, "CSP without SYNC", "pdo", Severity.WRONG
    source = "CiA 402-2, cyclic synchronous position"
    expected = "targets of CSP in a synchronous RPDO (type 1), and a SYNC for each"
    hint = "set 14xxh:02 to 1, and produce SYNC"
    _WANTED = 10

    def watch(self, node: SeenNode) -> Watch[TargetSeen]:
        while event := (yield):
            pdo = event.pdo
            cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and node.enabled
            if pdo is None or not cyclic or event.index != cia402.TARGET_POSITION or not pdo.certain:
                continue
            kind = pdo.layout.transmission_type
            since_ns = event.frame.t_ns - max(self.bus.syncs_ns[-1] if self.bus.syncs_ns else 0, node.started_ns or 0)
            if self.in_a_row((node, "type"), kind >= 254, self._WANTED):
                what = f"RPDO {pdo.number} with 607Ah has the transmission type {kind}: the drive takes it at any time"
                self.blame(node, what, node.known(0x13FF + pdo.number, 2), event)
            if self.in_a_row((node, "sync"), pdo.synchronous and since_ns > _SECOND_NS, self._WANTED):
                what = f"RPDO {pdo.number} of type {kind} is sent without a SYNC: the drive never takes it"
                self.blame(node, what, event)


class BacklogSent(Rule):
    """After a silence, old RPDOs come all at once."""

    number, name, group, severity = 45, "backlog of RPDOs", "pdo", Severity.WRONG
    expected = "after bus-off or a stall, the newest RPDO only"
    hint = "empty the transmit queue when the controller comes back"
    _USUAL = 10
    _BURST = 3

    def watch(self, node: SeenNode) -> Watch[RpdoSeen]:
        last: dict[int, deque[BusFrame]] = {}  # frames by number of the RPDO
        bursts: dict[int, int] = {}  # frames closer than half the usual interval, after a gap of four
        while event := (yield):
            number = event.pdo.number
            frames = last.setdefault(number, deque(maxlen=self._USUAL + 1))
            if len(frames) > self._USUAL:
                gaps = sorted(b.t_ns - a.t_ns for a, b in pairwise(frames))
                usual, gap = gaps[len(gaps) // 2], event.frame.t_ns - frames[-1].t_ns
                if gap > 4 * usual:
                    bursts[number] = 1
                elif number in bursts:
                    self.looked += 1
                    bursts[number] = bursts[number] + 1 if gap < usual / 2 else 0
                    if bursts[number] == self._BURST:
                        what = f"after a silence RPDO {number} came {self._BURST} times, {gap * 1e-6:.2f} ms apart"
                        self.blame(node, what, *list(frames)[-2:], event)
                    if bursts[number] in (0, self._BURST):
                        del bursts[number]
            frames.append(event.frame)
