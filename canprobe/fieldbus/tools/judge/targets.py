"""Rules on targets of axes in motion: steps, limits, modes, and how the motion ends."""

from __future__ import annotations

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveCommand, OperationMode, command_of
from canprobe.fieldbus.protocol.frames import NmtCommand
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.rule import Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_node import TARGET_OF_MODE, TARGETS, Known, SeenNode

_PLACES = (cia402.TARGET_POSITION, cia402.INTERPOLATION_DATA)
_POSITION_MODES = [mode for mode, target in TARGET_OF_MODE.items() if target in _PLACES]
_CREEP_SHARE = 0.2
"""Share of the speed of a moving axis below which targets stand, as those that follow a noisy position."""
_LOST_SHARE = 3.0
"""A step of so many limits is blamed at once; less may be the way of lost frames."""
_SILENCE_NS = 250_000_000
"""Time without an RPDO with targets after which the master is gone."""


class Onward:
    """Whether the targets of an axis go on undiminished after some time.

    The way of the targets is summed in windows that follow each other. An axis that is stopped has less way in each of
    them, and none in the end. The axis goes on where a window has as much as the one before. In modes of velocity and
    torque, where a target that stays is a motion, its amount takes the place of the way.

    Args:
        node: the node.
        since_ns: time from which on targets should not go on.
        period_ns: period of SYNC; a window has 20 of them, and at least 50 ms.
        cause: frame that shows why targets should not go on.
    """

    def __init__(self, node: SeenNode, since_ns: int, period_ns: int, cause: BusFrame) -> None:
        self.cause = cause
        self._begin_ns = since_ns
        self._window_ns = max(50_000_000, 20 * period_ns)
        self._least = _CREEP_SHARE * node.least_speed * self._window_ns * 1e-9
        self._before: float | None = None
        self._way = 0.0

    def goes_on(self, event: events.TargetSeen) -> bool:
        """Take a target; whether a window that is over has at least 90 % of the way of the one before."""
        found, cyclic = False, event.index in _PLACES
        while event.frame.t_ns >= self._begin_ns + self._window_ns:
            least = self._least if cyclic else 0.0
            before = self._before
            found = found or (before is not None and before > least and self._way >= 0.9 * before)
            # 0 for good: an axis that has stood for a window was stopped, and what comes later is another motion
            self._before, self._way = (0.0 if before == 0.0 else self._way), 0.0
            self._begin_ns += self._window_ns
        if event.frame.t_ns >= self._begin_ns and event.before is not None:
            self._way += abs(event.value - event.before) if cyclic else abs(event.value)
        return found


@rule(5)
def mode_while_moving(case: Case, node: SeenNode) -> Watch[events.ModeSeen]:
    """The mode is changed while the axis moves."""
    while event := (yield):
        if not node.enabled or event.mode in (event.before, 0):
            continue
        still, what = not node.moves(event.frame.t_ns), f"6060h = {event.mode} while the axis moves"
        case.expect(node, still, what, *motion_of(node), event)


@rule(38)
def step_too_large(case: Case, node: SeenNode) -> Watch[events.TargetSeen]:
    """Targets step or accelerate more than the drive may."""
    last: int | None = None
    while event := (yield):
        period_ns = case.bus.period_ns
        cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and event.index == cia402.TARGET_POSITION
        if not (cyclic and node.enabled and node.settled and period_ns and event.before is not None):
            last = None
            continue
        limit = node.step_limit(period_ns)
        step, took_ns = event.value - event.before, event.frame.t_ns - event.before_ns
        periods = max(1, round(took_ns / period_ns))
        if limit is not None:
            allowed = 1.05 * limit * periods + 2
            if case.in_a_row(node, abs(step) > allowed) or abs(step) > _LOST_SHARE * allowed:
                what = f"607Ah steps by {abs(step)} in {periods} periods; 607Fh allows {limit * periods:.0f}"
                case.blame(node, what, event)
        acceleration = node.value(0x60C5)
        if acceleration and not node.value(0x60AA) and periods == 1:
            change = 0 if last is None else abs(step - last)
            most = acceleration * (period_ns * 1e-9) ** 2
            if case.in_a_row(("acceleration", node), change > 1.05 * most + 3, 4):
                case.blame(node, f"steps of 607Ah change by {change} in a period; 60C5h allows {most:.0f}", event)
        last = step


