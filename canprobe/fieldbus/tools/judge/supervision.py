"""Rules on supervision: whether a drive can notice that its master is gone, and whether the master lets it trip."""

from __future__ import annotations

from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import OtherHeartbeatSeen, RpdoSeen, StatusSeen
from canprobe.fieldbus.tools.judge.rule import Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_SECOND_NS = 1_000_000_000
_SLACK_NS = 2_000_000
_GONE = 20
"""A gap of so many times is a master that was ended and begins again."""


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
