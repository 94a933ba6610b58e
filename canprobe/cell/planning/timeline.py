"""The cycles of a plan in time, where every frame has its worst-case length and no other node sends.

SYNC opens a cycle, the nodes queue what it triggers, the controller starts at the first look that finds all feedback,
its commands follow. Heartbeats and what comes on events are left out: the worst case, with all of them, is the
response time of each message.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush

from canprobe.cell.planning.model import Part, Plan, PlannedBus, PlannedPdo
from canprobe.cell.planning.traffic import SYNC_BITS, on_the_wire, wire_ns
from canprobe.fieldbus.protocol.frames import SYNC_ID

_MAX_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Slot:
    """Time of a frame or of the controller in the cycles.

    Attributes:
        part: its part in the cycle.
        channel: its bus; empty for the controller.
        cob_id: identifier; None for the controller.
        cycle: cycle in which it was released, from 0.
        start_ns, end_ns: times after the first SYNC was queued.
    """

    part: Part
    channel: str
    cob_id: int | None
    cycle: int
    start_ns: int
    end_ns: int


def timeline(plan: Plan) -> tuple[Slot, ...]:
    """Slots of as many cycles as the slowest frame behind SYNC has; two as a rule with an array.

    Args:
        plan: the plan.

    Returns:
        Frames and controller by start; the last ones may end behind the last cycle.
    """
    cyclic = [pdo for pdo in plan.pdos if pdo.layout.synchronous]
    cycles = max((pdo.transmission_type for pdo in cyclic), default=1)
    period, compute = plan.sync.period_ns, plan.budget.compute_ns
    starts: list[int | None] = [None] * cycles
    slots: list[Slot] = []
    for _ in range(_MAX_ROUNDS):  # commands follow the feedback, which earlier commands may delay
        slots = [slot for bus in plan.buses for slot in _carried(_released(plan, bus, cyclic, starts))]
        found: list[int | None] = [_controller_start(plan, slots, cycle) for cycle in range(cycles)]
        if found == starts:
            break
        starts = found
    thinking = [
        Slot("controller", "", None, cycle, start, start + compute)
        for cycle, start in enumerate(starts)
        if start is not None and start < cycles * period
    ]
    return tuple(sorted([*slots, *thinking], key=lambda slot: (slot.start_ns, slot.channel)))


def _controller_start(plan: Plan, slots: Sequence[Slot], cycle: int) -> int:
    """The first look of a cycle that finds all its feedback."""
    begin = cycle * plan.sync.period_ns
    last = max((slot.end_ns for slot in slots if slot.part == "feedback" and slot.cycle == cycle), default=begin)
    looks = [begin + look for look in plan.budget.looks_ns]
    return next((look for look in looks if look >= last), looks[-1])


def _released(
    plan: Plan, bus: PlannedBus, cyclic: Sequence[PlannedPdo], starts: Sequence[int | None]
) -> Iterator[Slot]:
    """Every frame of one bus, each as if the bus were free."""
    bitrate = plan.setup.bus.bitrate
    sync_ns = wire_ns(SYNC_BITS, bitrate)
    mine = on_the_wire([pdo for pdo in cyclic if pdo.channel == bus.channel])
    for cycle, start in enumerate(starts):
        begin = cycle * plan.sync.period_ns
        yield Slot("SYNC", bus.channel, SYNC_ID, cycle, begin, begin + sync_ns)
        for pdo in mine:
            length = wire_ns(pdo.bits_worst, bitrate)
            if pdo.direction == "rpdo":
                if start is not None:
                    out = start + plan.budget.compute_ns
                    yield Slot("command", bus.channel, pdo.cob_id, cycle, out, out + length)
            elif cycle % pdo.transmission_type == 0:
                yield Slot(pdo.part, bus.channel, pdo.cob_id, cycle, begin + sync_ns, begin + sync_ns + length)


def _carried(released: Iterator[Slot]) -> Iterator[Slot]:
    """Frames one after the other: of those that wait, the lowest identifier first."""
    coming = sorted(released, key=lambda slot: slot.start_ns, reverse=True)
    waiting: list[tuple[int | None, int, Slot]] = []
    now = 0
    while coming or waiting:
        if not waiting:
            now = max(now, coming[-1].start_ns)
        while coming and coming[-1].start_ns <= now:
            slot = coming.pop()
            heappush(waiting, (slot.cob_id, slot.start_ns, slot))
        slot = heappop(waiting)[-1]
        end = now + slot.end_ns - slot.start_ns
        yield replace(slot, start_ns=now, end_ns=end)
        now = end


LETTERS: dict[Part, str] = {
    "SYNC": "S",
    "feedback": "f",
    "controller": "C",
    "command": "r",
    "tactile": "t",
    "other": "o",
}
"""Letter of each part in `timeline_rows`."""


def timeline_rows(plan: Plan, width: int = 80) -> list[list[str]]:
    """A row for each bus and cycle, and for the controller; one character is a `width`-th of the period.

    Args:
        plan: the plan.
        width: characters of a cycle.
    """
    slots, period = timeline(plan), plan.sync.period_ns
    rows = []
    for cycle in range(1 + max(slot.cycle for slot in slots)):
        for channel in (*(bus.channel for bus in plan.buses), ""):
            cells = ["·"] * width
            for slot in slots:
                start, end = slot.start_ns - cycle * period, slot.end_ns - cycle * period
                if slot.channel == channel and end >= 0 and start < period:
                    # the characters in whose middle it is under way; what is shorter still has one
                    first, last = ((2 * t_ns * width + period) // (2 * period) for t_ns in (start, end))
                    for cell in range(max(first, 0), min(max(last, first + 1), width)):
                        cells[cell] = LETTERS[slot.part]
            title = f"cycle {cycle + 1}" if channel == plan.buses[0].channel else ""
            rows.append([title, channel or "controller", "".join(cells)])
    return rows
