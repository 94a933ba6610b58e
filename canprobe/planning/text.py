"""The plan as people read it on a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from canprobe.planning.bridges import BRIDGES
from canprobe.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    Plan,
    PlannedNode,
    PlannedPdo,
)


def plan_text(plan: Plan) -> str:
    """The whole plan, ending with a newline."""
    return "\n".join(_lines(plan)) + "\n"


def _lines(plan: Plan) -> Iterator[str]:
    bus, sync = plan.scene.bus, plan.sync
    yield f"{plan.scene.name}: {plan.scene.title}" if plan.scene.title else plan.scene.name
    yield f"bus {bus.channel} ({bus.interface}), {bus.bitrate} bit/s"
    interpolation = f", 60C2h = {sync.interpolation_100us}·10⁻⁴ s" if sync.interpolation_100us is not None else ""
    yield (
        f"SYNC {sync.rate_hz:g} Hz (1006h = {sync.period_us} µs, 1019h = {sync.overflow}{interpolation}), "
        f"heartbeat every {HEARTBEAT_PRODUCED_MS} ms, lost after {HEARTBEAT_CONSUMED_MS} ms"
    )
    yield from _titled("nodes", _node_rows(plan.nodes))
    yield from _titled("PDOs, from the device's view, highest priority first", _pdo_rows(plan.pdos))
    yield from _titled("bus, worst case", list(_bus_rows(plan)))
    if plan.joint_speeds is not None:
        rows = [["joint", "needed", "allowed (deg/s)"]]
        speeds = zip(plan.joint_speeds.needed_deg_s, plan.joint_speeds.limit_deg_s, strict=True)
        rows += [[str(i), f"{needed:.1f}", f"{limit:g}"] for i, (needed, limit) in enumerate(speeds, start=1)]
        yield from _titled("joint speeds", rows)
    yield from _titled("uses", list(_use_rows(plan)))
    yield from _titled("leaves out", [list(row) for row in plan.left_out])
    if plan.not_available:
        yield from _titled("could not have", [list(row) for row in plan.not_available])


def _titled(title: str, rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield ""
    yield f"{title}:"
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def _node_rows(nodes: Sequence[PlannedNode]) -> list[list[str]]:
    rows = [["id", "role", "identity (vendor product revision)", "EDS", ""]]
    for node in nodes:
        identity = (node.identity.vendor_id, node.identity.product_code, node.identity.revision_number)
        numbers = " ".join("any" if number is None else f"{number:08X}h" for number in identity)
        rows.append([str(node.node_id), node.role, numbers, node.eds, "emulated" if node.emulated else "real"])
    return rows


def _pdo_rows(pdos: Sequence[PlannedPdo]) -> list[list[str]]:
    rows = [["COB-ID", "node", "PDO", "type", "Hz", "bytes", "bits", "response", "deadline µs", "content"]]
    for pdo in pdos:
        content = ", ".join(
            "dummy" if entry.is_dummy else f"{entry.index:04X}h:{entry.subindex:02X}" for entry in pdo.entries
        )
        rows.append(
            [
                f"{pdo.cob_id:03X}h",
                str(pdo.node_id),
                f"{pdo.direction.upper()}{pdo.number}",
                str(pdo.transmission_type),
                f"{pdo.rate_hz:g}",
                str(pdo.layout.length),
                str(pdo.bits_worst),
                _us(pdo.response_ns),
                _us(pdo.deadline_ns),
                content,
            ]
        )
    return rows


def _bus_rows(plan: Plan) -> Iterator[list[str]]:
    parts = ", ".join(f"{what} {100 * share:.1f} %" for what, share in plan.traffic.parts)
    yield ["load", f"{100 * plan.traffic.load:.1f} %", parts]
    for demand in plan.traffic.demands:
        cycles = f"{demand.cycles} cycle" + ("s" if demand.cycles > 1 else "")
        yield [
            f"in {cycles}",
            f"{100 * demand.used_ns / demand.available_ns:.1f} %",
            f"{demand.what}: {_us(demand.used_ns)} of {_us(demand.available_ns)} µs",
        ]


def _use_rows(plan: Plan) -> Iterator[list[str]]:
    yield ["task", plan.scene.task.kind]
    if plan.strategy is not None:
        yield ["strategy", plan.strategy]
    if plan.estimator is not None:
        also = f"; on the same data afterwards: {', '.join(plan.offline_estimators)}" if plan.offline_estimators else ""
        yield ["estimator", plan.estimator + also]
    if plan.fidelity is not None:
        emulated = ", ".join(map(str, plan.scene.emulated_node_ids))
        yield ["emulator", f"nodes {emulated}; arm {plan.fidelity}" if plan.scene.arm else f"nodes {emulated}"]
    for name in plan.scene.bridge.use if plan.scene.bridge is not None else ():
        yield ["bridge", f"{name}: {BRIDGES[name].what}; needs {', '.join(BRIDGES[name].packages)}"]
    yield ["outputs", ", ".join(plan.outputs)]


def _us(t_ns: int | None) -> str:
    return "unbounded" if t_ns is None else f"{t_ns / 1000:g}"
