"""Rules on SYNC: jitter, gaps, counter, and the interpolation time that belongs to it."""

from __future__ import annotations

from canprobe.fieldbus.protocol.cia402 import DriveCommand, OperationMode, command_of
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import SyncSeen, TargetSeen
from canprobe.fieldbus.tools.judge.rule import BusRule, Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import CONTROLWORD, TARGET_POSITION, SeenNode

_INTERPOLATION_TIME = 0x60C2


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
            if not 0.5 * period_ns <= interval_ns <= 1.5 * period_ns:
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
            cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and event.index == TARGET_POSITION
            cyclic = cyclic and command_of(node.number(CONTROLWORD) or 0) is DriveCommand.ENABLE_OPERATION
            synchronous = event.pdo is not None and event.pdo.synchronous
            if judged or not (cyclic and synchronous) or node.syncs < self._ENOUGH:
                continue
            value, power = (node.value(_INTERPOLATION_TIME, sub) for sub in (1, 2))
            if not value or power is None or not node.is_sure(_INTERPOLATION_TIME):
                continue
            judged = True
            self.looked += 1
            period_ns, time_ns = self.bus.period_ns, value * 10.0 ** (power + 9)
            if abs(time_ns - period_ns) > self._SHARE * period_ns:
                what = f"60C2h is {time_ns * 1e-6:.3f} ms; SYNC comes every {period_ns * 1e-6:.3f} ms"
                self.blame(node, what, node.known(_INTERPOLATION_TIME, 1), event)
