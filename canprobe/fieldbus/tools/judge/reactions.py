"""Rules on reactions: to emergencies, faults, boot-ups, and nodes that fall silent."""

from __future__ import annotations

from itertools import pairwise

from canprobe.fieldbus.protocol.cia402 import DriveCommand, DriveState, command_of
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import enables
from canprobe.fieldbus.tools.judge.events import (
    AnswerSeen,
    BusEvent,
    ControlSeen,
    EmcySeen,
    HeartbeatSeen,
    NmtSeen,
    StatusSeen,
    SyncSeen,
    TargetSeen,
)
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, Rule, Severity
from canprobe.fieldbus.tools.judge.seen_node import STATUSWORD, SeenNode
from canprobe.fieldbus.tools.judge.targets import Onward

_COMMUNICATION = (0x81, 0x82)
"""High bytes of codes on communication, after which a node may go on."""
_FAULTY = (DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT)
_SECOND_NS = 1_000_000_000


class TargetsAfterFault(Rule):
    """The targets of a faulty axis go on."""

    number, name, group, severity = 15, "targets after a fault", "reactions", Severity.UNSAFE
    source = "ros2_canopen PR 360"
    expected = "from two cycles after an emergency of the device or bit 3 of 6041h on, the axis gets no new targets"
    hint = "hold the target at 6064h, and disable the axis"
    hears = (EmcySeen, StatusSeen, TargetSeen)
    answers = True

    def begin(self) -> None:
        """Remember nothing yet."""
        self._onward: dict[int, Onward] = {}

    def see(self, event: BusEvent) -> None:
        """Follow the targets of an axis after its fault."""
        assert isinstance(event, EmcySeen | StatusSeen | TargetSeen)
        node, node_id = event.node, event.node.node_id
        if isinstance(event, EmcySeen):
            if event.code and event.code >> 8 not in _COMMUNICATION and node.is_drive:
                self._fault(node, event.frame)
            elif not event.code and node.state not in _FAULTY:
                self._onward.pop(node_id, None)
        elif isinstance(event, StatusSeen):
            if node.state in _FAULTY:
                self._fault(node, event.frame)
            elif node.state in (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON):
                self._onward.pop(node_id, None)
        elif (onward := self._onward.get(node_id)) is not None and onward.goes_on(event):
            what = f"{(event.frame.t_ns - onward.cause.t_ns) * 1e-6:.0f} ms after the fault the targets go on"
            self.blame(what, onward.cause, event.frame, node_id=node_id)
            del self._onward[node_id]

    def _fault(self, node: SeenNode, frame: BusFrame) -> None:
        if node.node_id not in self._onward:
            self.looked += 1
            since_ns = frame.t_ns + 2 * self.bus.period_ns + QUEUED_NS
            self._onward[node.node_id] = Onward(node, since_ns, self.bus.period_ns, frame)


class ResetTakenForError(Rule):
    """The end of an error is taken for an error."""

    number, name, group, severity = 16, "EMCY 0000h taken for an error", "reactions", Severity.MINOR
    source = "ros_canopen#396"
    expected = "EMCY 0000h, error reset, stops nothing"
    hint = "test the code for 0 first"
    hears = (EmcySeen, StatusSeen, ControlSeen, NmtSeen)
    answers = True
    _SOON_NS = 100_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._reset: dict[int, BusFrame] = {}
        self._errors: dict[int, int] = {}

    def see(self, event: BusEvent) -> None:
        """Look for a stop soon after a message that a healthy, enabled drive sent."""
        if isinstance(event, EmcySeen):
            node_id = event.node.node_id
            recent = event.frame.t_ns - self._errors.get(node_id, -_SECOND_NS) < _SECOND_NS
            if event.code:
                self._errors[node_id] = event.frame.t_ns
                self._reset.clear()
            elif event.node.enabled and not recent:
                self.looked += 1
                self._reset[node_id] = event.frame
        elif isinstance(event, StatusSeen):
            if not event.node.enabled:
                self._reset.pop(event.node.node_id, None)
        elif isinstance(event, ControlSeen):
            down = command_of(event.word) in (DriveCommand.DISABLE_VOLTAGE, DriveCommand.QUICK_STOP)
            down = down or command_of(event.word) in (DriveCommand.SHUTDOWN, DriveCommand.DISABLE_OPERATION)
            self._judge(event.node.node_id, event.frame, down and event.node.enabled)
        elif isinstance(event, NmtSeen):
            for node in event.nodes:
                self._judge(node.node_id, event.frame, event.command is not NmtCommand.START)

    def _judge(self, node_id: int, frame: BusFrame, stops: bool) -> None:
        reset = self._reset.get(node_id)
        if reset is not None and stops and frame.t_ns - reset.t_ns < self._SOON_NS:
            del self._reset[node_id]
            what = f"a stop {(frame.t_ns - reset.t_ns) * 1e-6:.1f} ms after EMCY 0000h"
            self.blame(what, reset, frame, node_id=node_id)


