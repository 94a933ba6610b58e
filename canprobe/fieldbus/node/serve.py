"""Serves emulated nodes on real buses, in real time, for any master, and keeps what they store in files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.joined import wait_for_any
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.virtual.lockstep import Attachment, LockstepBus, Participant
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame

_MAX_WAIT_NS = 100_000_000
_DOWN_NS = 20_000_000
"""Time between two looks at an interface that is down."""


class Exchange(LockstepBus):
    """The nodes of one process behind one bus: a lockstep bus whose time is that of the real one.

    A SYNC goes to one kind of device after the other, in the order of `nodes`, and the answers of one kind leave before
    the next kind starts to work: the drives' quick feedback does not wait for the sensor's image.

    Attributes:
        skipped: number of SYNCs that were left unanswered because the next one had come already.
        rerouted: whether a node has changed what it listens to; whoever acts on that clears it.
    """

    def __init__(self, nodes: Sequence[Participant]) -> None:
        super().__init__(VirtualClock(), "served nodes", fd=True)
        self._served = nodes
        self._outside = self._add(_Outside())
        self._sent: list[Frame] = []
        self.recorder = lambda can_id, data, _t_ns: self._sent.append((can_id, data))
        self.skipped = 0
        self._heard_ns = 0
        self.rerouted = True

    def _forget_listeners(self) -> None:
        super()._forget_listeners()
        self.rerouted = True

    @property
    def patient(self) -> frozenset[int]:
        """Identifiers that can wait for the next SYNC, for every node that listens to them."""
        wanted = {can_id for node in self._served for can_id in node.patient}
        return frozenset(i for i in wanted if all(i in node.patient or i not in node.listens for node in self._served))

    def start(self, t_ns: int) -> list[Frame]:
        """Power on all nodes; return the frames for the bus."""
        self.clock.move_ns(t_ns)
        for node in self._served:
            self.attach(node)
        return self._carry(t_ns)

    def batches(self, frames: Sequence[TimedFrame], t_ns: int) -> Iterator[list[Frame]]:
        """Feed frames from the bus, then do what is due by `t_ns`; yield the frames for the bus.

        Each batch is computed only when the one before it has been sent. Of several SYNCs only the last is answered:
        nodes that are late miss SYNCs, as busy devices do, instead of answering old ones later and later.

        Args:
            frames: received frames, each (can_id, data, time of reception in ns), in order.
            t_ns: present time; a reception after it counts as now, and none counts as earlier than the one before it.
        """
        self.clock.move_ns(t_ns)
        syncs = [can_id for can_id, _, _ in frames].count(SYNC_ID)
        for can_id, data, received_ns in frames:
            heard_ns = self._heard_ns = max(self._heard_ns, min(received_ns, t_ns))
            if can_id != SYNC_ID:
                self._hand_over(self._outside, can_id, data, heard_ns)
                continue
            syncs -= 1
            if not syncs:
                yield from self._synchronise(data, heard_ns)
                continue
            self.skipped += 1
            for node in self._served:
                if node.hears_every_sync:
                    node.receive(SYNC_ID, data, heard_ns)
        for one in self._nodes:
            one.due = one.owner.next_deadline_ns
        self._advance_due(t_ns)
        if rest := self._carry(t_ns):
            yield rest

    def _synchronise(self, data: bytes, t_ns: int) -> Iterator[list[Frame]]:
        """Pass a SYNC on. The nodes hear each other's answers only after all of them have heard the SYNC."""
        if before := self._carry(t_ns):
            yield before
        spoken: list[tuple[Attachment, Frame]] = []
        listeners = self._listeners_of(self._outside, SYNC_ID)
        for _, kind in groupby(listeners, key=lambda listener: listener[1].owner.kind):
            for receive, node in kind:
                self._queue(node, receive(SYNC_ID, data, t_ns))
            said = []
            while self._heads:
                said.append(self._take_next())
            if said:
                spoken += said
                yield [frame for _, frame in said]
        for sender, frame in spoken:
            self._hand_over(sender, *frame, t_ns)

    def _carry(self, t_ns: int) -> list[Frame]:
        """Let the nodes hear what is queued and what they answer each other; return it for the bus."""
        self._deliver(t_ns, self._max_frames)
        sent, self._sent = self._sent, []
        return sent


class _Outside(Participant):
    """Stands for all devices on the real bus, whose frames the nodes hear; frames of the nodes leave by the port."""

    listens = ()


class _Served:
    """The nodes of one bus behind its port."""

    def __init__(self, nodes: Sequence[Participant], port: Port, now_ns: int) -> None:
        self.port = port
        self.exchange = Exchange(nodes)
        self._deferred: frozenset[int] = frozenset()
        if boot_ups := self.exchange.start(now_ns):
            port.send_batch(boot_ups)

    def get_ready(self) -> int | None:
        """Prepare a wait: the port wakes for what the nodes listen to now. Returns when a node is due; None: never."""
        if self.exchange.rerouted:
            # A wake-up for each RPDO, in the middle of its sender's burst, costs both sides more than all else.
            self.exchange.rerouted = False
            if (patient := self.exchange.patient) != self._deferred:
                self._deferred = patient
                self.port.defer(patient)
        return self.exchange.next_deadline_ns()

    def step(self, received: list[TimedFrame], now_ns: int) -> None:
        """Let the nodes answer what came, and do what is due."""
        for frames in self.exchange.batches(received, now_ns):
            self.port.send_batch(frames)


def serve(
    buses: Sequence[tuple[Sequence[Participant], Port]], stop: Callable[[], bool], *, outlasts: bool = False
) -> None:
    """Power on the nodes and serve them until `stop()` is true.

    Nodes hear what is on their own bus. All of them may share one plant: they work one after the other. A process that
    only serves does better with `garbage_collection_paused` round it.

    Args:
        buses: participants, for example `SlaveNode`s, and port of each bus; the participants live on the ports' clock.
        stop: function that ends the loop by True; it is called after every wait, which lasts 100 ms at most.
        outlasts: whether the nodes outlast an interface that is down for a while, as devices with power do.

    Raises:
        InterfaceError: an interface is down or lost, unless the nodes outlast it.
    """
    clock = buses[0][1].clock
    now_ns = clock.now_ns()
    served = [_Served(nodes, port, now_ns) for nodes, port in buses]
    while not stop():
        try:
            now_ns = _turn(served, now_ns)
        except InterfaceError:
            if not outlasts:
                raise
            clock.sleep_until_ns(clock.now_ns() + _DOWN_NS)


def _turn(served: Sequence[_Served], now_ns: int) -> int:
    """Wait for frames or until a node is due, and let the nodes answer; the present time."""
    ports = [one.port for one in served]
    until_ns = min([now_ns + _MAX_WAIT_NS, *(due for one in served if (due := one.get_ready()) is not None)])
    if len(ports) == 1:
        received = [ports[0].wait_and_drain(until_ns)]
    else:
        wait_for_any(ports, until_ns)
        received = [port.drain() for port in ports]
    # The last arrival serves as present time, which saves a reading of the clock before the answers leave.
    arrivals_ns = [frames[-1][2] for frames in received if frames]
    now_ns = max(now_ns, *arrivals_ns) if arrivals_ns else ports[0].clock.now_ns()
    for one, frames in zip(served, received, strict=True):
        one.step(frames, now_ns)
    return now_ns
