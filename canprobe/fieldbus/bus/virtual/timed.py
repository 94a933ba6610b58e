"""A lockstep bus with a bit rate: one frame at a time, each as long as its bits, the lowest identifier first.

A frame that is queued while another is on the wire waits for its end; then the frame with the lowest identifier is sent
to its end. Receivers get a frame with the last bit of its end-of-frame field; the next may follow after three bits of
intermission. A frame that the wire corrupts ends in an error frame and is sent again. Every controller counts errors by
ISO 11898-1; it waits as an error-passive transmitter, and is off the bus from bus off until it has heard 128 times
eleven recessive bits.

All of it runs in virtual time and is deterministic, as on a `LockstepBus`. The controller decides which of its frames a
node sends first: with `queue="priority"` that of the lowest identifier, as from mailboxes; with "fifo" the oldest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from heapq import heapify, heappop, heappush
from typing import Literal

from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import ERR_BUS, ERR_FLAG, ERR_PROTOCOL
from canprobe.fieldbus.bus.virtual.controllers import Controllers, ErrorCounters, WireErrors
from canprobe.fieldbus.bus.virtual.lockstep import Attachment, LockstepBus, LockstepPort, Participant, arbitration_key
from canprobe.fieldbus.protocol.frame_bits import (
    ERROR_DELIMITER_BITS,
    ERROR_FLAG_BITS,
    INTERMISSION_BITS,
    NS_PER_S,
    exact_bits,
)
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, Frame

Queue = Literal["priority", "fifo"]
MAX_CLOSING_NS = 50_000_000
"""Longest time that a port which closes lets the bus carry what is queued."""
_ERROR_BITS = 2 * ERROR_FLAG_BITS + ERROR_DELIMITER_BITS  # the other nodes answer the flag of the first one with theirs

_Entry = tuple[int, int, Attachment, Frame]
"""A frame in the arbitration: bits that the wire compares, order of queueing, sender, frame."""


class TimedBus(LockstepBus):
    """The bus; participants attach and ports are taken as on a `LockstepBus`.

    Args:
        clock: virtual clock, which other buses may share.
        channel: name of the bus in messages and logs.
        bitrate: bit rate, bit/s.
        queue: order in which a node with several frames sends them.
        errors: model of the errors on the wire; None: there are none.
        length: function for the bits of a frame with its intermission, exact by default.
        max_frames: most frames that may wait at once; more mean that somebody sends without an end.

    Attributes:
        errors: model of the errors; another one may take its place while the bus runs.
        frames, error_frames: number of frames and error frames so far.
        busy_ns: time so far in which the bus was busy, with intermissions.
    """

    def __init__(
        self,
        clock: VirtualClock,
        channel: str = "can0",
        *,
        bitrate: int = 1_000_000,
        queue: Queue = "priority",
        errors: WireErrors | None = None,
        length: Callable[[int, bytes], int] = exact_bits,
        max_frames: int = 20_000,
    ) -> None:
        super().__init__(clock, channel, max_frames=max_frames)
        self.bitrate = bitrate
        self._gap_ns = self._bits_ns(INTERMISSION_BITS)
        self.frames = self.error_frames = self.busy_ns = 0
        self._fifo = queue == "fifo"
        self.errors = errors
        self._length = length
        self._ready: list[_Entry] = []  # heap of the frames that wait
        self._order = 0
        self._flying: _Entry | None = None
        self._hit = False
        self._end_ns = self._free_ns = 0
        self._since_ns = 0  # time at which the first of the waiting frames was queued
        self._controllers = Controllers(self._bits_ns)
        self._stale = True  # the participants' deadlines have to be read again
        self._first_due: int | None = None

    def counters(self, owner: Participant) -> ErrorCounters:
        """Error counters of a participant or a port.

        Raises:
            KeyError: the owner is not on the bus.
        """
        if self._flying is None:
            self._controllers.hear_silence(self.clock.now_ns())
        return self._controllers.of(owner)

    def next_deadline_ns(self) -> int | None:
        """Return the time at which the wire or a participant next has something to do."""
        if self._stale or (self._flying is None and not self._ready):
            self._first_due = super().next_deadline_ns()
            self._stale = False
        first = self._first_due
        if self._flying is not None:
            wire: int | None = self._end_ns
        else:
            wire = self._next_start() if self._ready else None
        if wire is not None and (first is None or wire < first):
            first = wire
        if self._controllers.troubled and self._flying is None:
            back = self._controllers.next_return_ns()
            if back is not None and (first is None or back < first):
                first = back
        return first

    def settle(self) -> None:
        """Do what is due at the present instant: end of a frame, deadlines of participants, start of the next frame."""
        if self._settling:
            return
        t_ns = self.clock.now_ns()
        self._settling = True
        if self._stale:
            self.next_deadline_ns()
        try:
            while True:
                if self._flying is not None and self._end_ns <= t_ns:
                    self._finish()
                elif self._first_due is not None and self._first_due <= t_ns:
                    self._serve(t_ns)
                elif self._flying is not None or not self._ready or self._free_ns > t_ns or not self._start(t_ns):
                    break
            if self._controllers.troubled and self._flying is None:
                self._controllers.hear_silence(t_ns)
        finally:
            self._settling = False

    def run_until_ns(self, until_ns: int) -> None:
        self._stale = True  # somebody else may have changed a participant meanwhile
        super().run_until_ns(until_ns)

    def _serve(self, t_ns: int) -> None:
        """Serve everybody whose deadline has come."""
        for _ in range(self._max_frames):
            self._advance_due(t_ns)
            self._first_due = self._earliest()
            if self._first_due is None or self._first_due > t_ns:
                return
        raise self._endless(t_ns, "deadlines that never move on, of " + self._names_due(t_ns))

    def send(self, node: Attachment, frames: Sequence[Frame]) -> None:
        """Queue the frames of a port; each is sent when the bus is free and its identifier is the lowest."""
        self._stale = True
        self._queue(node, frames)
        self.settle()

    def _earliest(self) -> int | None:
        return min((node.due for node in self._nodes if node.due is not None), default=None)

    def _bits_ns(self, bits: int) -> int:
        return -(-bits * NS_PER_S // self.bitrate)

    def _queue(self, node: Attachment, frames: Sequence[Frame]) -> None:
        if not frames or (self._controllers.troubled and self._controllers.is_off(node)):
            return  # a controller that is bus off sends nothing
        for frame in frames:
            if len(frame[1]) > CLASSIC_BYTES:
                self._check(node, frame)
        if self._fifo:
            node.outbox.extend(frames)
            if not self._is_ready(node):
                self._compete(node, (node.outbox.popleft(),))
        else:
            self._compete(node, frames)
        if len(self._ready) + len(node.outbox) > self._max_frames:
            self._ready.clear()
            raise self._endless(self.clock.now_ns(), f"more than {self._max_frames} frames wait, of {node.owner.name}")

    def _is_ready(self, node: Attachment) -> bool:
        flying = self._flying
        return (flying is not None and flying[2] is node) or any(entry[2] is node for entry in self._ready)

    def _compete(self, node: Attachment, frames: Sequence[Frame]) -> None:
        ready, order = self._ready, self._order
        if not ready:
            self._since_ns = self.clock.now_ns()
        for frame in frames:
            order += 1
            can_id = frame[0]
            heappush(ready, (can_id << 21 if can_id <= 0x7FF else arbitration_key(can_id), order, node, frame))
        self._order = order

    def _start(self, t_ns: int) -> bool:
        """Let the winner of the arbitration send; return False where all nodes with a frame have to wait."""
        entry = self._winner(t_ns) if self._controllers.suspended else heappop(self._ready)
        if entry is None:
            return False
        can_id, data = entry[3]
        bits = self._length(can_id, data) - INTERMISSION_BITS
        if self._controllers.troubled:
            self._controllers.hear_silence(t_ns)
        hit = None if self.errors is None else self.errors(can_id, data, bits)
        if len(self._nodes) < 2:
            hit = bits - 9  # the ACK slot, in which nobody acknowledges it
        if hit is not None:
            bits = hit + 1 + _ERROR_BITS
        self._flying, self._hit = entry, hit is not None
        self._end_ns = t_ns + self._bits_ns(bits)
        self._free_ns = self._end_ns + self._gap_ns
        self.busy_ns += self._free_ns - t_ns
        return True

    def _winner(self, t_ns: int) -> _Entry | None:
        """Winner among the nodes that do not have to wait after a frame of their own."""
        waiting = []
        found = None
        while self._ready and found is None:
            entry = heappop(self._ready)
            if self._controllers.suspended.get(entry[2], 0) > t_ns:
                waiting.append(entry)
            else:
                found = entry
        for entry in waiting:
            heappush(self._ready, entry)
        return found

    def _next_start(self) -> int:
        """Time at which the next frame can start."""
        start = self._free_ns if self._free_ns > self._since_ns else self._since_ns
        if self._controllers.suspended:
            start = max(start, min(self._controllers.suspended.get(entry[2], 0) for entry in self._ready))
        return start

    def _finish(self) -> None:
        """End the frame on the wire, or count its error and let it compete again.

        Everybody hears it but its sender and the nodes that are bus off; their answers are queued.
        """
        entry = self._flying
        assert entry is not None
        _, _, sender, (can_id, data) = entry
        t_ns, self._flying = self._end_ns, None
        if self._hit:
            self._fail(entry, t_ns)
            return
        off: Sequence[Attachment] = ()
        if self._controllers.troubled:
            self._controllers.succeed(sender, t_ns)
            off = self._controllers.off()
        self.frames += 1
        if self._fifo and sender.outbox:
            self._compete(sender, (sender.outbox.popleft(),))
        if self.recorder is not None:
            self.recorder(can_id, data, t_ns)
        moved = False
        for receive, receiver in sender.listeners.get(can_id) or self._listeners_of(sender, can_id):
            if off and receiver in off:
                continue
            answers = receive(can_id, data, t_ns)
            due = receiver.owner.next_deadline_ns
            if due != receiver.due:
                receiver.due, moved = due, True
            if answers:
                self._queue(receiver, answers)
        if moved:
            self._first_due = self._earliest()

    def _fail(self, entry: _Entry, t_ns: int) -> None:
        """Drop the frame on the wire; its sender tries again, unless it is bus off now."""
        self.error_frames += 1
        if self.error_recorder is not None:
            self.error_recorder(ERR_FLAG | ERR_PROTOCOL | ERR_BUS, bytes(CLASSIC_BYTES), t_ns)
        sender = entry[2]
        self._controllers.fail(sender, t_ns)
        if self._controllers.is_off(sender):
            self._silence(sender)
        else:
            heappush(self._ready, entry)

    def _silence(self, node: Attachment) -> None:
        """Drop what a node that is bus off wanted to send."""
        node.outbox.clear()
        self._ready = [entry for entry in self._ready if entry[2] is not node]
        heapify(self._ready)

    def remove_port(self, port: LockstepPort) -> None:
        """Take a closed port off the bus after its frames and the answers at once have been carried."""
        limit_ns = self.clock.now_ns() + MAX_CLOSING_NS
        while (self._flying is not None or self._ready) and self.clock.step(limit_ns):
            pass
        super().remove_port(port)

    def _add(self, owner: Participant) -> Attachment:
        node = super()._add(owner)
        self._controllers.add(node)
        self._stale = True
        return node

    def detach(self, participant: Participant) -> None:
        for node in [node for node in self._nodes if node.owner is participant]:
            self._silence(node)
            self._controllers.remove(node)
            if self._flying is not None and self._flying[2] is node:
                self._flying = None  # the node falls silent in the middle of a frame
        super().detach(participant)
        self._stale = True
