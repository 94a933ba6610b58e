"""A CAN bus inside one process and one thread, in virtual time: deterministic, and as fast as the processor.

Each participant and each port has one outgoing queue. At one instant the bus first serves everybody whose deadline has
come, then carries the frames one by one. Of the heads of all queues it takes the one that wins the arbitration: the
lowest identifier first, each sender's frames in their order, ties by order of attachment. No participant receives what
it sent. Answers join at the same instant, until nothing is left to send. A frame takes no time on the wire.

A deadline that a reception moves to the present is served after the frames that already wait.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container, Sequence
from heapq import heapify, heappop, heappush

from canprobe.errors import BusError, InterfaceError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import ControllerState, PlainPort, PortCounters, TimedFrame
from canprobe.fieldbus.protocol.frame_bits import FD_LENGTHS
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, EFF_FLAG, EFF_MASK, RTR_FLAG, Frame

Recorder = Callable[[int, bytes, int], None]
"""Called with (can_id, data, t_ns)."""


ALL_IDS = range(1 << 32)


class Participant:
    """A device on an emulated bus, as a function of frames and time. The base class hears all and sends nothing.

    The bus sends what `start`, `receive` and `advance` return, in that order.

    Attributes:
        hears_every_sync: whether it also gets a SYNC that a served bus leaves unanswered because the next one has come.
    """

    hears_every_sync = False

    @property
    def name(self) -> str:
        """Name of the participant in messages."""
        return type(self).__name__

    @property
    def kind(self) -> type:
        """Kind of device; on a served bus those of one kind answer a SYNC before those of the next kind hear it."""
        return type(self)

    @property
    def next_deadline_ns(self) -> int | None:
        """Time of the next call of `advance`; `None` if only a frame can wake it."""
        return None

    @property
    def listens(self) -> Container[int]:
        """Identifiers that it takes at present; the bus gives it no others."""
        return ALL_IDS

    @property
    def patient(self) -> frozenset[int]:
        """Those of them that require nothing before the next SYNC."""
        return frozenset()

    def connect(self, rerouted: Callable[[], None]) -> None:
        """Take the function to call whenever `listens` or `patient` has changed; called before `start`."""

    def start(self, t_ns: int) -> Sequence[Frame]:
        """Power on at `t_ns`."""
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        """Take a frame from the bus."""
        return ()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Do what is due at `t_ns`; afterwards the next deadline lies later."""
        return ()


Listener = tuple[Callable[[int, bytes, int], Sequence[Frame]], "Attachment"]


class Attachment:
    """One sender as the bus sees it: its queue, and the receivers of its frames."""

    __slots__ = ("due", "listeners", "order", "outbox", "owner")

    def __init__(self, owner: Participant, order: int) -> None:
        self.owner = owner
        self.order = order
        self.outbox: deque[Frame] = deque()
        self.due: int | None = None  # the owner's deadline, as last seen
        self.listeners: dict[int, tuple[Listener, ...]] = {}  # by identifier, found once until a participant reroutes


