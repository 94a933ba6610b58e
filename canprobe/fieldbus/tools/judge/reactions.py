"""Rules on reactions: to emergencies, faults, boot-ups, and nodes that fall silent."""

from __future__ import annotations

from itertools import pairwise

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveCommand, DriveState, command_of
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import enables
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, SECOND_NS, Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_node import SeenNode
from canprobe.fieldbus.tools.judge.targets import Onward

_COMMUNICATION = (0x81, 0x82)
"""High bytes of codes on communication, after which a node may go on."""
_FAULTY = (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)
_DOWN = (DriveCommand.DISABLE_VOLTAGE, DriveCommand.QUICK_STOP, DriveCommand.SHUTDOWN, DriveCommand.DISABLE_OPERATION)
StopEvent = events.EmcySeen | events.StatusSeen | events.ControlSeen | events.NmtSeen
BootEvent = events.HeartbeatSeen | events.TargetSeen | events.ControlSeen | events.AnswerSeen
LossEvent = events.SyncSeen | events.HeartbeatSeen | events.TargetSeen | events.ControlSeen | events.StatusSeen
_SOON_NS = 100_000_000
"""Time after EMCY 0000h within which a stop is an answer to it."""
_PATIENCE_NS = 2_000_000_000
"""Time of an enabled axis after which every node must have been heard."""


@rule(15, answers=True)
def targets_after_fault(case: Case, node: SeenNode) -> Watch[events.EmcySeen | events.StatusSeen | events.TargetSeen]:
    """The targets of a faulty axis go on."""
    onward: Onward | None = None
    while event := (yield):
        if isinstance(event, events.TargetSeen):
            if onward is not None and onward.goes_on(event):
                late_ms = (event.frame.t_ns - onward.cause.t_ns) * 1e-6
                case.blame(node, f"{late_ms:.0f} ms after the fault the targets go on", onward.cause, event)
                onward = None
            continue
        if isinstance(event, events.EmcySeen):
            begins = event.code and event.code >> 8 not in _COMMUNICATION and node.is_drive
            ends = not event.code and node.state not in _FAULTY
        else:
            begins = node.state in _FAULTY
            ends = node.state in (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON)
        if begins and onward is None:
            case.looked += 1
            since_ns = event.frame.t_ns + 2 * case.bus.period_ns + QUEUED_NS
            onward = Onward(node, since_ns, case.bus.period_ns, event.frame)
        elif ends:
            onward = None


@rule(16, answers=True)
def reset_taken_for_error(case: Case) -> Watch[StopEvent]:
    """The end of an error is taken for an error."""
    resets: dict[SeenNode, BusFrame] = {}  # messages that healthy, enabled drives sent
    errors_ns: dict[SeenNode, int] = {}
    while event := (yield):
        stopped: tuple[SeenNode, ...] = ()
        if isinstance(event, events.EmcySeen):
            recent = event.frame.t_ns - errors_ns.get(event.node, -SECOND_NS) < SECOND_NS
            if event.code:
                errors_ns[event.node] = event.frame.t_ns
                resets.clear()
            elif event.node.enabled and not recent:
                case.looked += 1
                resets[event.node] = event.frame
        elif isinstance(event, events.StatusSeen):
            if not event.node.enabled:
                resets.pop(event.node, None)
        elif isinstance(event, events.ControlSeen):
            stopped = (event.node,) if command_of(event.word) in _DOWN and event.node.enabled else ()
        elif event.command is not NmtCommand.START:
            stopped = event.nodes
        for node in stopped:
            if node in resets and (waited_ns := event.frame.t_ns - resets[node].t_ns) < _SOON_NS:
                case.blame(node, f"a stop {waited_ns * 1e-6:.1f} ms after EMCY 0000h", resets.pop(node), event)


@rule(21, answers=True)
def boot_up_ignored(case: Case, node: SeenNode) -> Watch[BootEvent]:
    """A node boots by itself, and the master goes on as before."""
    onward: Onward | None = None  # targets after a boot-up that nobody asked for
    stale: BusFrame | None = None  # that boot-up, until the node is configured
    while event := (yield):
        if isinstance(event, events.HeartbeatSeen):
            if event.state is NmtState.INITIALISING and event.before is NmtState.OPERATIONAL:
                case.looked += 1
                onward = Onward(node, event.frame.t_ns + QUEUED_NS, case.bus.period_ns, event.frame)
                stale = event.frame if node.configured else stale
        elif isinstance(event, events.AnswerSeen):
            if event.writes:
                onward = stale = None
        elif isinstance(event, events.TargetSeen):
            if onward is not None and onward.goes_on(event):
                late_ms = (event.frame.t_ns - onward.cause.t_ns) * 1e-6
                case.blame(node, f"targets go on {late_ms:.0f} ms after a boot-up", onward.cause, event)
                onward = None
        elif stale is not None and node.operational and enables(event):
            case.blame(node, "enabled after a boot-up without being configured", stale, event)
            stale = None


