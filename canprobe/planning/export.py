"""The plan as JSON types, for `canprobe plan --json` and other tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from canprobe.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    CycleBudget,
    Demand,
    Plan,
    PlannedBus,
    PlannedNode,
    PlannedPdo,
)
from canprobe.planning.timeline import Slot, timeline

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
        "sync_response_us": _us(bus.traffic.sync_response_ns),
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
        "deadline_us": _us(pdo.deadline_ns),
        "response_us": _us(pdo.response_ns),
        "slack_us": _us(pdo.slack_ns),
        "event_timer_ms": pdo.event_timer_ms or None,
    }


def _slot(slot: Slot) -> dict[str, Any]:
    return {
        "part": slot.part,
        "channel": slot.channel or None,
        "cob_id": slot.cob_id,
        "cycle": slot.cycle,
        "start_us": _us(slot.start_ns),
        "end_us": _us(slot.end_ns),
    }


def _demand(demand: Demand) -> dict[str, Any]:
    return {
        "what": demand.what,
        "cycles": demand.cycles,
        "used_us": _us(demand.used_ns),
        "available_us": _us(demand.available_ns),
    }


def _budget(budget: CycleBudget) -> dict[str, Any]:
    """The cycle's budget in µs."""
    times = asdict(budget) | {"bus_ns": budget.bus_ns}
    looks = times.pop("looks_ns")
    return {name.removesuffix("_ns") + "_us": _us(t_ns) for name, t_ns in times.items()} | {
        "looks_us": [_us(look) for look in looks]
    }


def _us(t_ns: int | None) -> float | None:
    return None if t_ns is None else t_ns / 1000
