"""The plan as people read it on a terminal, as a timeline of its cycles, and as JSON types."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from heapq import heappop, heappush
from typing import Any, Literal

from canprobe.cell.planning.array import array_text, support_of
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    CycleBudget,
    Plan,
    PlannedBus,
    PlannedNode,
    PlannedPdo,
    Traffic,
)
from canprobe.cell.planning.traffic import SYNC_BITS, SYNCHRONOUS, on_the_wire, wire_ns
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.protocol.frames import SYNC_ID
from canprobe.fieldbus.protocol.pdo import PdoEntry

# The cycles of a plan as they go when every frame takes its worst-case length and nobody else speaks.
#
# SYNC opens a cycle, the nodes queue what it triggers, the controller starts at the first look that finds all feedback,
# its commands follow. Heartbeats and what comes on events are left out: the worst case, with all of them, is the
# response time of each message.

Part = Literal["SYNC", "feedback", "controller", "command", "tactile", "other"]
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


def timeline(plan: Plan) -> tuple[Slot, ...]:
    """As many cycles as the slowest frame behind SYNC has, two with a sensor as a rule.

    Args:
        plan: that fits.

    Returns:
        Frames and controller by start; those of the last cycles may end behind it.
    """
    cyclic = [pdo for pdo in plan.pdos if pdo.transmission_type <= SYNCHRONOUS]
    cycles = max((pdo.transmission_type for pdo in cyclic), default=1)
    period, compute = plan.sync.period_ns, plan.traffic.budget.compute_ns
    starts: list[int | None] = [None] * cycles
    slots: list[Slot] = []
    for _ in range(_ROUNDS):  # when the commands go depends on the feedback, which earlier commands may delay
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
    looks = [begin + look for look in plan.traffic.budget.looks_ns]
    return next((look for look in looks if look >= last), looks[-1])


def _released(
    plan: Plan, bus: PlannedBus, cyclic: Sequence[PlannedPdo], starts: Sequence[int | None]
) -> Iterator[Slot]:
    """Every frame of one bus as if it were alone on it."""
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
                    out = start + plan.traffic.budget.compute_ns
                    yield Slot("command", bus.channel, pdo.cob_id, cycle, out, out + length)
            elif cycle % pdo.transmission_type == 0:
                part: Part = "tactile" if pdo.kind == "tactile" else "feedback" if pdo.used else "other"
                yield Slot(part, bus.channel, pdo.cob_id, cycle, begin + sync_ns, begin + sync_ns + length)


def _carried(released: Iterator[Slot]) -> Iterator[Slot]:
    """Frames one by one: of those that wait, the lowest identifier."""
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
"""What stands for each part in `timeline_rows`."""


def timeline_rows(plan: Plan, width: int = 80) -> list[list[str]]:
    """A row for each bus and cycle, and for the controller; one character is a `width`-th of the period.

    Args:
        plan: that fits.
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


# The plan as people read it on a terminal.

TIMELINE_WIDTH = 100
"""Characters of a cycle."""
NARROWEST = 40
"""Characters below which no line is broken."""
_BESIDE_TIMELINE, _NARROW, _LAST = 24, 8, 12


def plan_text(plan: Plan, width: int | None = None) -> str:
    """The whole plan, ending with a newline.

    Args:
        plan: that fits.
        width: characters of a line, which are broken there; None: lines stay whole.
    """
    room = None if width is None else max(width, NARROWEST)
    lines = (part for line in _lines(plan, room) for part in _broken(line, room))
    return "\n".join(lines) + "\n"


def _broken(line: str, width: int | None) -> list[str]:
    """A line in parts of a width, the later ones indented."""
    if width is None or len(line) <= width:
        return [line]
    return textwrap.wrap(line, width, subsequent_indent=" " * (len(line) - len(line.lstrip()) + 2))


