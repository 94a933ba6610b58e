"""Serves emulated nodes on a real bus, in real time, for any master, and keeps what they store in files."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Container, Iterator, Sequence
from heapq import merge
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

from canprobe.bus.disk import write_text
from canprobe.bus.port import Port, TimedFrame
from canprobe.bus.scheduling import garbage_collection_paused
from canprobe.emulator.node.dictionary import Abort, SdoAbort, Value
from canprobe.emulator.node.slave_node import SlaveNode
from canprobe.errors import BusError, CanprobeError, UsageError
from canprobe.protocol.frames import SYNC_ID, UNCONFIGURED, Frame

# Serves emulated nodes on a real bus, in real time, for any master.

MAX_WAIT_NS = 100_000_000
SINGLE_WAIT_NS = 2_000_000
"""Longest wait of a port that waits and receives in one call: how late a deadline may be served on an idle bus."""
_EVERYTHING = range(1 << 32)
_MOST_FRAMES = 20_000  # in one exchange; above it the nodes are taken to answer each other for ever


class Participant(Protocol):
    """A node that is a function of frames and time."""

    @property
    def next_deadline_ns(self) -> int | None:
        """When `advance` has something to do."""

    def start(self, t_ns: int) -> list[Frame]:
        """Power on."""

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """A frame from the bus."""

    def advance(self, t_ns: int) -> list[Frame]:
        """Do what is due."""


class _Seat:
    """A node at the exchange, with the frames it has yet to send."""

    __slots__ = ("ears", "node", "queue")

    def __init__(self, node: Participant) -> None:
        self.node = node
        self.queue: deque[Frame] = deque()
        self.ears: Container[int] = getattr(node, "listens", _EVERYTHING)

    def hear(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Give the node a frame; keep its answers."""
        if answers := self.node.receive(can_id, data, t_ns):
            self.queue.extend(answers)


_Said = tuple[int, _Seat, Frame]
"""A frame that a seat sends, behind its identifier."""
_IDENTIFIER = itemgetter(0)


class _Audiences(dict[int, tuple[_Seat, ...]]):
    """Who listens to an identifier: found once, until a node changes its mind."""

    def __init__(self, seats: Sequence[_Seat]) -> None:
        super().__init__()
        self._seats = seats

    def __missing__(self, can_id: int) -> tuple[_Seat, ...]:
        found = self[can_id] = tuple(seat for seat in self._seats if can_id in seat.ears)
        return found


