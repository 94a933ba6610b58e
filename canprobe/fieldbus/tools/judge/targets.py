"""Rules on targets of axes in motion: steps, limits, modes, and how the motion ends."""

from __future__ import annotations

from canprobe.fieldbus.protocol.cia402 import FOLLOWING_ERROR_BIT, HALT_BIT, DriveCommand, OperationMode, command_of
from canprobe.fieldbus.protocol.frames import NmtCommand
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import frame_of
from canprobe.fieldbus.tools.judge.events import (
    BusEvent,
    ControlSeen,
    ModeSeen,
    NmtSeen,
    RpdoSeen,
    StatusSeen,
    TargetSeen,
)
from canprobe.fieldbus.tools.judge.rule import Rule, Severity
from canprobe.fieldbus.tools.judge.seen_node import (
    CONTROLWORD,
    INTERPOLATION_DATA,
    POSITION,
    STATUSWORD,
    TARGET_POSITION,
    TARGETS,
    SeenNode,
)

_POSITION_MODES = (
    OperationMode.PROFILE_POSITION,
    OperationMode.INTERPOLATED_POSITION,
    OperationMode.CYCLIC_SYNC_POSITION,
)
_CREEP_SHARE = 0.2
"""Share of the speed of a moving axis below which targets stand, as those that follow a noisy position."""
_LOST_SHARE = 3.0
"""A step of so many limits is blamed at once; less may be the way of lost frames."""


class ModeWhileMoving(Rule):
    """The mode is changed while the axis moves."""

    number, name, group, severity = 5, "mode changed while moving", "targets", Severity.UNSAFE
    source = "ipa_canopen PR 29"
    expected = "6060h is written while the axis stands"
    hint = "stop the axis, and write 6060h after that"
    hears = (ModeSeen,)

    def see(self, event: BusEvent) -> None:
        """Look at the motion when the mode changes."""
        assert isinstance(event, ModeSeen)
        node = event.node
        if not node.enabled or event.mode in (event.before, 0):
            return
        self.looked += 1
        if node.moves(event.frame.t_ns):
            what = f"6060h = {event.mode} while the axis moves"
            self.blame(what, *motion_of(node), event.frame, node_id=node.node_id)


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

    def goes_on(self, event: TargetSeen) -> bool:
        """Take a target; whether a window that is over has at least 90 % of the way of the one before."""
        found, cyclic = False, event.index in (TARGET_POSITION, INTERPOLATION_DATA)
        while event.frame.t_ns >= self._begin_ns + self._window_ns:
            least = self._least if cyclic else 0.0
            before = self._before
            found = found or (before is not None and before > least and self._way >= 0.9 * before)
            self._before, self._way = (0.0 if before == 0.0 else self._way), 0.0
            self._begin_ns += self._window_ns
        if event.frame.t_ns >= self._begin_ns and event.before is not None:
            self._way += abs(event.value - event.before) if cyclic else abs(event.value)
        return found


class StepTooLarge(Rule):
    """Targets step or accelerate more than the drive may."""

    number, name, group, severity = 38, "steps of targets", "targets", Severity.UNSAFE
    source = "eRob_SOEM_linux#9"
    expected = "in CSP, steps of 607Ah of at most 607Fh times the period, and changes of them of at most 60C5h"
    hint = "interpolate between the points of the path, and limit speed and acceleration"
    hears = (TargetSeen,)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._steps: dict[int, tuple[int, float]] = {}

    def see(self, event: BusEvent) -> None:
        """Judge the step, over the periods that it took, and its change."""
        assert isinstance(event, TargetSeen)
        node, period_ns = event.node, self.bus.period_ns
        cyclic = node.mode == OperationMode.CYCLIC_SYNC_POSITION and event.index == TARGET_POSITION
        if not (cyclic and node.enabled and node.settled and period_ns and event.before is not None):
            self._steps.pop(node.node_id, None)
            return
        limit = node.step_limit(period_ns)
        step, took_ns = event.value - event.before, event.frame.t_ns - event.before_ns
        periods = max(1, round(took_ns / period_ns))
        if limit is not None:
            allowed = 1.05 * limit * periods + 2
            bad = abs(step) > allowed
            if self.in_a_row(node.node_id, bad) or abs(step) > _LOST_SHARE * allowed:
                what = f"607Ah steps by {abs(step)} in {periods} periods; 607Fh allows {limit * periods:.0f}"
                self.blame(what, event.frame, node_id=node.node_id)
        acceleration = node.value(0x60C5)
        if acceleration and not node.value(0x60AA) and periods == 1:
            before = self._steps.get(node.node_id, (step, 0.0))[0]
            most = acceleration * (period_ns * 1e-9) ** 2
            if self.in_a_row(("acceleration", node.node_id), abs(step - before) > 1.05 * most + 3, 4):
                what = f"steps of 607Ah change by {abs(step - before)} in a period; 60C5h allows {most:.0f}"
                self.blame(what, event.frame, node_id=node.node_id)
        self._steps[node.node_id] = (step, 0.0)


