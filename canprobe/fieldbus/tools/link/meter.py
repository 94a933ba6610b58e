"""A port that measures the link while a master cycles over it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby

from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.tapped import TappedPort
from canprobe.fieldbus.protocol.frame_bits import best_case_bits
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, SYNC_ID, Frame
from canprobe.fieldbus.tools.link.figures import AnswerFigures


class NodeAnswers:
    """The answers of one node, each of one or more frames.

    Args:
        frames: number of frames of an answer.

    Attributes:
        now, before: times of its frames behind the last SYNC and the one before it, ns; None before there is one.
    """

    __slots__ = ("_cycles", "_frames", "before", "now")

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._cycles: list[int | None] = []  # time of the last frame; None where the answer is not whole
        self.now: list[int] = []
        self.before: list[int] | None = None

    def next_cycle(self) -> None:
        """Begin a cycle. The one before the last is over: late answers to the last one may still be read."""
        if self.before is not None:
            self._cycles.append(max(self.before) if len(self.before) >= self._frames else None)
        self.before, self.now = self.now, []

    def figures(self, node_id: int, wait_ns: int) -> AnswerFigures:
        """The figures, for a cell that waits for answers until `wait_ns` behind SYNC."""
        times = sorted(time for time in self._cycles if time is not None)
        missed = groupby(time is None or time > wait_ns for time in self._cycles)
        rows = tuple(len([*row]) for is_missed, row in missed if is_missed)
        late, absent = sum(time > wait_ns for time in times), len(self._cycles) - len(times)
        return AnswerFigures(node_id, len(self._cycles), tuple(times), late, absent, rows)


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
                        one.next_cycle()
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
        return tuple(one.figures(node_id, self._wait_ns) for node_id, one in self._nodes.items())

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
