"""The plan as people read it on a terminal, as a timeline of its cycles, and as JSON types."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from heapq import heappop, heappush
from typing import Any, Literal

from canprobe.planning.bridges import BRIDGES
from canprobe.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    SYNC_OVERFLOW,
    CycleBudget,
    Demand,
    Plan,
    PlannedBus,
    PlannedNode,
    PlannedPdo,
    Traffic,
)
from canprobe.planning.traffic import on_the_wire
from canprobe.protocol.frame_bits import worst_case_bits
from canprobe.protocol.frames import SYNC_ID
from canprobe.protocol.pdo import PdoEntry

# The cycles of a plan as they go when every frame takes its worst-case length and nobody else speaks.
#
# SYNC opens a cycle, the nodes queue what it triggers, the controller starts at the first look that finds all feedback,
# its commands follow. Heartbeats and what comes on events are left out: the worst case, with all of them, is the
# response time of each message.

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


# The plan as people read it on a terminal.

TIMELINE_WIDTH = 100
"""Characters of a cycle."""


def plan_text(plan: Plan) -> str:
    """The whole plan, ending with a newline."""
    return "\n".join(_lines(plan)) + "\n"


def _lines(plan: Plan) -> Iterator[str]:
    bus, sync = plan.setup.bus, plan.sync
    yield f"{plan.setup.name}: {plan.setup.title}" if plan.setup.title else plan.setup.name
    channels = " and ".join(one.channel for one in plan.buses)
    yield f"bus {channels} ({bus.interface}), {bus.bitrate} bit/s"
    if bus.fd:
        yield (
            f"CAN FD frames above 8 bytes, their data at {bus.data_bitrate} bit/s and counted in bits of "
            f"{bus.bitrate} bit/s; everything else classical; every controller on the bus must tolerate CAN FD, which "
            "no EDS tells"
        )
    interpolation = f", 60C2h = {sync.interpolation_100us}·10⁻⁴ s" if sync.interpolation_100us is not None else ""
    yield (
        f"SYNC {sync.rate_hz:g} Hz (1006h = {sync.period_us} µs, 1019h = {sync.overflow}{interpolation}), "
        f"heartbeat every {HEARTBEAT_PRODUCED_MS} ms, lost after {HEARTBEAT_CONSUMED_MS} ms"
    )
    if bus.transmit_queue == "fifo":
        yield 'bus.transmit_queue = "fifo": nodes send their oldest frame first; a heartbeat holds up what follows it'
    yield from (f"warning: {warning}" for warning in plan.warnings)
    yield from _titled("nodes", _node_rows(plan.nodes))
    yield from _titled("PDOs, from the device's view, highest priority first", _pdo_rows(plan.pdos))
    for one in plan.buses:
        yield from _titled(f"bus {one.channel}, worst case", list(_bus_rows(one.traffic)))
    title = f"one cycle of {_us(sync.period_ns)} µs, worst case, µs after its SYNC is due"
    yield from _titled(title, list(_budget_rows(plan.traffic.budget)))
    yield from _titled(_timeline_title(plan), timeline_rows(plan, TIMELINE_WIDTH))
    if plan.choices:
        rows = [[f"{choice.key} = {choice.value}", choice.why] for choice in plan.choices]
        yield from _titled("chosen by the plan", rows)
    if plan.joint_speeds is not None:
        rows = [["joint", "needed deg/s", "allowed deg/s"]]
        speeds = zip(plan.joint_speeds.needed_deg_s, plan.joint_speeds.limit_deg_s, strict=True)
        rows += [[str(i), f"{needed:.1f}", f"{limit:g}"] for i, (needed, limit) in enumerate(speeds, start=1)]
        arm = plan.setup.arm
        for row, joint in zip(rows[1:], arm.model.joints if arm is not None else (), strict=True):
            row[0] += " (mm/s)" if joint.prismatic else ""
        yield from _titled("joint speeds", rows)
    yield from _titled("uses", list(_use_rows(plan)))
    yield from _titled("leaves out", [list(row) for row in plan.left_out])
    if plan.not_available:
        yield from _titled("could not have", [list(row) for row in plan.not_available])


def _timeline_title(plan: Plan) -> str:
    return (
        f"as it goes, worst-case lengths, one character {_us(plan.sync.period_ns // TIMELINE_WIDTH)} µs "
        "(S SYNC, f feedback, C controller, r commands, t tactile)"
    )


def _titled(title: str, rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield ""
    yield f"{title}:"
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    right = [_is_numeric(column[1:]) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (
            cell.rjust(width) if numeric else cell.ljust(width)
            for cell, width, numeric in zip(row, widths, right, strict=True)
        )
        yield "  " + "  ".join(cells).rstrip()


def _is_numeric(cells: Sequence[str]) -> bool:
    """Numbers belong to the right; a time without a bound is among them."""
    return bool(cells) and all(re.fullmatch(r"-?[\d.]+( %)?|unbounded", cell) for cell in cells)


def _node_rows(nodes: Sequence[PlannedNode]) -> list[list[str]]:
    several = len({node.channel for node in nodes}) > 1
    rows = [["id", "role", "identity (vendor product revision)", "EDS", "", *(["bus"] if several else [])]]
    for node in nodes:
        numbers = " ".join("any" if number is None else f"{number:08X}h" for number in node.identity.numbers[:3])
        if node.identity.serial_number is not None:
            numbers += f" serial {node.identity.serial_number:08X}h"
        kind = "emulated" if node.emulated else "real"
        rows.append([str(node.node_id), node.role, numbers, node.eds, kind, *([node.channel] if several else [])])
    return rows


def _pdo_rows(pdos: Sequence[PlannedPdo]) -> list[list[str]]:
    several = len({pdo.channel for pdo in pdos}) > 1
    times = ["response µs", "deadline µs", "slack µs"]
    rows = [[*(["bus"] * several), "COB-ID", "node", "PDO", "type", "Hz", "bytes", "bits", *times, "content"]]
    for pdo in pdos:
        rows.append(
            [
                *([pdo.channel] * several),
                f"{pdo.cob_id:03X}h",
                str(pdo.node_id),
                f"{pdo.direction.upper()}{pdo.number}",
                str(pdo.transmission_type),
                f"{pdo.rate_hz:g}",
                str(pdo.layout.length),
                str(pdo.bits_worst),
                _us(pdo.response_ns),
                _us(pdo.deadline_ns),
                _us(pdo.slack_ns),
                _content(pdo.entries),
            ]
        )
    return rows


def _content(entries: Sequence[PdoEntry]) -> str:
    """The objects of a mapping, a row of neighbours as its first and last."""
    rows: list[list[PdoEntry]] = []
    for entry in entries:
        last = rows[-1][-1] if rows else None
        follows = last is not None and (entry.index, entry.subindex) == (last.index, last.subindex + 1)
        rows[-1].append(entry) if follows and not entry.is_dummy else rows.append([entry])
    return ", ".join(
        "dummy"
        if row[0].is_dummy
        else f"{row[0].index:04X}h:{row[0].subindex:02X}" + (f"–{row[-1].subindex:02X}" * (len(row) > 1))
        for row in rows
    )


def _bus_rows(traffic: Traffic) -> Iterator[list[str]]:
    parts = ", ".join(f"{what} {100 * share:.1f} %" for what, share in traffic.parts)
    yield ["load", f"{100 * traffic.load:.1f} %", parts]
    for demand in traffic.demands:
        cycles = f"{demand.cycles} cycle" + ("s" if demand.cycles > 1 else "")
        yield [
            f"in {cycles}",
            f"{100 * demand.used_ns / demand.available_ns:.1f} %",
            f"{demand.what}: {_us(demand.used_ns)} of {_us(demand.available_ns)} µs",
        ]


def _budget_rows(budget: CycleBudget) -> Iterator[list[str]]:
    """When what is done after the SYNC, and what each part takes."""
    yield ["SYNC through", _us(budget.sync_ns), ""]
    if budget.feedback_ns is not None:
        yield ["last TPDO of the drives in", _us(budget.feedback_ns), ""]
    yield ["controller starts", _us(budget.start_ns), f"and takes {_us(budget.compute_ns)} (cycle.compute_us)"]
    if budget.commands_ns is not None:
        yield ["last RPDO through", _us(budget.commands_ns), ""]
    if budget.tactile_ns is not None:
        yield ["tactile frame in", _us(budget.tactile_ns), "of the SYNC that triggered it"]
    whole = f"{_us(budget.period_ns)}, less bus {_us(budget.bus_ns)} and controller {_us(budget.compute_ns)}"
    yield ["left before the next SYNC", _us(budget.slack_ns), whole]


def _use_rows(plan: Plan) -> Iterator[list[str]]:
    yield ["task", plan.setup.kind]
    if plan.strategy is not None:
        yield ["strategy", plan.strategy]
    if plan.estimator is not None:
        also = f"; on the same data afterwards: {', '.join(plan.offline_estimators)}" if plan.offline_estimators else ""
        yield ["estimator", plan.estimator + also]
    if plan.fidelity is not None:
        emulated = ", ".join(map(str, plan.setup.emulated_node_ids))
        yield ["emulator", f"nodes {emulated}; arm {plan.fidelity}" if plan.setup.arm else f"nodes {emulated}"]
    for name in plan.setup.bridge.use if plan.setup.bridge is not None else ():
        yield ["bridge", f"{name}: {BRIDGES[name].what}; needs {', '.join(BRIDGES[name].packages)}"]
    yield ["outputs", ", ".join(plan.outputs)]


def _us(t_ns: int | None) -> str:
    return "unbounded" if t_ns is None else f"{t_ns / 1000:g}"


# The plan as JSON types, for `canprobe plan --json` and other tools.

SCHEMA = 1


def plan_dict(plan: Plan) -> dict[str, Any]:
    """Every field of the plan; what does not apply is None."""
    bus = plan.setup.bus
    return {
        "schema": SCHEMA,
        "scene": plan.setup.name,
        "fits": True,
        "title": plan.setup.title,
        "bus": {
            "interface": bus.interface,
            "channel": bus.channel,
            "bitrate": bus.bitrate,
            "transmit_queue": bus.transmit_queue,
            "fd": bus.fd,
            "data_bitrate": bus.data_bitrate if bus.fd else None,
        },
        "sync": asdict(plan.sync),
        "heartbeat": {
            "master_node_id": MASTER_NODE_ID,
            "produced_ms": HEARTBEAT_PRODUCED_MS,
            "consumed_ms": HEARTBEAT_CONSUMED_MS,
        },
        "nodes": [_node(node) for node in plan.nodes],
        "pdos": [_pdo(pdo) for pdo in plan.pdos],
        "bus_load": {one.channel: _bus(one) for one in plan.buses},
        "choices": [{"key": choice.key, "value": choice.value, "why": choice.why} for choice in plan.choices],
        "timeline": [_slot(slot) for slot in timeline(plan)],
        "joint_speeds": asdict(plan.joint_speeds) if plan.joint_speeds is not None else None,
        "estimator": plan.estimator,
        "offline_estimators": list(plan.offline_estimators),
        "strategy": plan.strategy,
        "fidelity": plan.fidelity,
        "bridges": list(plan.setup.bridge.use) if plan.setup.bridge is not None else [],
        "outputs": list(plan.outputs),
        "left_out": [{"what": what, "why": why} for what, why in plan.left_out],
        "not_available": [{"what": what, "why": why} for what, why in plan.not_available],
        "warnings": list(plan.warnings),
    }


def refused_dict(name: str, problems: Sequence[str], ways_out: Sequence[str]) -> dict[str, Any]:
    """What is said of a scene that does not fit."""
    return {
        "schema": SCHEMA,
        "scene": name,
        "fits": False,
        "problems": list(problems),
        "ways_out": list(ways_out),
    }


def _bus(bus: PlannedBus) -> dict[str, Any]:
    return {
        "node_ids": list(bus.node_ids),
        "planned_worst": bus.traffic.load,
        "parts": dict(bus.traffic.parts),
        "demands": [_demand(demand) for demand in bus.traffic.demands],
        "sync_response_us": _microseconds(bus.traffic.sync_response_ns),
        "budget": _budget(bus.traffic.budget),
    }


def _node(node: PlannedNode) -> dict[str, Any]:
    switched_off = [{"direction": direction, "number": number} for direction, number in node.switched_off]
    return asdict(node) | {"switched_off": switched_off}


def _pdo(pdo: PlannedPdo) -> dict[str, Any]:
    return {
        "node_id": pdo.node_id,
        "channel": pdo.channel,
        "direction": pdo.direction,
        "number": pdo.number,
        "cob_id": pdo.cob_id,
        "entries": [
            {"index": entry.index, "subindex": entry.subindex, "bits": entry.bits, "name": entry.name}
            for entry in pdo.entries
        ],
        "transmission_type": pdo.transmission_type,
        "rate_hz": pdo.rate_hz,
        "bytes": pdo.layout.length,
        "bits_worst": pdo.bits_worst,
        "deadline_us": _microseconds(pdo.deadline_ns),
        "response_us": _microseconds(pdo.response_ns),
        "slack_us": _microseconds(pdo.slack_ns),
        "event_timer_ms": pdo.event_timer_ms or None,
    }


def _slot(slot: Slot) -> dict[str, Any]:
    return {
        "part": slot.part,
        "channel": slot.channel or None,
        "cob_id": slot.cob_id,
        "cycle": slot.cycle,
        "start_us": _microseconds(slot.start_ns),
        "end_us": _microseconds(slot.end_ns),
    }


def _demand(demand: Demand) -> dict[str, Any]:
    return {
        "what": demand.what,
        "cycles": demand.cycles,
        "used_us": _microseconds(demand.used_ns),
        "available_us": _microseconds(demand.available_ns),
    }


def _budget(budget: CycleBudget) -> dict[str, Any]:
    """The cycle's budget in µs."""
    times = asdict(budget) | {"bus_ns": budget.bus_ns}
    looks = times.pop("looks_ns")
    return {name.removesuffix("_ns") + "_us": _microseconds(t_ns) for name, t_ns in times.items()} | {
        "looks_us": [_microseconds(look) for look in looks]
    }


def _microseconds(t_ns: int | None) -> float | None:
    return None if t_ns is None else t_ns / 1000