def _lines(plan: Plan, width: int | None) -> Iterator[str]:
    bus, sync = plan.setup.bus, plan.sync
    yield f"{plan.setup.name}: {plan.setup.title}" if plan.setup.title else plan.setup.name
    channels = " and ".join(one.channel for one in plan.buses)
    yield f"bus {channels} ({bus.interface}), {bus.bitrate} bit/s"
    if bus.fd:
        yield (
            f"CAN FD frames above 8 bytes, their data at {bus.data_bitrate} bit/s and counted in bits of "
            f"{bus.bitrate} bit/s; everything else classical; every controller on the bus must tolerate CAN FD, which "
            "no EDS states"
        )
    times = " or ".join(dict.fromkeys(str(node.interpolation[0]) for node in plan.nodes if node.interpolation))
    interpolation = f", 60C2h = {times}" if times else ""
    yield (
        f"SYNC {sync.rate_hz:g} Hz (1006h = {sync.period_us} µs, 1019h = {sync.overflow}{interpolation}), "
        f"heartbeat every {HEARTBEAT_PRODUCED_MS} ms, lost after {HEARTBEAT_CONSUMED_MS} ms"
    )
    if bus.transmit_queue == "fifo":
        yield 'bus.transmit_queue = "fifo": nodes send their oldest frame first; a heartbeat delays what follows it'
    yield from (f"warning: {warning}" for warning in plan.warnings)
    yield from _titled("nodes", _node_rows(plan), width)
    yield from _titled("PDOs, from the device's view, highest priority first", _pdo_rows(plan), width)
    yield from _titled("raw frames of the array, which is no CANopen node", _raw_rows(plan), width)
    for one in plan.buses:
        yield from _titled(f"bus {one.channel}, worst case", _bus_rows(one.traffic), width)
    title = f"one cycle of {_us(sync.period_ns)} µs, worst case, µs after its SYNC is due"
    yield from _titled(title, _budget_rows(plan.traffic.budget), width)
    characters = TIMELINE_WIDTH if width is None else min(TIMELINE_WIDTH, width - _BESIDE_TIMELINE)
    each = f"as it goes, worst-case lengths, one character {_us(sync.period_ns // characters)} µs"
    other = "" if all(pdo.used for pdo in plan.pdos) else ", o not used"
    parts = f"(S SYNC, f feedback, C controller, r commands, t tactile{other})"
    yield from _titled(f"{each} {parts}", timeline_rows(plan, characters), width)
    yield from _titled("chosen by the plan", ((f"{one.key} = {one.value}", one.why) for one in plan.choices), width)
    yield from _titled("joint speeds", _speed_rows(plan), width)
    yield from _titled("uses", _use_rows(plan), width)
    yield from _titled("leaves out", plan.left_out, width)
    yield from _titled("could not have", plan.not_available, width)


def _titled(title: str, rows: Iterable[Sequence[str]], width: int | None = None) -> Iterator[str]:
    """A table with its title; numbers, and a time without a bound, at the right; nothing without rows.

    Where it is wider than `width` its widest columns are broken, and the last one is set below where little is left.
    """
    if not (rows := list(rows)):
        return
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    number = re.compile(r"-?[\d.]+( %)?|unbounded")
    numeric = [len(rows) > 1 and all(map(number.fullmatch, column[1:])) for column in columns]
    yield from ("", f"{title}:")
    below = width is not None and sum(widths) + 2 * len(widths) > width < sum(widths[:-1]) + 2 * len(widths) + _LAST
    if below:
        widths.pop()
    while width is not None and sum(widths) + 2 * len(widths) > width and max(widths) > _NARROW:
        widths[widths.index(max(widths))] -= 1
    for row in rows:
        broken = [textwrap.wrap(cell, wide) or [""] for cell, wide in zip(row, widths, strict=False)]
        for line in itertools.zip_longest(*broken, fillvalue=""):
            cells = zip(line, widths, numeric, strict=False)
            yield "  " + "  ".join(f"{cell:{'>' if right else '<'}{wide}}" for cell, wide, right in cells).rstrip()
        if below and row[-1]:
            yield "      " + row[-1]


def _node_rows(plan: Plan) -> Iterator[list[str]]:
    several = len(plan.buses) > 1
    if not plan.nodes:
        return
    yield ["id", "role", "identity (vendor product revision)", "EDS", "", *["bus"] * several]
    for node in plan.nodes:
        numbers = " ".join("any" if number is None else f"{number:08X}h" for number in node.identity.numbers[:3])
        if node.identity.serial_number is not None:
            numbers += f" serial {node.identity.serial_number:08X}h"
        kind = "emulated" if node.emulated else "real"
        yield [str(node.node_id), node.role, numbers, node.eds, kind, *[node.channel] * several]


def _pdo_rows(plan: Plan) -> Iterator[list[str]]:
    several = len(plan.buses) > 1
    if not plan.pdos:
        return
    times = ["response µs", "deadline µs", "slack µs"]
    yield [*["bus"] * several, "COB-ID", "node", "PDO", "type", "Hz", "bytes", "bits", *times, "content"]
    for pdo in plan.pdos:
        name = [f"{pdo.cob_id:03X}h", str(pdo.node_id), f"{pdo.direction.upper()}{pdo.number}"]
        frame = [str(pdo.transmission_type), f"{pdo.rate_hz:g}", str(pdo.layout.length), str(pdo.bits_worst)]
        times = [_us(pdo.response_ns), _us(pdo.deadline_ns), _us(pdo.slack_ns)]
        content = _content(pdo.entries) if pdo.used else f"not used: {_content(pdo.entries)}"
        yield [*[pdo.channel] * several, *name, *frame, *times, content]


def _raw_rows(plan: Plan) -> Iterator[list[str]]:
    several = len(plan.buses) > 1
    if plan.raw:
        yield [*["bus"] * several, "id", "sent by", "what", "frames", "bytes", "Hz", "bits", "response µs"]
    for one in plan.raw:
        sender, repeats = "master" if one.sent else "array", one.rate_hz > 0
        response = _us(one.response_ns) if repeats else ""
        frame = [str(one.count), str(one.length), f"{one.rate_hz:g}" if repeats else "", str(one.bits_worst)]
        yield [*[one.channel] * several, f"{one.can_id:03X}h", sender, one.what, *frame, response]