class BootUpIgnored(Rule):
    """A node boots by itself, and the master goes on as before."""

    number, name, group, severity = 21, "boot-up ignored", "reactions", Severity.UNSAFE
    source = "ros_canopen#337; linuxcnc-ethercat PR 523"
    expected = "a node that boots gets no targets, and is configured before it is enabled again"
    hint = "watch for boot-ups; bring the node up from the beginning"
    hears = (HeartbeatSeen, TargetSeen, ControlSeen, AnswerSeen)
    answers = True

    def begin(self) -> None:
        """Remember nothing yet."""
        self._onward: dict[int, Onward] = {}
        self._stale: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Follow the targets after a boot-up that nobody asked for, and look at the next enabling."""
        assert isinstance(event, HeartbeatSeen | TargetSeen | ControlSeen | AnswerSeen)
        node_id = event.node.node_id
        if isinstance(event, HeartbeatSeen):
            unasked = event.before is NmtState.OPERATIONAL
            if event.state is NmtState.INITIALISING and unasked:
                self.looked += 1
                self._onward[node_id] = Onward(
                    event.node, event.frame.t_ns + QUEUED_NS, self.bus.period_ns, event.frame
                )
                if event.node.configured:
                    self._stale[node_id] = event.frame
        elif isinstance(event, AnswerSeen):
            if event.writes:
                self._stale.pop(node_id, None)
                self._onward.pop(node_id, None)
        elif isinstance(event, TargetSeen):
            onward = self._onward.get(node_id)
            if onward is not None and onward.goes_on(event):
                what = f"targets go on {(event.frame.t_ns - onward.cause.t_ns) * 1e-6:.0f} ms after a boot-up"
                self.blame(what, onward.cause, event.frame, node_id=node_id)
                del self._onward[node_id]
        elif node_id in self._stale and event.node.operational and enables(event):
            self.blame("enabled after a boot-up without being configured", self._stale.pop(node_id), event.frame,
                       node_id=node_id)  # fmt: skip


class LossIgnored(Rule):
    """A node falls silent, and the master drives it on; or only its heartbeat is lost, and axes go on."""

    number, name, group, severity = 19, "heartbeat lost, no reaction", "reactions", Severity.UNSAFE
    source = "canopen#543; CiA 301, 1016h"
    expected = (
        "within the consumer time (1016h, or three times 1017h) and two cycles after the last heartbeat, a stop; a lost"
        " axis is not kept enabled"
    )
    hint = "consume the heartbeat of each node, and stop all axes when it is missing"
    hears = (SyncSeen, HeartbeatSeen, TargetSeen, ControlSeen, StatusSeen)
    answers = True

    def begin(self) -> None:
        """Remember nothing yet."""
        self._lost: dict[int, BusFrame] = {}
        self._onward: dict[int, Onward] = {}
        self._beat: dict[int, BusFrame] = {}
        self._report: dict[int, BusFrame] = {}
        self._still_ns: dict[int, int] = {}
        self._blamed: set[int] = set()

    def see(self, event: BusEvent) -> None:
        """Find nodes whose sign of life is overdue, and follow the targets from then on."""
        if isinstance(event, HeartbeatSeen):
            self._beat[event.node.node_id] = event.frame
            self._find(event.node)
        elif isinstance(event, StatusSeen):
            if event.frame.can_id in event.node.tpdos:
                self._report[event.node.node_id] = event.frame
                if not self._beats(event.node):
                    self._find(event.node)
        elif isinstance(event, SyncSeen) or (isinstance(event, TargetSeen) and not self.bus.syncs_ns):
            for node in self.bus.nodes.values():
                self._look(node)
        if isinstance(event, TargetSeen | ControlSeen) and event.node.enabled and self._lost:
            self._follow(event)

    def _find(self, node: SeenNode) -> None:
        """A lost node is back."""
        if self._lost.pop(node.node_id, None) is not None:
            self._onward.clear()
            self._still_ns.clear()
            self._blamed.clear()

    def _look(self, node: SeenNode) -> None:
        last = (self._beat if self._beats(node) else self._report).get(node.node_id)
        if last is None or node.node_id in self._lost or not node.operational:
            return
        limit_ns = self._limit_ns(node)
        if limit_ns and self.bus.now_ns - last.t_ns > limit_ns:
            self._lost[node.node_id] = last
            self.looked += self._concerned(node)

    def _concerned(self, lost: SeenNode) -> bool:
        """Whether there is an axis whose targets the rule follows when this node is lost."""
        return lost.is_drive or not self._is_silent(lost)

    def _follows(self, node: SeenNode, lost: SeenNode) -> bool:
        """Whether the rule follows the targets of a node while another, or itself, is lost."""
        return node is lost or not self._is_silent(lost)

    def _is_silent(self, node: SeenNode) -> bool:
        """Whether nothing else of a node comes, either."""
        return self.bus.now_ns - node.heard_ns > self._silence_ns()

    def _silence_ns(self) -> int:
        return max(50_000_000, 10 * self.bus.period_ns)

    def _beats(self, node: SeenNode) -> bool:
        """Whether heartbeats show that a node lives; else its synchronous statuswords do, which come with each SYNC."""
        return len(node.heartbeats_ns) >= 3 or not any(
            pdo.layout.transmission_type == 1 and pdo.maps(STATUSWORD) for pdo in node.tpdos.values()
        )

    def _limit_ns(self, node: SeenNode) -> int:
        """Age of the last sign of life at which a node is lost; 0 where it is not known."""
        if not self._beats(node):
            return self._silence_ns() + 2 * self.bus.period_ns
        times = list(node.heartbeats_ns)
        if len(times) < 3:
            return 0
        usual_ns = sorted(b - a for a, b in pairwise(times))[(len(times) - 1) // 2]
        consumers = [node.number(0x1016, sub) or 0 for sub in range(1, 9)]
        consumed_ms = max(word & 0xFFFF for word in consumers)
        return max(3 * usual_ns, consumed_ms * 1_000_000) + 2 * self.bus.period_ns

    def _follow(self, event: TargetSeen | ControlSeen) -> None:
        node, node_id, nodes = event.node, event.node.node_id, self.bus.nodes
        lost_id = next((one for one in self._lost if self._follows(node, nodes[one])), None)
        if lost_id is None or node_id in self._blamed:
            return
        last = self._lost[lost_id]
        since_ns = last.t_ns + self._limit_ns(nodes[lost_id])
        if isinstance(event, TargetSeen):
            onward = self._onward.setdefault(node_id, Onward(node, since_ns, self.bus.period_ns, last))
            found = onward.goes_on(event)
            if event.value != event.before:
                self._still_ns[node_id] = event.frame.t_ns
            what = f"the targets of node {node_id} go on"
        else:  # an axis that nobody sees is not held by a target that stays: its power has to go
            enables_on = command_of(event.word, event.before or 0) is DriveCommand.ENABLE_OPERATION
            waited_ns = event.frame.t_ns - max(since_ns, self._still_ns.get(node_id, 0))
            found = node_id == lost_id and enables_on and waited_ns > _SECOND_NS
            what = f"6040h = {event.word:04X}h still enables it"
        if found:
            sign = "sign" if self._is_silent(nodes[lost_id]) else "heartbeat"
            age_ms = (event.frame.t_ns - last.t_ns) * 1e-6
            self.blame(f"the last {sign} of node {lost_id} is {age_ms:.0f} ms old, and {what}", last, event.frame,
                       node_id=lost_id)  # fmt: skip
            self._blamed.add(node_id)


class MuteIgnored(LossIgnored):
    """One axis says nothing, and the others go on."""

    number, name, group, severity = 46, "mute axis ignored", "reactions", Severity.UNSAFE
    source = "openarm_can"
    expected = "when one axis falls silent the others stop, too"
    hint = "watch the TPDOs and heartbeats of each axis, and stop all"

    def _concerned(self, lost: SeenNode) -> bool:
        return self._is_silent(lost) and any(node.is_drive and node is not lost for node in self.bus.nodes.values())

    def _follows(self, node: SeenNode, lost: SeenNode) -> bool:
        return node.node_id not in self._lost and self._is_silent(lost)


class MissingFromStart(Rule):
    """A node has never been heard, or never answered, and others are enabled."""

    number, name, group, severity = 20, "enabled without all nodes", "reactions", Severity.WRONG
    expected = "no axis is enabled before all nodes have been heard, and have answered"
    hint = "wait for each node, and stop where one does not answer"
    hears = (StatusSeen,)
    answers = True
    _PATIENCE_NS = 2_000_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._since: BusFrame | None = None
        self._blamed: set[int] = set()

    def see(self, event: BusEvent) -> None:
        """Look for nodes that were never heard while another has been enabled for two seconds."""
        assert isinstance(event, StatusSeen)
        if not event.node.enabled:
            return
        self._since = self._since or event.frame
        if event.frame.t_ns - self._since.t_ns < self._PATIENCE_NS:
            return
        for node in self.bus.nodes.values():
            self.looked += 1
            silent = not node.seen or (node.asked and not node.answers)
            if silent and node.node_id not in self._blamed:
                self._blamed.add(node.node_id)
                heard = "has never answered" if node.seen else "was never heard"
                what = f"node {event.node.node_id} is enabled, and node {node.node_id} {heard}"
                self.blame(what, self._since, event.frame, node_id=node.node_id)


REACTION_RULES: tuple[type[Rule], ...] = (
    TargetsAfterFault,
    ResetTakenForError,
    LossIgnored,
    MissingFromStart,
    BootUpIgnored,
    MuteIgnored,
)
