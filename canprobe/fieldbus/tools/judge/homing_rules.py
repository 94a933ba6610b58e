"""Rules on homing: when it is started, and how."""

from __future__ import annotations

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import ControlSeen, HeartbeatSeen, StatusSeen
from canprobe.fieldbus.tools.judge.rule import Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_LONGEST_START_NS = 500_000_000


@rule(13)
def homes_again(case: Case, node: SeenNode) -> Watch[StatusSeen | ControlSeen | HeartbeatSeen]:
    """An axis is homed although it has its reference."""
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
            case.expect(node, referenced is None, what, referenced, event)


@rule(14)
def homing_start(case: Case, node: SeenNode) -> Watch[ControlSeen]:
    """Homing is started in another mode, or without an edge."""
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
            case.expect(node, node.mode_confirmed, what, asked, shown, event)
        elif case.in_a_row(
            node, first.t_ns < asked.t_ns and event.frame.t_ns - asked.t_ns > _LONGEST_START_NS and node.enabled
        ):
            case.blame(node, "bit 4 was set before mode 6, and has no edge", first, asked, event)
