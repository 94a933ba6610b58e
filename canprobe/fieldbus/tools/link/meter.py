"""A port that measures the link while a master cycles over it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.tapped import TappedPort
from canprobe.fieldbus.protocol.frame_bits import best_case_bits
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, SYNC_ID, Frame
from canprobe.fieldbus.tools.link.figures import AnswerFigures


class NodeAnswers:
    """Counts the answers of one node, each of one or more frames.

    Args:
        frames: number of frames of an answer.
    """

    __slots__ = ("_frames", "_row", "absent", "before", "expected", "late", "now", "rows", "times_ns")

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self.times_ns: list[int] = []
        self.expected = self.late = self.absent = self._row = 0
        self.rows: list[int] = []
        self.now: list[int] = []
        self.before: list[int] | None = None

    def next_cycle(self, wait_ns: int) -> None:
        """Begin a cycle. The one before the last is over: late answers to the last one may still be read."""
        if self.before is not None:
            self.expected += 1
            whole = len(self.before) >= self._frames
            late = whole and max(self.before) > wait_ns
            self.absent += not whole
            self.late += late
            if whole:
                self.times_ns.append(max(self.before))
            if late or not whole:
                self._row += 1
            elif self._row:
                self.rows.append(self._row)
                self._row = 0
        self.before, self.now = self.now, []

    def figures(self, node_id: int) -> AnswerFigures:
        """The figures, with the row that is not over."""
        rows = (*self.rows, *([self._row] if self._row else ()))
        return AnswerFigures(node_id, self.expected, tuple(sorted(self.times_ns)), self.late, self.absent, rows)


class LinkMeter(TappedPort):
    """Passes everything on to a port, and notes SYNCs, answers and bits from `begin` to `end`.

    A frame counts for the last SYNC that was sent before it arrived. Bits are counted without stuffing.

    Args:
        port: port of the master; it is the only one that talks to these nodes.
        wait_ns: time after SYNC until which the cell waits for answers.
        answers: node of each identifier that is sent once after every SYNC.
        known: all identifiers of the plan.
    """

    def __init__(self, port: Port, *, wait_ns: int, answers: Mapping[int, int], known: Collection[int]) -> None:
        super().__init__(port)
        self._wait_ns, self._known = wait_ns, frozenset(known)
        self._answers = dict(answers)
        nodes = [*answers.values()]
        self._nodes = {node_id: NodeAnswers(nodes.count(node_id)) for node_id in sorted(set(nodes))}
        self._measures = False
        self._sync_ns: int | None = None
        self._sync_before_ns: int | None = None
        self._begin_ns = self._end_ns = self._heard_ns = 0
        self._works_ns: list[int] = []
        self.bits = self.foreign = 0

    def defer(self, can_ids: Collection[int]) -> None:
        self._port.defer(can_ids)

    def send_on(self, channel: str, frames: Sequence[Frame]) -> None:
        """Send frames on one of several buses."""
        self._port.send_on(channel, frames)  # type: ignore[attr-defined]  # a `JoinedPort` has it

    def hear_sent(self, frames: Sequence[Frame], t_ns: int) -> None:
        """Note frames of the master; a SYNC begins a cycle."""
        if not self._measures:
            return
        if self._heard_ns and all(can_id != SYNC_ID for can_id, _ in frames):
            self._works_ns.append(self.clock.now_ns() - self._heard_ns)
            self._heard_ns = 0
        for can_id, data in frames:
            self._count(data)
            if can_id == SYNC_ID:
                if self._sync_ns is not None:
                    for one in self._nodes.values():
                        one.next_cycle(self._wait_ns)
                self._sync_before_ns, self._sync_ns = self._sync_ns, t_ns

    def hear_received(self, frames: Sequence[TimedFrame]) -> None:
        """Note frames of others: each counts for the last SYNC before it."""
        if not self._measures or self._sync_ns is None:
            return
        self._heard_ns = self.clock.now_ns() if frames else self._heard_ns
        for can_id, data, t_ns in frames:
            self._count(data)
            node_id = self._answers.get(can_id)
            if node_id is None:
                self.foreign += can_id not in self._known
            elif t_ns >= self._sync_ns:
                self._nodes[node_id].now.append(t_ns - self._sync_ns)
            elif self._sync_before_ns is not None and (before := self._nodes[node_id].before) is not None:
                before.append(t_ns - self._sync_before_ns)

    def begin(self) -> None:
        """Begin to measure, with the next SYNC."""
        self._measures, self._begin_ns = True, self.clock.now_ns()

    def end(self) -> None:
        """End the measurement; the last two cycles, which may not be over, do not count."""
        self._measures, self._end_ns = False, self.clock.now_ns()

    def answers(self) -> tuple[AnswerFigures, ...]:
        """Figures of the nodes."""
        return tuple(one.figures(node_id) for node_id, one in self._nodes.items())

    @property
    def work_ns(self) -> int:
        """Usual time from the last frame that was read to the end of the commands, ns."""
        return sorted(self._works_ns)[len(self._works_ns) // 2] if self._works_ns else 0

    @property
    def seconds(self) -> float:
        """Length of the measurement, s."""
        return (self._end_ns - self._begin_ns) * 1e-9

    def load(self, bitrate: int) -> float | None:
        """Measured load, a share of the bit rate; None where nothing was measured."""
        return self.bits / (bitrate * self.seconds) if self.seconds > 0.0 else None

    def _count(self, data: bytes) -> None:
        self.bits += best_case_bits(min(len(data), CLASSIC_BYTES)) + 8 * max(0, len(data) - CLASSIC_BYTES)
