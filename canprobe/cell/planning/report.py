"""The plan as text for a terminal, the verdict in some lines or with all tables below it, and as JSON types."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

from canprobe.cell.planning.array import array_text, support_of
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.contact import witness_rows
from canprobe.cell.planning.external_arm import arm_text
from canprobe.cell.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    CycleBudget,
    Plan,
    PlannedBus,
    PlannedPdo,
)
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.cell.planning.timeline import timeline, timeline_rows
from canprobe.cell.scene.geometry import mesh_text
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.protocol.pdo import PdoEntry
from canprobe.mechanics.touch.mesh_fit import MeshHeights
from canprobe.mechanics.touch.servo import TARGET_RATES
from canprobe.mechanics.touch.stops import depth_on_bluntest

MIN_CHARACTERS = 40
"""Least length of a line: no line is broken before it."""
ALL_TABLES = "--full prints all tables"
OUTPUT_COSTS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "truth": ("truth.npz", {"direct": "3 % of a cycle", "lockstep": "1 % of a cycle"}),
    "surface_map": ("surface.npz", {"direct": "2 % of a cycle", "lockstep": "1 % of a cycle"}),
    "bus_log": ("bus.log", {"lockstep": "3 % of a cycle"}),
    "figures": ("report.png", {"": "1 to 2 s after the run"}),
}
"""File of each output, and its cost by bus: the share of the processor time of a cycle of `cylinder` that is saved
without it, by cells that took their cycles in turn, to one percent (2026-11-29, on 44c3a72a)."""


def verdict_text(plan: Plan, width: int | None = None) -> str:
    """The verdict with all warnings, ending with a newline.

    Args:
        plan: the plan.
        width: characters after which a line is broken; None: lines stay whole.
    """
    return _broken((*_verdict(plan), ALL_TABLES), _room(width), lambda _: 13)


def _room(width: int | None) -> int | None:
    return None if width is None else max(width, MIN_CHARACTERS)


def _broken(lines: Iterable[str], width: int | None, indent: Callable[[str], int]) -> str:
    """Lines in parts of a width, the later ones of each indented."""
    parts: list[str] = []
    for line in lines:
        fits = width is None or len(line) <= width
        parts += [line] if fits else textwrap.wrap(line, width or 0, subsequent_indent=" " * indent(line))
    return "\n".join(parts) + "\n"


def _verdict(plan: Plan) -> Iterator[str]:
    yield f"{plan.setup.name}{f': {plan.setup.title}' if plan.setup.title else ''}"
    for subject, text in _subjects(plan):
        yield f"  {subject:<11}{text}"


def _subjects(plan: Plan) -> Iterator[tuple[str, str]]:
    bus = plan.setup.bus
    channels = " and ".join(one.channel for one in plan.buses)
    yield "fits", f"on {channels} ({bus.interface}), {bus.bitrate} bit/s, {plan.sync.rate_hz:g} Hz"
    yield "nodes", _nodes(plan)
    if external := arm_text(plan.setup):
        yield "arm", external
    yield "load", _load(plan)
    if witnesses := witness_rows(plan):
        yield "witnesses", _witnesses(witnesses)
    yield "left out", f"{len(plan.left_out)}: {'; '.join(what for what, _ in plan.left_out)}"
    for choice in plan.choices:
        yield "chosen", f"{choice.key} = {choice.written}: {choice.why}"
    for what, why in plan.not_available:
        yield "lacks", f"{what}: {why}"
    for warning in plan.warnings:
        yield "warning", warning


def _nodes(plan: Plan) -> str:
    """The nodes by kind with their ids, and which of them are real."""
    drives, encoders, arrays = (
        [n.node_id for n in plan.nodes if n.kind == kind] for kind in ("drive", "encoder", "tactile")
    )
    found = []
    if drives:
        found.append(f"{len(drives)} drive{'s' * (len(drives) > 1)} ({id_ranges(drives)})")
    if encoders:
        found.append(f"encoder of the carrier ({id_ranges(encoders)})")
    if arrays:
        found.append(f"tactile array ({id_ranges(arrays)})")
    if plan.raw:
        found.append("array without a node id")
    real = [node.node_id for node in plan.nodes if not node.emulated]
    emulated = "all emulated" if not real else "none emulated" if len(real) == len(plan.nodes) else None
    return f"{', '.join(found) or 'none'}; {emulated or f'real: {id_ranges(real)}, the others emulated'}"


def _load(plan: Plan) -> str:
    """The worst-case load, and where the least time is left: in a cycle, and before the deadline of a frame."""
    several = len(plan.buses) > 1
    loads = " and ".join(f"{100 * b.load:.1f} %{f' on {b.channel}' * several}" for b in plan.buses)
    budget = plan.budget
    parts = [f"{loads} at worst"]
    if budget.slack_ns is not None:
        parts.append(f"{budget.slack_ns / 1000:g} of {budget.period_ns / 1000:g} µs are left in a cycle")
    bounded = [(pdo.slack_ns, pdo) for pdo in plan.pdos if pdo.slack_ns is not None]
    if bounded:
        slack_ns, pdo = min(bounded, key=lambda one: one[0])
        parts.append(f"the tightest frame, {pdo.cob_id:03X}h, is {slack_ns / 1000:g} µs before its deadline")
    return "; ".join(parts)


def _witnesses(rows: Sequence[tuple[str, str]]) -> str:
    """The witnesses that watch the force beside the array, and those that do not."""
    silent = [name for name, text in rows if text.startswith(("silent", "none"))]
    watching = ", ".join(name for name, _ in rows if name not in silent) or "none"
    return watching + (f"; silent: {', '.join(silent)}" if silent else "")


def id_ranges(ids: Iterable[int]) -> str:
    """Node ids as `1–6, 16`."""
    steps = itertools.count()
    runs = [[*run] for _, run in itertools.groupby(sorted(ids), key=lambda one: one - next(steps))]
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)


TIMELINE_WIDTH = 100
"""Longest row of the timeline, characters of one cycle."""
_BESIDE_TIMELINE, _NARROW, _LAST = 24, 8, 12


def plan_text(plan: Plan, width: int | None = None) -> str:
    """The whole plan, ending with a newline.

    Args:
        plan: the plan.
        width: characters after which a line is broken; None: lines stay whole.
    """
    return _broken(_lines(plan, _room(width)), _room(width), lambda line: 2 + len(line) - len(line.lstrip()))


def _lines(plan: Plan, width: int | None) -> Iterator[str]:
    bus, sync = plan.setup.bus, plan.sync
    yield from _verdict(plan)
    yield ""
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
    yield from _titled("nodes", _node_rows(plan), width)
    yield from _titled("PDOs, from the device's view, highest priority first", _pdo_rows(plan), width)
    yield from _titled("raw frames of the array, which is no CANopen node", _raw_rows(plan), width)
    for one in plan.buses:
        yield from _titled(f"bus {one.channel}, worst case", _bus_rows(one), width)
    title = f"one cycle of {_us(sync.period_ns)} µs, worst case, µs after its SYNC is due"
    yield from _titled(title, _budget_rows(plan.budget), width)
    characters = TIMELINE_WIDTH if width is None else min(TIMELINE_WIDTH, width - _BESIDE_TIMELINE)
    each = f"as it goes, worst-case lengths, one character {_us(sync.period_ns // characters)} µs"
    other = "" if all(pdo.used for pdo in plan.pdos) else ", o not used"
    parts = f"(S SYNC, f feedback, C controller, r commands, t tactile{other})"
    yield from _titled(f"{each} {parts}", timeline_rows(plan, characters), width)
    yield from _titled("chosen by the plan", ((f"{one.key} = {one.written}", one.why) for one in plan.choices), width)
    yield from _titled("joint speeds", _speed_rows(plan), width)
    yield from _titled("witnesses of the force beside the array", witness_rows(plan), width)
    yield from _titled("uses", _use_rows(plan), width)
    yield from _titled("outputs, and what each of them costs", output_rows(plan), width)
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
        yield [str(node.node_id), node.name, numbers, node.eds, kind, *[node.channel] * several]


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
    """The objects of a mapping; a row of neighbours is its first and last."""
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


def _bus_rows(bus: PlannedBus) -> Iterator[list[str]]:
    parts = ", ".join(f"{what} {100 * share:.1f} %" for what, share in bus.parts)
    yield ["load", f"{100 * bus.load:.1f} %", parts]
    for demand in bus.demands:
        cycles = f"{demand.cycles} cycle" + ("s" if demand.cycles > 1 else "")
        yield [
            f"in {cycles}",
            f"{100 * demand.share:.1f} %",
            f"{demand.what}: {_us(demand.used_ns)} of {_us(demand.available_ns)} µs",
        ]


def _budget_rows(budget: CycleBudget) -> Iterator[list[str]]:
    """Time of each part of the cycle after the SYNC."""
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
    if isinstance(setup.truth.object, MeshHeights):
        yield ["object", mesh_text(setup.truth.object.fit)]
    if (scan := setup.scan) is not None:
        yield ["strategy", scan.name]
    for name, table in setup.touch.tables.items() if setup.touch is not None else ():
        what, unit, si = {"target_force_n": ("force", "N", 1.0), "speed_m_s": ("speed", "mm/s", 1e-3)}[name]
        low, high, over = table.lowest / si, table.values.max() / si, "path" if table.over_path else "time"
        most = f"{TARGET_RATES[name] / si:g} {unit}/s".replace("/s/s", "/s²")
        yield [what, f"{low:.3g} to {high:.3g} {unit} over the {over}, changed by {most} at most"]
    if (shape := setup.shape) is not None:
        also = f"; on the same data afterwards: {', '.join(shape.also)}" if shape.also else ""
        yield ["estimator", shape.method + also]
    if setup.emulates:
        ids = ", ".join(str(node.node_id) for node in plan.nodes if node.emulated)
        nodes = f"nodes {ids}" if ids else ""
        raw = "the array" if setup.array is not None and setup.array.raw is not None and setup.array.emulated else ""
        emulated = " and ".join(filter(None, (nodes, raw)))
        yield ["emulator", f"{emulated}; arm {setup.truth.fidelity}" if setup.arm is not None else emulated]
    for name in setup.bridge.use:
        yield ["bridge", f"{name}: {BRIDGES[name].what}; needs {', '.join(BRIDGES[name].packages)}"]
    yield ["outputs", ", ".join(plan.outputs)]


def output_rows(plan: Plan) -> Iterator[tuple[str, str, str]]:
    """Name, cost and file of each output that the cell can have; the key of one that is off, in the cost's place."""
    bus = plan.setup.bus.interface
    for name, (file, costs) in OUTPUT_COSTS.items():
        if file in plan.outputs:
            yield name, costs.get(bus) or costs.get("", f"not measured on {bus}"), file
        elif not getattr(plan.setup.outputs, name):
            yield name, f"off: outputs.{name} = false", file


