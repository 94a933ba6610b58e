"""Rules on supervision: whether a drive can notice that its master is gone, and whether the master lets it trip."""

from __future__ import annotations

from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import BusEvent, OtherHeartbeatSeen, RpdoSeen, StatusSeen
from canprobe.fieldbus.tools.judge.rule import Rule, Severity
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
    hears = (StatusSeen,)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._since: dict[int, BusFrame] = {}
        self._judged: set[int] = set()

    def see(self, event: BusEvent) -> None:
        """Judge once for each node, a second after it was enabled."""
        assert isinstance(event, StatusSeen)
        node, node_id = event.node, event.node.node_id
        if not node.enabled:
            self._since.pop(node_id, None)
            return
        first = self._since.setdefault(node_id, event.frame)
        if node_id in self._judged or event.frame.t_ns - first.t_ns < _SECOND_NS or not node.is_sure(0x1016):
            return
        self._judged.add(node_id)
        self.looked += 1
        if not self._is_watched(node):
            what = "enabled for a second, and neither 1016h, 14xxh:05, guarding nor 1006h watches the master"
            self.blame(what, first, event.frame, node_id=node_id)

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
    hears = (OtherHeartbeatSeen, RpdoSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._last: dict[tuple[int, int], BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Compare the gap with the time that the node allows."""
        if isinstance(event, OtherHeartbeatSeen):
            for node in self.bus.nodes.values():
                allowed_ms = _consumer_ms(node, event.node_id)
                if allowed_ms and node.operational:
                    what = f"heartbeat {event.node_id:02X}h; 1016h allows"
                    self._judge((node.node_id, -1), event.frame, allowed_ms, what)
        elif isinstance(event, RpdoSeen) and event.pdo.event_timer_ms and event.node.operational:
            what = f"RPDO {event.pdo.number}; 14xxh:05 allows"
            self._judge((event.node.node_id, event.pdo.number), event.frame, event.pdo.event_timer_ms, what)

    def _judge(self, key: tuple[int, int], frame: BusFrame, allowed_ms: int, what: str) -> None:
        before = self._last.get(key)
        self._last[key] = frame
        started_ns = self.bus.nodes[key[0]].started_ns
        if before is None or started_ns is None or before.t_ns < started_ns:
            return
        self.looked += 1
        gap_ns, allowed_ns = frame.t_ns - before.t_ns, allowed_ms * 1_000_000
        if allowed_ns + _SLACK_NS + self.bus.arbitration_ns < gap_ns < _GONE * allowed_ns:
            gap = f"{gap_ns * 1e-6:.0f} ms without "
            self.blame(f"{gap}{what} {allowed_ms} ms", before, frame, node_id=key[0])


def _consumer_ms(node: SeenNode, producer_id: int) -> int:
    """Time of 1016h for a producer, ms; 0 where the node does not consume its heartbeat."""
    words = (node.value(0x1016, sub) or 0 for sub in range(1, 9))
    return next((word & 0xFFFF for word in words if word >> 16 & 0x7F == producer_id), 0)


SUPERVISION_RULES: tuple[type[Rule], ...] = (NoWatchdog, StarvesWatchdog)
