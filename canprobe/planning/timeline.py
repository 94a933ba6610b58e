"""The cycles of a plan as they go when every frame takes its worst-case length and nobody else speaks.

SYNC opens a cycle, the nodes queue what it triggers, the controller starts at the first look that finds all feedback,
its commands follow. Heartbeats and what comes on events are left out: the worst case, with all of them, is the
response time of each message.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Literal

from canprobe.planning.model import SYNC_OVERFLOW, Plan, PlannedBus, PlannedPdo
from canprobe.planning.traffic import on_the_wire
from canprobe.protocol.frame_bits import worst_case_bits
from canprobe.protocol.frames import SYNC_ID

Part = Literal["SYNC", "feedback", "controller", "command", "tactile"]
_SYNCHRONOUS = 240
_ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Slot:
    """Something that takes its time in the cycles.

    Attributes:
        part: what it is.
        channel: bus; empty for the controller.
        cob_id: identifier; None for the controller.
        cycle: from 0, in which it was released.
        start_ns, end_ns: after the first SYNC is queued.
    """

    part: Part
    channel: str
    cob_id: int | None
    cycle: int
    start_ns: int
    end_ns: int


_Release = tuple[int, int, int, Part, int]
"""When, identifier, length (ns), what, cycle."""


def timeline(plan: Plan) -> tuple[Slot, ...]:
    """As many cycles as the slowest frame behind SYNC has, two with a sensor as a rule.

    Args:
        plan: that fits.

    Returns:
        Frames and controller by start; those of the last cycles may end behind it.
    """
    cyclic = [pdo for pdo in plan.pdos if pdo.transmission_type <= _SYNCHRONOUS]
    cycles = max((pdo.transmission_type for pdo in cyclic), default=1)
    period, compute = plan.sync.period_ns, plan.traffic.budget.compute_ns
    starts: list[int | None] = [None] * cycles
    slots: list[Slot] = []
    for _ in range(_ROUNDS):  # when the commands go depends on the feedback, which earlier commands may hold up
        slots = [slot for bus in plan.buses for slot in _carry(bus, _releases(plan, bus, cyclic, starts))]
        found = [_controller_start(plan, slots, cycle) for cycle in range(cycles)]
        if found == starts:
            break
        starts = list(found)
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
    looks = [begin + look for look in plan.traffic.budget.looks_ns]
    return next((look for look in looks if look >= last), looks[-1])


def _releases(
    plan: Plan, bus: PlannedBus, cyclic: Sequence[PlannedPdo], starts: Sequence[int | None]
) -> Iterator[_Release]:
    period, bitrate = plan.sync.period_ns, plan.setup.bus.bitrate
    sync_ns = _ns(worst_case_bits(1 if SYNC_OVERFLOW else 0), bitrate)
    mine = on_the_wire([pdo for pdo in cyclic if pdo.channel == bus.channel])
    for cycle, start in enumerate(starts):
        begin = cycle * period
        yield begin, SYNC_ID, sync_ns, "SYNC", cycle
        for pdo in mine:
            length = _ns(pdo.bits_worst, bitrate)
            if pdo.direction == "rpdo":
                if start is not None:
                    yield start + plan.traffic.budget.compute_ns, pdo.cob_id, length, "command", cycle
            elif cycle % pdo.transmission_type == 0:
                part: Part = "tactile" if pdo.kind == "tactile" else "feedback"
                yield begin + sync_ns, pdo.cob_id, length, part, cycle


def _carry(bus: PlannedBus, releases: Iterator[_Release]) -> Iterator[Slot]:
    """Frames one by one: of those that wait, the lowest identifier."""
    coming = sorted(releases, reverse=True)
    waiting: list[tuple[int, int, int, Part, int]] = []
    now = 0
    while coming or waiting:
        if not waiting:
            now = max(now, coming[-1][0])
        while coming and coming[-1][0] <= now:
            release, cob_id, length, part, cycle = coming.pop()
            heappush(waiting, (cob_id, release, length, part, cycle))
        cob_id, _, length, part, cycle = heappop(waiting)
        yield Slot(part, bus.channel, cob_id, cycle, now, now + length)
        now += length


def _ns(bits: int, bitrate: int) -> int:
    return -(-bits * 1_000_000_000 // bitrate)


LETTERS: dict[Part, str] = {"SYNC": "S", "feedback": "f", "controller": "C", "command": "r", "tactile": "t"}
"""What stands for each part in `timeline_rows`."""


def timeline_rows(plan: Plan, width: int = 80) -> list[list[str]]:
    """A row for each bus and cycle, and for the controller; one character is a `width`-th of the period.

    Args:
        plan: that fits.
        width: characters of a cycle.
    """
    slots, period = timeline(plan), plan.sync.period_ns
    cycles = 1 + max(slot.cycle for slot in slots)
    rows = []
    for cycle in range(cycles):
        for channel in (*(bus.channel for bus in plan.buses), ""):
            cells = ["·"] * width
            for slot in slots:
                if slot.channel == channel:
                    _fill(cells, slot, cycle * period, period)
            rows.append([f"cycle {cycle + 1}" if channel == plan.buses[0].channel else "", channel or "controller",
                         "".join(cells)])  # fmt: skip
    return rows


def _fill(cells: list[str], slot: Slot, begin_ns: int, period_ns: int) -> None:
    """Mark the characters in whose middle something is under way; what is shorter still has one."""
    width = len(cells)
    first = (2 * (slot.start_ns - begin_ns) * width + period_ns) // (2 * period_ns)
    last = (2 * (slot.end_ns - begin_ns) * width + period_ns) // (2 * period_ns)
    for cell in range(max(first, 0), min(max(last, first + 1), width)):
        if slot.end_ns - begin_ns >= 0 and slot.start_ns - begin_ns < period_ns:
            cells[cell] = LETTERS[slot.part]