def _measured(setup: Setup) -> str:
    """The quantities of the task's contact that the array measures, in words."""
    support, array = support_of(setup), setup.array
    assert support is not None and array is not None
    if setup.touch is None:
        return f"it measures {support}"
    if array.pad.is_flat:
        force, reach = setup.touch.force, array.pad.reach_m
        bluntest = reach**2 / (2.0 * depth_on_bluntest(force, setup.probe.stiffness, reach))
        fits = f"its patch at {force:g} N fits on what is rounder than a ball of {1e3 * bluntest:.2g} mm radius"
        return f"it measures {support}; {fits}"
    return f"at {setup.touch.least_force:g} N on a plane about {support.taxels:.0f} taxels are pressed: {support}"


def _us(t_ns: int | None) -> str:
    return "unbounded" if t_ns is None else f"{t_ns / 1000:g}"


SCHEMA = 1


def plan_dict(plan: Plan) -> dict[str, Any]:
    """The plan in JSON types; a field that does not apply is None."""
    setup, bus, shape = plan.setup, plan.setup.bus, plan.setup.shape
    return {
        "schema": SCHEMA,
        "scene": setup.name,
        "fits": True,
        "title": setup.title,
        "bus": _picked(bus, "interface", "channel", "bitrate", "transmit_queue", "fd")
        | {"data_bitrate": bus.data_bitrate if bus.fd else None},
        "sync": asdict(plan.sync),
        "heartbeat": {
            "master_node_id": MASTER_NODE_ID,
            "produced_ms": HEARTBEAT_PRODUCED_MS,
            "consumed_ms": HEARTBEAT_CONSUMED_MS,
        },
        "nodes": [_node(node) for node in plan.nodes],
        "pdos": [_pdo(pdo) for pdo in plan.pdos],
        "raw_frames": [_picked(frames) for frames in plan.raw],
        "array": _array(setup),
        "object": _mesh(setup),
        "bus_load": {one.channel: _bus(one, plan.budget) for one in plan.buses},
        "choices": [{"key": one.key, "value": one.written, "why": one.why} for one in plan.choices],
        "timeline": [_picked(slot) | {"channel": slot.channel or None} for slot in timeline(plan)],
        "joint_speeds": asdict(plan.joint_speeds) if plan.joint_speeds is not None else None,
        "external_arm": arm_text(setup) or None,
        "witnesses": dict(witness_rows(plan)),
        "estimator": shape.method if shape is not None else None,
        "offline_estimators": list(shape.also) if shape is not None else [],
        "strategy": setup.scan.name if setup.scan is not None else None,
        "fidelity": setup.truth.fidelity if setup.emulates else None,
        "bridges": list(setup.bridge.use),
        "outputs": list(plan.outputs),
        "output_costs": {name: cost for name, cost, _ in output_rows(plan)},
        "left_out": [{"what": what, "why": why} for what, why in plan.left_out],
        "not_available": [{"what": what, "why": why} for what, why in plan.not_available],
        "warnings": list(plan.warnings),
    }