class LockstepBus:
    """The bus. It drives its clock: every wait on the clock runs the participants up to then.

    Args:
        clock: virtual clock, which other buses may share.
        channel: name of the bus in messages and logs.
        max_frames: most frames at one instant; more mean that the participants answer each other without an end.
        fd: whether frames of up to 64 bytes are carried too.
    """

    def __init__(
        self, clock: VirtualClock, channel: str = "can0", *, max_frames: int = 20_000, fd: bool = False
    ) -> None:
        self.fd = fd
        self.clock = clock
        self.channel = channel
        self.recorder: Recorder | None = None
        self.error_recorder: Recorder | None = None  # called with each error frame, where bits can fail
        self._max_frames = max_frames
        self._count = 0
        self._nodes: list[Attachment] = []
        self._heads: list[tuple[int, int, Attachment]] = []
        self._settling = False
        clock.attach(self)

    def attach(self, participant: Participant) -> None:
        """Put `participant` on the bus and start it; its frames are carried when time moves or a port is used."""
        node = self._add(participant)
        participant.connect(self._forget_listeners)
        self._queue(node, participant.start(self.clock.now_ns()))
        node.due = participant.next_deadline_ns

    def detach(self, participant: Participant) -> None:
        """Take `participant` off the bus; frames that it had queued are lost."""
        self._nodes = [node for node in self._nodes if node.owner is not participant]
        self._heads = [head for head in self._heads if head[2].owner is not participant]
        heapify(self._heads)
        self._forget_listeners()

    def port(self) -> LockstepPort:
        """Return a new port of a master; several see each other's frames."""
        port = LockstepPort(self)
        port.node = self._add(port)
        return port

    def next_deadline_ns(self) -> int | None:
        """Return the earliest deadline of all participants; the present if frames are waiting."""
        if self._heads:
            return self.clock.now_ns()
        first: int | None = None
        for node in self._nodes:
            due = node.due = node.owner.next_deadline_ns
            if due is not None and (first is None or due < first):
                first = due
        return first

    def settle(self) -> None:
        """Carry everything due at the present instant.

        Raises:
            BusError: the participants answer each other without an end.
        """
        if self._settling:
            return
        self._settling = True
        t_ns = self.clock.now_ns()
        limit = rounds_left = self._max_frames
        try:
            while self._advance_due(t_ns) or self._heads:
                limit = self._deliver(t_ns, limit)
                rounds_left -= 1
                if rounds_left < 0:
                    raise self._endless(t_ns, "deadlines that never move on, of " + self._names_due(t_ns))
        finally:
            self._settling = False

    def run_until_ns(self, until_ns: int) -> None:
        """Carry everything due up to and including `until_ns`.

        Raises:
            BusError: the participants answer each other without an end.
        """
        while (due := self.next_deadline_ns()) is not None and due <= until_ns:
            self.clock.move_ns(due)
            self.settle()

    def send(self, node: Attachment, frames: Sequence[Frame]) -> None:
        """Queue the frames of a port and carry everything due."""
        self._queue(node, frames)
        self.settle()

    def remove_port(self, port: LockstepPort) -> None:
        """Take a closed port off the bus."""
        self.detach(port)

    def _advance_due(self, t_ns: int) -> bool:
        advanced = False
        for node in self._nodes:
            if node.due is not None and node.due <= t_ns:
                advanced = True
                self._queue(node, node.owner.advance(t_ns))
                node.due = node.owner.next_deadline_ns
        return advanced

    def _deliver(self, t_ns: int, limit: int) -> int:
        """Carry frames until all queues are empty; return how many more may follow at this instant."""
        recorder = self.recorder
        while self._heads:
            sender, (can_id, data) = self._take_next()
            limit -= 1
            if limit < 0:
                what = f"{can_id:03X} from {sender.owner.name} is frame {self._max_frames + 1} of this instant"
                raise self._endless(t_ns, what)
            if recorder is not None:
                recorder(can_id, data, t_ns)
            self._hand_over(sender, can_id, data, t_ns)
        return limit

    def _take_next(self) -> tuple[Attachment, Frame]:
        """Take the frame that wins the arbitration out of its queue."""
        _, _, sender = heappop(self._heads)
        outbox = sender.outbox
        frame = outbox.popleft()
        if outbox:
            heappush(self._heads, (arbitration_key(outbox[0][0]), sender.order, sender))
        return sender, frame

    def _hand_over(self, sender: Attachment, can_id: int, data: bytes, t_ns: int) -> None:
        """Give a frame to everybody but its sender; queue the answers."""
        for receive, receiver in self._listeners_of(sender, can_id):
            answers = receive(can_id, data, t_ns)
            receiver.due = receiver.owner.next_deadline_ns
            if answers:
                self._queue(receiver, answers)

    def _queue(self, node: Attachment, frames: Sequence[Frame]) -> None:
        if not frames:
            return
        for frame in frames:
            self._check(node, frame)
        if not node.outbox:
            heappush(self._heads, (arbitration_key(frames[0][0]), node.order, node))
        node.outbox.extend(frames)

    def _check(self, node: Attachment, frame: Frame) -> None:
        can_id, data = frame
        if len(data) > CLASSIC_BYTES and not (self.fd and len(data) in FD_LENGTHS):
            has = f"CAN FD has {', '.join(map(str, FD_LENGTHS[9:]))} above 8" if self.fd else "CAN has 8"
            raise BusError(f"{self.channel}: {node.owner.name} sends {len(data)} bytes with {can_id:03X}; {has}")

    def _listeners_of(self, sender: Attachment, can_id: int) -> tuple[Listener, ...]:
        listeners = sender.listeners.get(can_id)
        if listeners is None:
            listeners = sender.listeners[can_id] = tuple(
                (node.owner.receive, node)
                for node in self._nodes
                if node is not sender and can_id in node.owner.listens
            )
        return listeners

    def _add(self, owner: Participant) -> Attachment:
        if any(node.owner is owner for node in self._nodes):
            raise BusError(f"{self.channel}: {owner.name} is on the bus already")
        node = Attachment(owner, self._count)
        self._count += 1
        self._nodes.append(node)
        self._forget_listeners()
        return node

    def _forget_listeners(self) -> None:
        for node in self._nodes:
            node.listeners.clear()

    def _names_due(self, t_ns: int) -> str:
        return ", ".join(node.owner.name for node in self._nodes if node.due is not None and node.due <= t_ns)

    def _endless(self, t_ns: int, what: str) -> BusError:
        self._heads.clear()
        for node in self._nodes:
            node.outbox.clear()
        return BusError(f"{self.channel}: no end at {t_ns * 1e-9:.6f} s: {what}")