class _Losses:
    """Nodes that are lost, and whether they are driven on, or other axes are."""

    def __init__(self, case: Case) -> None:
        self._case, self._bus = case, case.bus
        self._lost: dict[SeenNode, BusFrame] = {}
        self._onward: dict[SeenNode, Onward] = {}
        self._beat: dict[SeenNode, BusFrame] = {}
        self._report: dict[SeenNode, BusFrame] = {}
        self._still_ns: dict[SeenNode, int] = {}
        self._blamed: set[SeenNode] = set()

    def hear(self, event: LossEvent) -> None:
        """Take an event."""
        if isinstance(event, events.HeartbeatSeen):
            self._beat[event.node] = event.frame
            self._find(event.node)
        elif isinstance(event, events.StatusSeen):
            if event.frame.can_id in event.node.tpdos:
                self._report[event.node] = event.frame
                if not self._beats(event.node):
                    self._find(event.node)
        elif isinstance(event, events.SyncSeen) or (isinstance(event, events.TargetSeen) and not self._bus.syncs_ns):
            for node in self._bus.nodes.values():
                self._look(node)
        if isinstance(event, events.TargetSeen | events.ControlSeen) and event.node.enabled and self._lost:
            self._follow(event)

    def _find(self, node: SeenNode) -> None:
        """A lost node is back."""
        if self._lost.pop(node, None) is not None:
            self._onward.clear()
            self._still_ns.clear()
            self._blamed.clear()

    def _look(self, node: SeenNode) -> None:
        last = (self._beat if self._beats(node) else self._report).get(node)
        if last is None or node in self._lost or not node.operational:
            return
        limit_ns = self._limit_ns(node)
        if limit_ns and self._bus.now_ns - last.t_ns > limit_ns:
            self._lost[node] = last
            self._case.looked += self._concerned(node)

    def _concerned(self, lost: SeenNode) -> bool:
        """Whether there is an axis whose targets the rule follows when this node is lost."""
        return lost.is_drive or not self._is_silent(lost)

    def _follows(self, node: SeenNode, lost: SeenNode) -> bool:
        """Whether the rule follows the targets of a node while another, or itself, is lost."""
        return node is lost or not self._is_silent(lost)

    def _is_silent(self, node: SeenNode) -> bool:
        """Whether nothing else of a node comes, either."""
        return self._bus.now_ns - node.heard_ns > self._silence_ns()

    def _silence_ns(self) -> int:
        return max(50_000_000, 10 * self._bus.period_ns)

    def _beats(self, node: SeenNode) -> bool:
        """Whether heartbeats show that a node lives; else its synchronous statuswords do, which come with each SYNC."""
        return len(node.heartbeats_ns) >= 3 or not any(
            pdo.layout.transmission_type == 1 and pdo.maps(cia402.STATUSWORD) for pdo in node.tpdos.values()
        )

    def _limit_ns(self, node: SeenNode) -> int:
        """Age of the last sign of life at which a node is lost; 0 where it is not known."""
        if not self._beats(node):
            return self._silence_ns() + 2 * self._bus.period_ns
        times = list(node.heartbeats_ns)
        if len(times) < 3:
            return 0
        usual_ns = sorted(b - a for a, b in pairwise(times))[(len(times) - 1) // 2]
        consumed_ms = max((node.number(0x1016, sub) or 0) & 0xFFFF for sub in range(1, 9))
        return max(3 * usual_ns, consumed_ms * 1_000_000) + 2 * self._bus.period_ns

    def _follow(self, event: events.TargetSeen | events.ControlSeen) -> None:
        node = event.node
        lost = next((one for one in self._lost if self._follows(node, one)), None)
        if lost is None or node in self._blamed:
            return
        last = self._lost[lost]
        since_ns = last.t_ns + self._limit_ns(lost)
        if isinstance(event, events.TargetSeen):
            onward = self._onward.setdefault(node, Onward(node, since_ns, self._bus.period_ns, last))
            found = onward.goes_on(event)
            if event.value != event.before:
                self._still_ns[node] = event.frame.t_ns
            what = f"the targets of node {node.node_id} go on"
        else:  # an axis that nobody sees is not held by a target that stays: its power has to go
            enables_on = command_of(event.word, event.before or 0) is DriveCommand.ENABLE_OPERATION
            waited_ns = event.frame.t_ns - max(since_ns, self._still_ns.get(node, 0))
            found = node is lost and enables_on and waited_ns > SECOND_NS
            what = f"6040h = {event.word:04X}h still enables it"
        if found:
            sign = "sign" if self._is_silent(lost) else "heartbeat"
            age_ms = (event.frame.t_ns - last.t_ns) * 1e-6
            age = f"the last {sign} of node {lost.node_id} is {age_ms:.0f} ms old"
            self._case.blame(lost, f"{age}, and {what}", last, event)
            self._blamed.add(node)


class _MuteLosses(_Losses):
    """Axes that say nothing, and whether the others are driven on."""

    def _concerned(self, lost: SeenNode) -> bool:
        return self._is_silent(lost) and any(node.is_drive and node is not lost for node in self._bus.nodes.values())

    def _follows(self, node: SeenNode, lost: SeenNode) -> bool:
        return node not in self._lost and self._is_silent(lost)


@rule(19, answers=True)
def loss_ignored(case: Case) -> Watch[LossEvent]:
    """A node falls silent, and the master drives it on; or only its heartbeat is lost, and axes go on."""
    losses = _Losses(case)
    while event := (yield):
        losses.hear(event)


@rule(46, answers=True)
def mute_ignored(case: Case) -> Watch[LossEvent]:
    """One axis says nothing, and the others go on."""
    losses = _MuteLosses(case)
    while event := (yield):
        losses.hear(event)


@rule(20, answers=True)
def missing_from_start(case: Case) -> Watch[events.StatusSeen]:
    """A node has never been heard, or never answered, and others are enabled."""
    first: BusFrame | None = None  # that shows an enabled axis
    blamed: set[SeenNode] = set()
    while event := (yield):
        if not event.node.enabled:
            continue
        first = first or event.frame
        if event.frame.t_ns - first.t_ns < _PATIENCE_NS:
            continue
        for node in case.bus.nodes.values():
            case.looked += 1
            if node in blamed or (node.seen and (node.answers or not node.asked)):
                continue
            blamed.add(node)
            heard = "has never answered" if node.seen else "was never heard"
            case.blame(node, f"node {event.node.node_id} is enabled, and node {node.node_id} {heard}", first, event)
