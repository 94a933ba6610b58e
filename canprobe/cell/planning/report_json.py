"""The plan as JSON types, for `canprobe plan --json` and other tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any

from canprobe.cell.planning.array import support_of
from canprobe.cell.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    Plan,
    PlannedBus,
    PlannedNode,
    PlannedPdo,
)
from canprobe.cell.planning.timeline import timeline
from canprobe.cell.planning.witnesses import witness_rows
from canprobe.cell.scene.setup import Setup
from canprobe.mechanics.touch.mesh_fit import MeshHeights

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
        "raw_frames": [_in_us(asdict(frames)) for frames in plan.raw],
        "array": _array(setup),
        "object": _mesh(setup),
        "bus_load": {one.channel: _bus(one) for one in plan.buses},
        "choices": [{"key": one.key, "value": one.written, "why": one.why} for one in plan.choices],
        "timeline": [_in_us(asdict(slot)) | {"channel": slot.channel or None} for slot in timeline(plan)],
        "joint_speeds": asdict(plan.joint_speeds) if plan.joint_speeds is not None else None,
        "witnesses": dict(witness_rows(plan)),
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
    """The answer for a scene that does not fit: its problems and the ways out."""
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


def _node(node: PlannedNode) -> dict[str, Any]:
    """A node without its dictionary, which is as large as its EDS."""
    return _picked(node, *(item.name for item in fields(node) if item.name != "dictionary")) | {
        "identity": asdict(node.identity),
        "switched_off": [{"direction": way, "number": number} for way, number in node.switched_off],
        "interpolation": [asdict(period) for period in node.interpolation],
    }


def _pdo(pdo: PlannedPdo) -> dict[str, Any]:
    return _picked(pdo, "node_id", "channel", "direction", "number", "cob_id") | {
        "entries": [_picked(entry, "index", "subindex", "bits", "name") for entry in pdo.entries],
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


def _picked(part: object, *names: str) -> dict[str, Any]:
    return {name: getattr(part, name) for name in names}


def _in_us(values: dict[str, Any]) -> dict[str, Any]:
    """The values with times in µs: `start_ns` becomes `start_us`."""
    return {
        f"{name.removesuffix('_ns')}_us" if name.endswith("_ns") else name: (
            _microseconds(value) if name.endswith("_ns") else value
        )
        for name, value in values.items()
    }


def _microseconds(t_ns: Any) -> Any:
    return None if t_ns is None else [t / 1000 for t in t_ns] if isinstance(t_ns, tuple) else t_ns / 1000