def _speed_rows(plan: Plan) -> Iterator[list[str]]:
    if (speeds := plan.joint_speeds) is not None:
        yield ["joint", "needed", "allowed", "unit"]
        rows = zip(speeds.needed, speeds.limit, speeds.units, strict=True)
        for number, (needed, limit, unit) in enumerate(rows, start=1):
            yield [str(number), f"{needed:.1f}", f"{limit:g}", unit]


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
    setup = plan.setup
    yield ["task", setup.kind]
    if setup.array is not None:
        yield ["array", f"{array_text(setup.array)}; {_measured(setup)}"]
    if (scan := setup.scan) is not None:
        yield ["strategy", scan.name]
    if (shape := setup.shape) is not None:
        also = f"; on the same data afterwards: {', '.join(shape.also)}" if shape.also else ""
        yield ["estimator", shape.method + also]
    if setup.emulates:
        nodes = f"nodes {', '.join(map(str, setup.emulated_node_ids))}" if setup.emulated_node_ids else ""
        raw = "the array" if setup.array is not None and setup.array.raw is not None and setup.array.emulated else ""
        emulated = " and ".join(filter(None, (nodes, raw)))
        yield ["emulator", f"{emulated}; arm {setup.truth.fidelity}" if setup.arm is not None else emulated]
    for name in setup.bridge.use:
        yield ["bridge", f"{name}: {BRIDGES[name].what}; needs {', '.join(BRIDGES[name].packages)}"]
    yield ["outputs", ", ".join(plan.outputs)]


def _measured(setup: Setup) -> str:
    """What the array measures of the task's contact."""
    support, array = support_of(setup), setup.array
    assert support is not None and array is not None
    if setup.touch is None or array.pad.is_flat:
        return f"it measures {support}"
    return f"at {setup.touch.force:g} N on a plane about {support.taxels:.0f} taxels are pressed: {support}"


def _us(t_ns: int | None) -> str:
    return "unbounded" if t_ns is None else f"{t_ns / 1000:g}"


# The plan as JSON types, for `canprobe plan --json` and other tools.

SCHEMA = 1


def plan_dict(plan: Plan) -> dict[str, Any]:
    """Every field of the plan; what does not apply is None."""
    setup, bus, shape = plan.setup, plan.setup.bus, plan.setup.shape
    return {
        "schema": SCHEMA,
        "scene": setup.name,
        "fits": True,
        "title": setup.title,
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
        "raw_frames": [_in_us(asdict(frames)) for frames in plan.raw],
        "array": _array(setup),
        "bus_load": {one.channel: _bus(one) for one in plan.buses},
        "choices": [asdict(choice) for choice in plan.choices],
        "timeline": [_in_us(asdict(slot)) | {"channel": slot.channel or None} for slot in timeline(plan)],
        "joint_speeds": asdict(plan.joint_speeds) if plan.joint_speeds is not None else None,
        "estimator": shape.method if shape is not None else None,
        "offline_estimators": list(shape.also) if shape is not None else [],
        "strategy": setup.scan.name if setup.scan is not None else None,
        "fidelity": setup.truth.fidelity if setup.emulates else None,
        "bridges": list(setup.bridge.use),
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
    traffic, budget = bus.traffic, bus.traffic.budget
    return {
        "node_ids": list(bus.node_ids),
        "planned_worst": traffic.load,
        "parts": dict(traffic.parts),
        "demands": [_in_us(asdict(demand)) for demand in traffic.demands],
        "sync_response_us": _microseconds(traffic.sync_response_ns),
        "budget": _in_us(asdict(budget) | {"bus_ns": budget.bus_ns}),
    }


def _array(setup: Setup) -> dict[str, Any] | None:
    """The array and what it supports; None without one."""
    array, support = setup.array, support_of(setup)
    if array is None or support is None:
        return None
    pad, radius = array.pad, array.pad.mount_radius_m
    return {
        "name": array.name,
        "rows": pad.rows,
        "columns": pad.columns,
        "pitch_mm": 1e3 * pad.pitch_m,
        "mount_radius_mm": None if radius is None else 1e3 * radius,
        "rate_hz": array.rate_hz,
        "taxels_pressed": support.taxels if setup.touch is not None else None,
        "supports": {"force": True, "centroid": support.centroid, "curvature": support.curvature},
    }


def _node(node: PlannedNode) -> dict[str, Any]:
    """A node without its dictionary, which is as large as its EDS."""
    return {item.name: getattr(node, item.name) for item in fields(node) if item.name != "dictionary"} | {
        "identity": asdict(node.identity),
        "switched_off": [{"direction": way, "number": number} for way, number in node.switched_off],
        "interpolation": [asdict(period) for period in node.interpolation],
    }


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
        "used": pdo.used,
    }


def _in_us(values: dict[str, Any]) -> dict[str, Any]:
    """The same with its times in µs: `start_ns` becomes `start_us`."""
    return {
        f"{name.removesuffix('_ns')}_us" if name.endswith("_ns") else name: (
            _microseconds(value) if name.endswith("_ns") else value
        )
        for name, value in values.items()
    }


def _microseconds(t_ns: Any) -> Any:
    return None if t_ns is None else [t / 1000 for t in t_ns] if isinstance(t_ns, tuple) else t_ns / 1000