class LockstepPort(Participant, PlainPort):
    """A master's `Port` on a `LockstepBus`, whose module gives the order of frames.

    Attributes:
        state: error state of the controller; a timed bus with bit errors sets it (`controllers`).
    """

    node: Attachment
    next_deadline_ns = None

    def __init__(self, bus: LockstepBus) -> None:
        self._bus = bus
        self._open = True
        self.clock, self.channel = bus.clock, bus.channel
        self.inbox: list[TimedFrame] = []
        self.counters = PortCounters()
        self.state = ControllerState.ACTIVE

    stamps_arrival = True

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        self.inbox.append((can_id, data, t_ns))
        return ()

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` now and let everybody answer; the answers are there when this returns."""
        self._check_open()
        self.counters.sent += len(frames)
        self._bus.send(self.node, frames)

    def drain(self) -> list[TimedFrame]:
        """Return the frames received so far and forget them."""
        self._check_open()
        self._bus.settle()
        frames = self.inbox.copy()
        self.inbox.clear()
        self.counters.received += len(frames)
        return frames

    def wait(self, until_ns: int) -> None:
        """Move virtual time on until a frame is here, or to `until_ns` with everything due by then done."""
        self._check_open()
        clock, inbox = self.clock, self.inbox
        until_ns = max(until_ns, clock.now_ns())
        while not inbox and clock.step(until_ns):
            pass

    def close(self) -> None:
        """Leave the bus."""
        if self._open:
            self._open = False
            self._bus.remove_port(self)

    def _check_open(self) -> None:
        if not self._open:
            raise InterfaceError(f"{self.channel}: this port is closed")


def arbitration_key(can_id: int) -> int:
    """Return the identifier's bits in the order of arbitration: the lowest value wins (ISO 11898-1)."""
    if can_id <= 0x7FF:
        return can_id << 21
    remote = 1 if can_id & RTR_FLAG else 0
    if can_id & EFF_FLAG:
        can_id &= EFF_MASK
        # 0b11: SRR and IDE are recessive, so a base frame with the same eleven bits wins, even a remote request
        return (can_id >> 18) << 21 | 0b11 << 19 | (can_id & 0x3FFFF) << 1 | remote
    return (can_id & 0x7FF) << 21 | remote << 20
