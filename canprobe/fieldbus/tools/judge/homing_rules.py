"""Rules on homing: when it is started, and how."""

from __future__ import annotations

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import ControlSeen, HeartbeatSeen, StatusSeen
from canprobe.fieldbus.tools.judge.rule import Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import SeenNode


class HomesAgain(Rule):
    """An axis is homed although it has its reference."""

    number, name, group, severity = 13, "homed again", "homing", Severity.WRONG
    source = "ros2_canopen PR 200"
    expected = "an axis with its reference (6041h bit 12 in homing) is not homed again before it boots or loses it"
    hint = "read 6041h in mode 6 before homing is started"

    def watch(self, node: SeenNode) -> Watch[StatusSeen | ControlSeen | HeartbeatSeen]:
        referenced: BusFrame | None = None
        while event := (yield):
            if isinstance(event, HeartbeatSeen):
                referenced = None if event.state is NmtState.INITIALISING else referenced
            elif node.number(cia402.MODE_DISPLAY) != OperationMode.HOMING:
                continue
            elif isinstance(event, StatusSeen):
                done, failed = event.word >> cia402.HOMING_ATTAINED_BIT & 1, event.word >> cia402.HOMING_ERROR_BIT & 1
                referenced = (referenced or event.frame) if done and not failed else None
            elif event.word & ~(event.before or 0) & 1 << cia402.HOMING_START_BIT and node.enabled:
                what = "homing is started on an axis that has its reference"
                self.expect(node, referenced is None, what, referenced, event)


class HomingStart(Rule):
    """Homing is started in another mode, or without an edge."""

    number, name, group, severity = 14, "homing start", "homing", Severity.WRONG
    source = "ethercat_driver_ros2#141"
    expected = "6061h = 6 seen, and then a rising edge of bit 4"
    hint = "write 6060h = 6, read 6061h, send 000Fh, and 001Fh after that"
    _LONGEST_NS = 500_000_000

    def watch(self, node: SeenNode) -> Watch[ControlSeen]:
        first: BusFrame | None = None  # with bit 4
        while event := (yield):
            if not event.word >> cia402.HOMING_START_BIT & 1:
                first = None
                continue
            first, asked = first or event.frame, node.known(cia402.MODE)
            if asked is None or asked.value != OperationMode.HOMING:
                continue
            if first is event.frame:
                shown = node.known(cia402.MODE_DISPLAY)
                what = f"bit 4 rises while 6061h is {shown.value if shown is not None else 'not read'}"
                self.expect(node, node.mode_confirmed, what, asked, shown, event)
            elif self.in_a_row(
                node, first.t_ns < asked.t_ns and event.frame.t_ns - asked.t_ns > self._LONGEST_NS and node.enabled
            ):
                self.blame(node, "bit 4 was set before mode 6, and has no edge", first, asked, event)
