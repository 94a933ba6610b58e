"""Rules on homing: when it is started, and how."""

from __future__ import annotations

from canprobe.fieldbus.protocol.cia402 import HOMING_ATTAINED_BIT, HOMING_ERROR_BIT, HOMING_START_BIT, OperationMode
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import frame_of
from canprobe.fieldbus.tools.judge.events import BusEvent, ControlSeen, HeartbeatSeen, StatusSeen
from canprobe.fieldbus.tools.judge.rule import Rule, Severity
from canprobe.fieldbus.tools.judge.seen_node import MODE, MODE_DISPLAY


class HomesAgain(Rule):
    """An axis is homed although it has its reference."""

    number, name, group, severity = 13, "homed again", "homing", Severity.WRONG
    source = "ros2_canopen PR 200"
    expected = "an axis with its reference (6041h bit 12 in homing) is not homed again before it boots or loses it"
    hint = "read 6041h in mode 6 before homing is started"
    hears = (StatusSeen, ControlSeen, HeartbeatSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._referenced: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Remember who has its reference, and look at starts of homing."""
        assert isinstance(event, StatusSeen | ControlSeen | HeartbeatSeen)
        node, node_id = event.node, event.node.node_id
        if isinstance(event, HeartbeatSeen):
            if event.state is NmtState.INITIALISING:
                self._referenced.pop(node_id, None)
        elif node.number(MODE_DISPLAY) != OperationMode.HOMING:
            return
        elif isinstance(event, StatusSeen):
            attained = event.word >> HOMING_ATTAINED_BIT & 1 and not event.word >> HOMING_ERROR_BIT & 1
            if attained:
                self._referenced.setdefault(node_id, event.frame)
            else:
                self._referenced.pop(node_id, None)
        elif _rises(event) and node.enabled:
            self.looked += 1
            if (shown := self._referenced.get(node_id)) is not None:
                self.blame("homing is started on an axis that has its reference", shown, event.frame, node_id=node_id)


class HomingStart(Rule):
    """Homing is started in another mode, or without an edge."""

    number, name, group, severity = 14, "homing start", "homing", Severity.WRONG
    source = "ethercat_driver_ros2#141"
    expected = "6061h = 6 seen, and then a rising edge of bit 4"
    hint = "write 6060h = 6, read 6061h, send 000Fh, and 001Fh after that"
    hears = (ControlSeen,)
    _LONGEST_NS = 500_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._set: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Judge bit 4 while homing is asked for."""
        assert isinstance(event, ControlSeen)
        node, node_id = event.node, event.node.node_id
        asked = node.known(MODE)
        if not event.word >> HOMING_START_BIT & 1:
            self._set.pop(node_id, None)
            return
        first = self._set.setdefault(node_id, event.frame)
        if asked is None or asked.value != OperationMode.HOMING:
            return
        if first is event.frame:
            self.looked += 1
            if not node.mode_confirmed:
                shown = node.known(MODE_DISPLAY)
                display = shown.value if shown is not None else "not read"
                what = f"bit 4 rises while 6061h is {display}"
                self.blame(what, asked.frame, frame_of(shown), event.frame, node_id=node_id)
        elif self.in_a_row(
            node_id, first.t_ns < asked.t_ns and event.frame.t_ns - asked.t_ns > self._LONGEST_NS and node.enabled
        ):
            what = "bit 4 was set before mode 6, and has no edge"
            self.blame(what, first, asked.frame, event.frame, node_id=node_id)


def _rises(event: ControlSeen) -> bool:
    """Whether bit 4 rises."""
    return bool(event.word & ~(event.before or 0) & 1 << HOMING_START_BIT)


HOMING_RULES: tuple[type[Rule], ...] = (HomesAgain, HomingStart)