class Exchange:
    """The nodes of one process behind one bus: each hears the bus and the other nodes, none itself.

    Frames leave lowest identifier first, each node's own in their order. A SYNC goes to one kind of device after the
    other, in the order of `nodes`, and what one kind answers leaves before the next kind starts to work: the drives'
    quick feedback does not wait for the sensor's image.
    """

    def __init__(self, nodes: Sequence[Participant]) -> None:
        self._seats = tuple(_Seat(node) for node in nodes)
        self._kinds = tuple(tuple(seats) for _, seats in groupby(self._seats, key=_kind))
        self._witnesses = tuple(seat for seat in self._seats if getattr(seat.node, "witness", False))
        self._audiences = _Audiences(self._seats)
        self.skipped = 0
        """SYNCs that were left unanswered because the next one had come already."""
        self.rerouted = True
        """Set when a node has changed what it listens to; whoever acts on that clears it."""
        for node in nodes:
            if hasattr(node, "rerouted"):
                node.rerouted = self._reroute

    def _reroute(self) -> None:
        self._audiences.clear()
        self.rerouted = True

    @property
    def patient(self) -> frozenset[int]:
        """Identifiers that can wait for the next SYNC, whoever listens to them."""
        by_seat: list[tuple[_Seat, frozenset[int]]] = [
            (seat, getattr(seat.node, "patient", frozenset())) for seat in self._seats
        ]
        wanted = {can_id for _, ids in by_seat for can_id in ids}
        return frozenset(i for i in wanted if all(i in ids or i not in seat.ears for seat, ids in by_seat))

    @property
    def next_deadline_ns(self) -> int | None:
        """The earliest deadline of all nodes."""
        return min((due for seat in self._seats if (due := seat.node.next_deadline_ns) is not None), default=None)

    def start(self, t_ns: int) -> list[Frame]:
        """Power on all nodes; returns what goes on the bus."""
        for seat in self._seats:
            seat.queue.extend(seat.node.start(t_ns))
        return self._settle(t_ns)

    def step(self, frames: Sequence[TimedFrame], t_ns: int) -> list[Frame]:
        """Feed what came from the bus, then do what is due by `t_ns`; returns what goes on the bus.

        Args:
            frames: (can_id, data, time of reception in ns), in order.
            t_ns: now; receptions in the future count as now.
        """
        return [frame for batch in self.batches(frames, t_ns) for frame in batch]

    def batches(self, frames: Sequence[TimedFrame], t_ns: int) -> Iterator[list[Frame]]:
        """As `step`, but each batch is computed only when the one before it has been sent.

        Of several SYNCs only the last is answered: nodes that are behind miss SYNCs, as busy devices do, instead of
        answering old ones ever later. Witnesses hear them all.
        """
        syncs = [can_id for can_id, _, _ in frames].count(SYNC_ID)
        for can_id, data, received_ns in frames:
            heard_ns = min(received_ns, t_ns)
            if can_id == SYNC_ID:
                syncs -= 1
                if syncs:
                    self.skipped += 1
                    for seat in self._witnesses:
                        seat.hear(SYNC_ID, data, heard_ns)
                    continue
                yield from self._synchronise(data, heard_ns)
                continue
            for seat in self._audiences[can_id]:
                seat.hear(can_id, data, heard_ns)
        for seat in self._seats:
            due = seat.node.next_deadline_ns
            if due is not None and due <= t_ns:
                seat.queue.extend(seat.node.advance(t_ns))
        if rest := self._settle(t_ns):
            yield rest

    def _synchronise(self, data: bytes, t_ns: int) -> Iterator[list[Frame]]:
        """Pass a SYNC on. The nodes hear each other's answers to it only once they have all heard the SYNC itself."""
        if before := self._settle(t_ns):
            yield before
        spoken: list[_Said] = []
        for kind in self._kinds:
            answers = [(seat, seat.node.receive(SYNC_ID, data, t_ns)) for seat in kind if SYNC_ID in seat.ears]
            if said := _in_order(answers):
                spoken += said
                yield [frame for _, _, frame in said]
        for can_id, sender, frame in spoken:
            if self._audiences[can_id]:
                self._overhear(sender, frame, t_ns)

    def _settle(self, t_ns: int) -> list[Frame]:
        """Empty the queues, lowest identifier first, each in its own order; let the other nodes hear every frame."""
        sent: list[Frame] = []
        while (sender := _next_of(self._seats)) is not None:
            frame = sender.queue.popleft()
            sent.append(frame)
            if len(sent) > _MOST_FRAMES:
                raise BusError(f"the emulated nodes answer each other without an end, last {frame[0]:03X}")
            self._overhear(sender, frame, t_ns)
        return sent

    def _overhear(self, sender: _Seat, frame: Frame, t_ns: int) -> None:
        for seat in self._audiences[frame[0]]:
            if seat is not sender:
                seat.hear(*frame, t_ns)


def _head(seat: _Seat) -> int:
    return seat.queue[0][0]


def _next_of(seats: Sequence[_Seat]) -> _Seat | None:
    """Who has the frame of the lowest identifier, if anybody has one."""
    talking = [seat for seat in seats if seat.queue]
    return min(talking, key=_head) if talking else None


def _in_order(answers: Sequence[tuple[_Seat, Sequence[Frame]]]) -> list[_Said]:
    """What the seats answer, lowest identifier first, each seat's in its own order."""
    said = [(frame[0], seat, frame) for seat, frames in answers for frame in frames]
    talking = [seat for seat, frames in answers if frames]
    if len(said) == len(talking):  # one frame each, as after nearly every SYNC
        return sorted(said, key=_IDENTIFIER)
    return list(merge(*[[one for one in said if one[1] is seat] for seat in talking], key=_IDENTIFIER))


def _kind(seat: _Seat) -> type:
    return type(getattr(seat.node, "application", seat.node))


def _receiver(port: Port, exchange: Exchange, max_wait_ns: int) -> Callable[[int], list[TimedFrame]]:
    """How to wait for frames until a deadline: by the port's own single call where it has one, in steps of 2 ms."""
    if (at_once := getattr(port, "receive", None)) is not None:
        return lambda now_ns: at_once(SINGLE_WAIT_NS)

    def receive(now_ns: int) -> list[TimedFrame]:
        due_ns, until_ns = exchange.next_deadline_ns, now_ns + max_wait_ns
        port.wait(until_ns if due_ns is None else min(due_ns, until_ns))
        return port.drain()

    return receive