def refused_dict(name: str, problems: Sequence[str], ways_out: Sequence[str]) -> dict[str, Any]:
    """The answer for a scene that does not fit: its problems and the ways out."""
    return {
        "schema": SCHEMA,
        "scene": name,
        "fits": False,
        "problems": list(problems),
        "ways_out": list(ways_out),
    }


def _bus(bus: PlannedBus, budget: CycleBudget) -> dict[str, Any]:
    return {
        "node_ids": list(bus.node_ids),
        "planned_worst": bus.load,
        "parts": dict(bus.parts),
        "demands": [_picked(demand) for demand in bus.demands],
        **_picked(bus, "sync_response_ns"),
        "budget": _picked(budget) | _picked(budget, "bus_ns"),
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


def _mesh(setup: Setup) -> dict[str, Any] | None:
    """The mesh that is the object, and the surface fitted to it; None for any other object."""
    if not isinstance(setup.truth.object, MeshHeights):
        return None
    fit = setup.truth.object.fit
    error = fit.curvature
    return asdict(fit.state) | {
        "spacing_mm": 1e3 * fit.spacing,
        "curvature_error_per_m": None if error is None else error.error,
        "curvature_per_m": None if error is None else error.curvature,
    }


def _node(node: NodeConfiguration) -> dict[str, Any]:
    return {
        **_picked(node, "node_id", "kind"),
        "role": node.name,
        "eds": node.eds,
        "identity": asdict(node.identity),
        **_picked(node, "emulated", "channel"),
        "switched_off": [{"direction": way, "number": number} for way, number in node.switched_off],
        "mode": node.mode,
        "interpolation": [asdict(period) for period in node.interpolation],
    }


def _pdo(pdo: PlannedPdo) -> dict[str, Any]:
    return {
        **_picked(pdo, "node_id", "channel", "direction", "number", "cob_id"),
        "entries": [_picked(entry, "index", "subindex", "bits", "name") for entry in pdo.entries],
        **_picked(pdo, "transmission_type", "rate_hz"),
        "bytes": pdo.layout.length,
        **_picked(pdo, "bits_worst", "deadline_ns", "response_ns", "slack_ns"),
        "event_timer_ms": pdo.event_timer_ms or None,
        "used": pdo.used,
    }


def _picked(part: Any, *names: str) -> dict[str, Any]:
    """Some values of a part of the plan, or all its fields; times in µs: `start_ns` becomes `start_us`."""
    found: dict[str, Any] = {}
    for name in names or [item.name for item in fields(part)]:
        value = getattr(part, name)
        if name.endswith("_ns") and value is not None:
            value = [t_ns / 1000 for t_ns in value] if isinstance(value, tuple) else value / 1000
        found[re.sub("_ns$", "_us", name)] = value
    return found
