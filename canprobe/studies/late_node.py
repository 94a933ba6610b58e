"""A node whose PDOs come late, attached to a lockstep bus in the node's place: the delay of a bus or a gateway."""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Sequence

from canprobe.emulator.node import SlaveNode
from canprobe.emulator.wrapped_node import WrappedNode
from canprobe.protocol.frames import Frame


class LateNode(WrappedNode):
    """Holds back some frames to and from a node, in their order; all others pass at once.

    Args:
        node: the node.
        late_ids: COB-IDs that come late, both ways.
        late_ns: by how much.
    """

    def __init__(self, node: SlaveNode, late_ids: Container[int], late_ns: int) -> None:
        super().__init__(node)
        self._late_ids, self._late_ns = late_ids, late_ns
        self._in: deque[tuple[int, Frame]] = deque()
        self._out: deque[tuple[int, Frame]] = deque()

    @property
    def next_deadline_ns(self) -> int | None:
        """The node's, or that of the next late frame."""
        due = [queue[0][0] for queue in (self._in, self._out) if queue]
        own = self.node.next_deadline_ns
        return min(due if own is None else [*due, own], default=None)

    def start(self, t_ns: int) -> Sequence[Frame]:
        """Power on."""
        return self._sent(self.node.start(t_ns), t_ns)

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        """A frame from the bus, now or later."""
        if can_id in self._late_ids:
            self._in.append((t_ns + self._late_ns, (can_id, data)))
            return ()
        return self._sent(self.node.receive(can_id, data, t_ns), t_ns)

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """What is due."""
        ready: list[Frame] = []
        while self._out and self._out[0][0] <= t_ns:
            ready.append(self._out.popleft()[1])
        while self._in and self._in[0][0] <= t_ns:
            _, frame = self._in.popleft()
            ready += self._sent(self.node.receive(*frame, t_ns), t_ns)
        own = self.node.next_deadline_ns
        if own is not None and own <= t_ns:
            ready += self._sent(self.node.advance(t_ns), t_ns)
        return ready

    def _sent(self, frames: Sequence[Frame], t_ns: int) -> list[Frame]:
        now: list[Frame] = []
        for frame in frames:
            if frame[0] in self._late_ids:
                self._out.append((t_ns + self._late_ns, frame))
            else:
                now.append(frame)
        return now