def serve(nodes: Sequence[Participant], port: Port, stop: Callable[[], bool], max_wait_ns: int = MAX_WAIT_NS) -> None:
    """Power on the nodes and serve them until `stop()`; it is asked after every wait.

    Args:
        nodes: participants, for example `SlaveNode`s.
        port: of the bus; its clock is the nodes' clock.
        stop: ends the loop when it returns True.
        max_wait_ns: longest wait, so that `stop` is asked often enough.
    """
    exchange, clock = Exchange(nodes), port.clock
    with garbage_collection_paused():
        now_ns = clock.now_ns()
        if boot_ups := exchange.start(now_ns):
            port.send_batch(boot_ups)
        receive, defer = _receiver(port, exchange, max_wait_ns), getattr(port, "defer", None)
        deferred: frozenset[int] = frozenset()
        while not stop():
            if exchange.rerouted and defer is not None:
                # Being woken for each RPDO, in the middle of its sender's burst, costs both sides more than all else.
                exchange.rerouted = False
                if (patient := exchange.patient) != deferred:
                    defer(deferred := patient)
            received = receive(now_ns)
            # The last arrival is the time to work at: one reading of the clock less before the answers leave.
            now_ns = max(now_ns, received[-1][2]) if received else clock.now_ns()
            for frames in exchange.batches(received, now_ns):
                port.send_batch(frames)


# A node's stored parameters (1010h, 1011h, LSS) in a JSON file, so that they survive a restart of the process.

_SCHEMA = 1


def keep_in_file(node: SlaveNode, path: Path) -> None:
    """Take over what the file holds, if there is one; from now on write it at every "save" and "load" and when
    LSS stores a node id.

    Call it before the node is started. A write that fails aborts the SDO with 06060000h, or LSS with error 2.

    Args:
        node: the node, not yet started.
        path: of the file; its folder is made.

    Raises:
        UsageError: the file cannot be read, or is another device's.
    """
    if path.exists():
        _read(node, path)

    def write() -> None:
        try:
            _write(node, path)
        except (OSError, CanprobeError) as error:
            raise SdoAbort(Abort.HARDWARE) from error

    node.store.changed = write


def _identity(node: SlaveNode) -> list[int]:
    return [node.dictionary.number(0x1018, subindex) for subindex in (1, 2, 3)]


def _write(node: SlaveNode, path: Path) -> None:
    content = {
        "schema": _SCHEMA,
        "identity": _identity(node),
        "device": node.store.kept.hex(),
        **({} if node.store.node_id is None else {"node_id": node.store.node_id}),
        "values": {
            f"{key >> 8:04X}:{key & 0xFF:02X}": _plain(value) for key, value in sorted(node.store.saved.items())
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1))


def _plain(value: Value) -> Any:
    return {"hex": value.hex()} if isinstance(value, bytes) else value


def _read(node: SlaveNode, path: Path) -> None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        identity, texts, device = content["identity"], content["values"], bytes.fromhex(content["device"])
        values = {_key(text): _value(plain) for text, plain in texts.items()}
        node_id = _node_id(content.get("node_id"))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(f"{path}: no stored parameters of a node can be read from it: {error!r}") from error
    if identity != _identity(node):
        raise UsageError(f"{path}: stored by the device {identity}, {node.name} is {_identity(node)} (1018h:01 to 03)")
    for key, value in values.items():
        _check(node, path, key, value)
    node.store.saved, node.store.kept, node.store.node_id = values, device, node_id


def _node_id(value: Any) -> int | None:
    if value is None or value == UNCONFIGURED or (type(value) is int and 1 <= value <= 127):
        return value  # type: ignore[no-any-return]
    raise ValueError(f"expected a node id from 1 to 127, or 255, got {value!r}")


def _key(text: str) -> int:
    index, subindex = text.split(":")
    return int(index, 16) << 8 | int(subindex, 16)


def _value(plain: Any) -> Value:
    if isinstance(plain, dict):
        return bytes.fromhex(plain["hex"])
    if isinstance(plain, bool) or not isinstance(plain, (int, float)):
        raise TypeError(f"expected a number or hex, got {plain!r}")
    return plain


def _check(node: SlaveNode, path: Path, key: int, value: Value) -> None:
    """What the file puts into the dictionary must be a value of that entry: the cyclic code packs it unchecked."""
    where = f"{path}: {key >> 8:04X}h:{key & 0xFF:02X}"
    entry = node.dictionary.entries.get(key)
    if entry is None:
        raise UsageError(f"{where}: the EDS of {node.name} has no such object")
    try:
        entry.from_bytes(entry.to_bytes(value))
        entry.check_limits(value)
        fits = isinstance(value, bytes) is not bool(entry.bits) and (bool(entry.real) or not isinstance(value, float))
    except (SdoAbort, OverflowError, ValueError) as error:
        raise UsageError(f"{where}: {value!r} is no value of it: {error}") from error
    if not fits:
        raise UsageError(f"{where}: {value!r} is no value of it: another data type")