@rule(39)
def outside_limits(case: Case, node: SeenNode) -> Watch[events.TargetSeen]:
    """Targets lie outside the software limits."""
    while event := (yield):
        limits = node.soft_limits()
        to_position = event.index == cia402.TARGET_POSITION and node.mode in _POSITION_MODES
        if not to_position or not node.enabled or not limits:
            continue
        low, high = limits
        if case.in_a_row(node, not low <= event.value <= high):
            case.blame(node, f"607Ah is {event.value}; 607Dh allows {low} to {high}", event)


@rule(40, answers=True)
def following_error_ignored(case: Case, node: SeenNode) -> Watch[events.StatusSeen | events.TargetSeen]:
    """The axis does not follow, and the targets go on."""
    onward: Onward | None = None
    while event := (yield):
        if isinstance(event, events.StatusSeen):
            late = bool(event.word >> cia402.FOLLOWING_ERROR_BIT & 1)
            lags = late and node.enabled and node.mode in _POSITION_MODES
            if case.in_a_row(node, lags, 4):
                onward = Onward(node, event.frame.t_ns, case.bus.period_ns, event.frame)
            elif not lags:
                onward = None
        elif onward is not None and onward.goes_on(event):
            what = "bit 13 of 6041h is set, and the targets go on"
            case.blame(node, what, onward.cause, node.known(cia402.POSITION), event)
            onward = None


@rule(17)
def ends_moving(case: Case, node: SeenNode) -> Watch[events.NmtSeen | events.RpdoSeen | events.StatusSeen]:
    """The master goes while an axis moves."""
    last: BusFrame | None = None  # RPDO with a target
    while event := (yield):
        if isinstance(event, events.NmtSeen):
            if event.command is NmtCommand.START:
                continue
            last = None
            if node.enabled:
                what = f"NMT {event.command.name.lower().replace('_', ' ')} while the axis moves"
                case.expect(node, not _unstopped(case, node), what, *motion_of(node), event)
        elif isinstance(event, events.RpdoSeen):
            last = event.frame if event.pdo.maps(*TARGETS) else last
        elif last is not None:
            silent_ns = event.frame.t_ns - last.t_ns
            if silent_ns > max(_SILENCE_NS, 20 * case.bus.period_ns):
                left_moving = node.enabled and _unstopped(case, node)
                what = f"the axis moves, and the last RPDO came {silent_ns * 1e-6:.0f} ms ago"
                case.expect(node, not left_moving, what, last, *motion_of(node))
                last = None


def _unstopped(case: Case, node: SeenNode) -> bool:
    word = node.number(cia402.CONTROLWORD)
    halted = word is not None and word >> cia402.HALT_BIT & 1
    return node.moves(case.bus.now_ns) and not halted


@rule(47)
def power_off_moving(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """The voltage is taken away while the axis moves."""
    while event := (yield):
        command = command_of(event.word, event.before or 0)
        ramps = command is DriveCommand.SHUTDOWN and node.value(0x605B) == 1
        if command not in (DriveCommand.DISABLE_VOLTAGE, DriveCommand.SHUTDOWN) or ramps or not node.enabled:
            continue
        if event.before is None or command_of(event.before) is not DriveCommand.ENABLE_OPERATION:
            continue
        still, what = not node.moves(event.frame.t_ns), f"6040h = {event.word:04X}h while the axis moves"
        case.expect(node, still, what, *motion_of(node), event)


def motion_of(node: SeenNode) -> tuple[Known | None, ...]:
    """What showed the last motion of a node."""
    return node.known(cia402.STATUSWORD), node.known(cia402.POSITION)
