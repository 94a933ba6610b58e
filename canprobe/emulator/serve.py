"""Serves emulated nodes on a real bus, in real time, for any master."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from canprobe.bus.port import Port
from canprobe.errors import BusError
from canprobe.protocol.frames import Frame

MAX_WAIT_NS = 100_000_000
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


class Exchange:
    """The nodes of one process behind one bus: each hears the bus and the other nodes, none itself."""

    def __init__(self, nodes: Sequence[Participant]) -> None:
        self._nodes = tuple(nodes)
        self._queues: tuple[deque[Frame], ...] = tuple(deque() for _ in nodes)

    @property
    def next_deadline_ns(self) -> int | None:
        """The earliest deadline of all nodes."""
        return min((due for node in self._nodes if (due := node.next_deadline_ns) is not None), default=None)

    def start(self, t_ns: int) -> list[Frame]:
        """Power on all nodes; returns what goes on the bus."""
        for node, queue in zip(self._nodes, self._queues, strict=True):
            queue.extend(node.start(t_ns))
        return self._settle(t_ns)

    def step(self, frames: Sequence[tuple[int, bytes, int]], t_ns: int) -> list[Frame]:
        """Feed what came from the bus, then do what is due by `t_ns`; returns what goes on the bus.

        Args:
            frames: (can_id, data, time of reception in ns), in order.
            t_ns: now; receptions in the future count as now.
        """
        for can_id, data, received_ns in frames:
            for node, queue in zip(self._nodes, self._queues, strict=True):
                if answers := node.receive(can_id, data, min(received_ns, t_ns)):
                    queue.extend(answers)
        for node, queue in zip(self._nodes, self._queues, strict=True):
            due = node.next_deadline_ns
            if due is not None and due <= t_ns:
                queue.extend(node.advance(t_ns))
        return self._settle(t_ns)

    def _settle(self, t_ns: int) -> list[Frame]:
        """Empty the queues, lowest identifier first, each in its own order; let the other nodes hear every frame."""
        sent: list[Frame] = []
        while True:
            sender = min((q for q in self._queues if q), key=_head, default=None)
            if sender is None:
                return sent
            can_id, data = frame = sender.popleft()
            sent.append(frame)
            if len(sent) > _MOST_FRAMES:
                raise BusError(f"the emulated nodes answer each other without an end, last {can_id:03X}")
            for node, queue in zip(self._nodes, self._queues, strict=True):
                if queue is not sender and (answers := node.receive(can_id, data, t_ns)):
                    queue.extend(answers)


def _head(queue: deque[Frame]) -> int:
    return queue[0][0]


def serve(nodes: Sequence[Participant], port: Port, stop: Callable[[], bool], max_wait_ns: int = MAX_WAIT_NS) -> None:
    """Power on the nodes and serve them until `stop()`; it is asked after every wait.

    Args:
        nodes: participants, for example `SlaveNode`s.
        port: of the bus; its clock is the nodes' clock.
        stop: ends the loop when it returns True.
        max_wait_ns: longest wait, so that `stop` is asked often enough.
    """
    exchange, clock = Exchange(nodes), port.clock
    now_ns = clock.now_ns()
    frames = exchange.start(now_ns)
    while True:
        if frames:
            port.send_batch(frames)
        if stop():
            return
        due_ns = exchange.next_deadline_ns
        until_ns = now_ns + max_wait_ns
        port.wait(until_ns if due_ns is None else min(due_ns, until_ns))
        received = port.drain()
        now_ns = clock.now_ns()
        frames = exchange.step(received, now_ns)
