"""A node whose faults happen: it stands between the node and a bus, and is attached in the node's place.

Faults may be added and taken away at any time. One holds from the next frame or deadline of the node on. Without a
fault the node behaves as itself.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Sequence
from heapq import heappop

from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.cia402 import DriveState, state_of
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, SYNC_ID, Frame, NmtState
from canprobe.fieldbus.tools.faults.fault import FOREVER_NS, Effect, Fault, FaultSpan, Host

EVENTS = ("boot-up", "operational", "enabled", "sync")
"""Events of a node at which a fault may begin: its next boot-up, NMT start, operation enabled, or SYNC."""


class FaultyNode(Participant):
    """One node and its faults.

    Args:
        node: the node.
        faults: faults; those of other nodes are left out.

    Attributes:
        host: the node as its faults see it, with what they hold back.
        now_ns: time of the last frame or deadline.
        spans: when its faults held, in the order of their beginnings.
    """

    def __init__(self, node: SlaveNode, faults: Iterable[Fault] = ()) -> None:
        self.node, self.host = node, Host(node)
        self.now_ns = 0
        self.spans: list[FaultSpan] = []
        self._pending: list[Fault] = []
        self._effects: list[Effect] = []
        self._acts: list[Callable[[SlaveNode], object]] = []
        self._busy = False
        self._before: frozenset[str] = frozenset()
        for fault in faults:
            if fault.node_id == node.node_id:
                self.add(fault)

    @property
    def node_id(self) -> int:
        """Node id of the node."""
        return self.node.node_id

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def listens(self) -> Container[int]:
        return self.node.listens

    @property
    def kind(self) -> type:
        return self.node.kind

    @property
    def patient(self) -> frozenset[int]:
        return self.node.patient

    def connect(self, rerouted: Callable[[], None]) -> None:
        self.node.connect(rerouted)

    def add(self, fault: Fault) -> None:
        """Add a fault; it happens from its start or event on, or from now on."""
        self._pending.append(fault)
        self._busy = True
        if fault.event:
            self._before = self.states

    def remove(self, fault: Fault) -> None:
        """End a fault at the next frame or deadline of the node; nothing happens where it is over."""
        self._pending = [one for one in self._pending if one is not fault]
        for effect in self._effects:
            if effect.fault is fault:
                effect.end_ns = min(effect.end_ns, self.now_ns)

    def act(self, act: Callable[[SlaveNode], object]) -> None:
        """Let the device do something by itself when the bus asks it next; its frames go through the faults."""
        self._acts.append(act)
        self._busy = True

    @property
    def faults(self) -> list[Fault]:
        """Faults that hold, and those that are to come."""
        return [*self.holding, *self._pending]

    @property
    def holding(self) -> list[Fault]:
        """Faults that hold."""
        return [effect.fault for effect in self._effects]

    @property
    def next_deadline_ns(self) -> int | None:
        """The next deadline of the node, while its time goes on, and of the faults."""
        own = self.node.next_deadline_ns
        if not self._busy:
            return own
        due = [self.host.late[0][0]] if self.host.late else []
        due += [fault.start_ns for fault in self._pending if not fault.event]
        due += [effect.end_ns for effect in self._effects]
        due += [self.now_ns] if self._acts else []
        due += [effect.due_ns for effect in self._effects if effect.due_ns is not None]
        if own is not None:
            due.append(max([own, *(effect.end_ns for effect in self._effects if effect.dark)]))
        first = min(due, default=FOREVER_NS)
        return first if first < FOREVER_NS else None

    def start(self, t_ns: int) -> Sequence[Frame]:
        self.now_ns = t_ns
        return self._finished(self.node.start(t_ns), t_ns)

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        self.now_ns = t_ns
        if not self._busy:
            return self.node.receive(can_id, data, t_ns)
        ready = self._turn(t_ns)
        if self._is_dark():
            self.host.hits += 1
            return ready
        out: list[Frame] = []
        for frame in self._through([(can_id, data)], t_ns, incoming=True):
            out += self.node.receive(*frame, t_ns)
        return [*ready, *self._finished(out, t_ns, synchronised=can_id == SYNC_ID)]

    def advance(self, t_ns: int) -> Sequence[Frame]:
        self.now_ns = t_ns
        if not self._busy:
            return self.node.advance(t_ns)
        ready = self._turn(t_ns)
        answers: list[Frame] = []
        while self.host.late and self.host.late[0][0] <= t_ns:
            _, _, incoming, frame = heappop(self.host.late)
            if not incoming:
                ready.append(frame)
            elif not self._is_dark():
                answers += self.node.receive(*frame, t_ns)
        own = self.node.next_deadline_ns
        if own is not None and own <= t_ns and not self._is_dark():
            answers += self.node.advance(t_ns)
        acts, self._acts = self._acts, []
        for act in acts:
            answers += self.node.act(t_ns, act)
        made = [f for e in self._effects if e.due_ns is not None and e.due_ns <= t_ns for f in e.advance(t_ns)]
        self.host.said = made + self.host.said
        out = [*ready, *self._finished(answers, t_ns)]
        held = self.host.late or any(self.host.swapped.values())
        self._busy = bool(self._pending or self._effects or held or self._acts)
        return out

    def _is_dark(self) -> bool:
        return any(effect.dark for effect in self._effects)

    def _turn(self, t_ns: int) -> list[Frame]:
        """Begin and end the faults whose time has come."""
        out: list[Frame] = []
        for fault in [one for one in self._pending if not one.event and one.start_ns <= t_ns]:
            self._pending.remove(fault)
            out += self._begin(fault, t_ns)
        for effect in [one for one in self._effects if one.end_ns <= t_ns or one.left <= 0]:
            self._effects.remove(effect)
            effect.span.end_ns = t_ns
            out += effect.end(t_ns) or ()
        return [] if self._is_dark() else out

    def _begin(self, fault: Fault, t_ns: int) -> Sequence[Frame]:
        effect = fault.kind(fault, self.host)
        effect.span.begin_ns, effect.end_ns = t_ns, t_ns + fault.duration_ns
        self.spans.append(effect.span)
        self._effects.append(effect)
        frames = effect.begin(t_ns)
        self.host.hits += frames is not None
        return frames or ()

    def _finished(self, frames: Sequence[Frame], t_ns: int, *, synchronised: bool = False) -> list[Frame]:
        """What the bus gets of the node's frames, and of those said in its name."""
        sent = self._sent(frames, t_ns)
        said, self.host.said = self.host.said, []
        out = [*sent, *said, *(frame for effect in self._effects for frame in effect.watch(t_ns))]
        if any(fault.event for fault in self._pending):
            booted = any(can_id == HEARTBEAT_BASE + self.node_id and data == b"\0" for can_id, data in frames)
            now = self.states
            new = (now - self._before) | ({"boot-up"} if booted else set()) | ({"sync"} if synchronised else set())
            self._before = now
            for fault in [one for one in self._pending if one.event in new]:
                self._pending.remove(fault)
                out += self._begin(fault, t_ns)
        return out

    @property
    def is_drive(self) -> bool:
        """Whether it can be enabled."""
        return self.node.dictionary.has_index(0x6041)

    @property
    def states(self) -> frozenset[str]:
        """States of the node that are events when it comes into them."""
        enabled = state_of(self.node.dictionary.number(0x6041)) is DriveState.OPERATION_ENABLED
        operational = self.node.state is NmtState.OPERATIONAL
        return frozenset(name for name, holds in (("enabled", enabled), ("operational", operational)) if holds)

    def _sent(self, frames: Sequence[Frame], t_ns: int) -> Sequence[Frame]:
        """Those of the node's frames that reach the bus now."""
        if not frames:
            return frames
        if self._is_dark():
            self.host.hits += len(frames)
            return ()
        batch = list(frames)
        for effect in self._effects:
            batch = effect.batch(batch, t_ns)
        return self._through(batch, t_ns, incoming=False)

    def _through(self, frames: list[Frame], t_ns: int, *, incoming: bool) -> list[Frame]:
        for effect in self._effects:
            if effect.fault.hears is incoming and effect.left > 0:
                frames = [out for frame in frames for out in self._hit(effect, frame, t_ns)]
        if frames:
            frames, self.host.swapped[incoming] = [*frames, *self.host.swapped[incoming]], []
        return frames

    def _hit(self, effect: Effect, frame: Frame, t_ns: int) -> Sequence[Frame]:
        if effect.rng.random() >= effect.fault.share or effect.left <= 0:
            return (frame,)
        out = effect.frame(frame, t_ns)
        if out is None:
            return (frame,)
        self.host.hits += 1
        effect.left -= 1
        return out
