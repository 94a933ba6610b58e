"""The plan as people read it on a terminal."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from canprobe.planning.bridges import BRIDGES
from canprobe.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    CycleBudget,
    Plan,
    PlannedNode,
    PlannedPdo,
    Traffic,
)
from canprobe.planning.timeline import timeline_rows
from canprobe.protocol.pdo import PdoEntry

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