class OutsideLimits(Rule):
    """Targets lie outside the software limits."""

    number, name, group, severity = 39, "targets outside limits", "targets", Severity.WRONG
    source = "ros2_canopen, motor.cpp"
    expected = "607Ah within 607Dh, as the drive stops at its limits and sets bit 11"
    hint = "read 607Dh and keep the targets inside"
    hears = (TargetSeen,)

    def see(self, event: BusEvent) -> None:
        """Compare the target with the limits."""
        assert isinstance(event, TargetSeen)
        node = event.node
        limits = node.soft_limits()
        if event.index != TARGET_POSITION or not node.enabled or node.mode not in _POSITION_MODES or limits is None:
            return
        low, high = limits
        if self.in_a_row(node.node_id, not low <= event.value <= high):
            what = f"607Ah is {event.value}; 607Dh allows {low} to {high}"
            self.blame(what, event.frame, node_id=node.node_id)


class FollowingErrorIgnored(Rule):
    """The axis does not follow, and the targets go on."""

    number, name, group, severity = 40, "following error ignored", "targets", Severity.WRONG
    source = "CiA 402-2, 6041h bit 13"
    expected = "targets stop when bit 13 of 6041h is set for more than three cycles"
    hint = "hold the target, or stop the axis, when bit 13 is set"
    hears = (StatusSeen, TargetSeen)
    answers = True

    def begin(self) -> None:
        """Remember nothing yet."""
        self._onward: dict[int, Onward] = {}

    def see(self, event: BusEvent) -> None:
        """Follow the targets after the fourth statusword with bit 13."""
        assert isinstance(event, StatusSeen | TargetSeen)
        node, node_id = event.node, event.node.node_id
        if isinstance(event, StatusSeen):
            lags = bool(event.word >> FOLLOWING_ERROR_BIT & 1) and node.enabled and node.mode in _POSITION_MODES
            if self.in_a_row(node_id, lags, 4):
                self._onward[node_id] = Onward(node, event.frame.t_ns, self.bus.period_ns, event.frame)
            elif not lags:
                self._onward.pop(node_id, None)
            return
        onward = self._onward.get(node_id)
        if onward is not None and onward.goes_on(event):
            what = "bit 13 of 6041h is set, and the targets go on"
            self.blame(what, onward.cause, frame_of(node.known(POSITION)), event.frame, node_id=node_id)
            del self._onward[node_id]


class EndsMoving(Rule):
    """The master goes while an axis moves."""

    number, name, group, severity = 17, "ends while moving", "targets", Severity.UNSAFE
    source = "ros2_canopen#288"
    expected = "a moving axis is stopped (0002h, or halt) before RPDOs end or NMT takes the node out of operational"
    hint = "stop the axis on every way out"
    hears = (NmtSeen, RpdoSeen, StatusSeen)
    _SILENCE_NS = 250_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._last: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Look at the motion when NMT stops a node, and when RPDOs have ended."""
        if isinstance(event, NmtSeen):
            for node in event.nodes if event.command is not NmtCommand.START else ():
                self._last.pop(node.node_id, None)
                if node.enabled:
                    self.looked += 1
                    if self._unstopped(node):
                        what = f"NMT {event.command.name.lower().replace('_', ' ')} while the axis moves"
                        self.blame(what, *motion_of(node), event.frame, node_id=node.node_id)
        elif isinstance(event, RpdoSeen):
            if event.pdo.maps(*TARGETS):
                self._last[event.node.node_id] = event.frame
        elif isinstance(event, StatusSeen):
            node = event.node
            last = self._last.get(node.node_id)
            if last is None:
                return
            silent_ns = event.frame.t_ns - last.t_ns
            if silent_ns > max(self._SILENCE_NS, 20 * self.bus.period_ns):
                del self._last[node.node_id]
                self.looked += 1
                if node.enabled and self._unstopped(node):
                    what = f"the axis moves, and the last RPDO came {silent_ns * 1e-6:.0f} ms ago"
                    self.blame(what, last, *motion_of(node), node_id=node.node_id)

    def _unstopped(self, node: SeenNode) -> bool:
        word = node.number(CONTROLWORD)
        halted = word is not None and word >> HALT_BIT & 1
        return node.moves(self.bus.now_ns) and not halted


class PowerOffMoving(Rule):
    """The voltage is taken away while the axis moves."""

    number, name, group, severity = 47, "power off while moving", "targets", Severity.UNSAFE
    source = "openarm_can"
    expected = "a moving axis is stopped (0002h, or halt) before 0000h or 0006h"
    hint = "send 0002h and wait until the axis stands"
    hears = (ControlSeen,)

    def see(self, event: BusEvent) -> None:
        """Look at the motion when the voltage goes."""
        assert isinstance(event, ControlSeen)
        node = event.node
        command = command_of(event.word, event.before or 0)
        ramps = command is DriveCommand.SHUTDOWN and node.value(0x605B) == 1
        if command not in (DriveCommand.DISABLE_VOLTAGE, DriveCommand.SHUTDOWN) or ramps or not node.enabled:
            return
        if event.before is None or command_of(event.before) is not DriveCommand.ENABLE_OPERATION:
            return
        self.looked += 1
        if node.moves(event.frame.t_ns):
            what = f"6040h = {event.word:04X}h while the axis moves"
            self.blame(what, *motion_of(node), event.frame, node_id=node.node_id)


def motion_of(node: SeenNode) -> tuple[BusFrame | None, ...]:
    """Frames that show the last motion of a node."""
    return frame_of(node.known(STATUSWORD)), frame_of(node.known(POSITION))


TARGET_RULES: tuple[type[Rule], ...] = (
    ModeWhileMoving,
    EndsMoving,
    PowerOffMoving,
    StepTooLarge,
    OutsideLimits,
    FollowingErrorIgnored,
)
