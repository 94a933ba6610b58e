"""`make_plan`: everything that follows from a scene, or every reason why it cannot be carried out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from canprobe.errors import EdsError, PlanError
from canprobe.planning.abilities import Abilities
from canprobe.planning.bridges import unavailable_bridges
from canprobe.planning.cycle import plan_ratio, plan_sync
from canprobe.planning.left_out import left_out, outputs
from canprobe.planning.model import Direction, NodeKind, Plan, PlannedNode, PlannedPdo, SyncPlan, Traffic
from canprobe.planning.needs import missing_objects
from canprobe.planning.pdos import PdoPlanning, identifier_problems, plan_drive_pdos, plan_tactile_pdos
from canprobe.planning.reach import check_motion
from canprobe.planning.traffic import plan_traffic
from canprobe.planning.ways_out import ways_out
from canprobe.scene import Scene


def make_plan(scene: Scene) -> Plan:
    """Derive the plan of a scene.

    Args:
        scene: as `load_scene` gave it.

    Returns:
        Nodes, PDOs, bus load, what is left out and why.

    Raises:
        PlanError: with every reason why the scene does not fit, its numbers and the ways out.
    """
    devices, problems = _devices(scene)
    bus = _plan_bus(scene, devices) if not problems else None
    if bus is not None:
        problems += bus.problems
        if bus.overload:
            known = frozenset(bus.problems)
            ways = ways_out(scene, lambda changed: _fits(changed, devices, known))
            problems += [*bus.overload[:-1], f"{bus.overload[-1]}; ways out: {ways}"]
    joint_speeds, unreachable = check_motion(scene)
    problems += unreachable
    if problems or bus is None:
        raise PlanError(problems)
    return Plan(
        scene=scene,
        nodes=_nodes(scene, devices, bus.pdos),
        pdos=bus.pdos,
        sync=bus.sync,
        traffic=bus.traffic,
        joint_speeds=joint_speeds,
        estimator=scene.shape.method if scene.shape is not None else None,
        offline_estimators=scene.shape.also if scene.shape is not None else (),
        strategy=scene.task.strategy if scene.task.kind == "scan" else None,
        fidelity=scene.plant.fidelity if scene.plant is not None and scene.emulated_node_ids else None,
        outputs=outputs(scene),
        left_out=left_out(scene),
        not_available=(*bus.not_available, *unavailable_bridges(scene)),
    )


@dataclass(frozen=True, slots=True)
class _BusPlan:
    """The bus part of a plan; `problems` are wrong whatever the bit rate, `overload` does not fit it."""

    sync: SyncPlan
    pdos: tuple[PlannedPdo, ...]
    traffic: Traffic
    problems: list[str]
    overload: list[str]
    not_available: tuple[tuple[str, str], ...]


def _plan_bus(scene: Scene, devices: Mapping[int, Abilities]) -> _BusPlan:
    sync, problems = plan_sync(scene)
    ratio, found = plan_ratio(scene)
    planning = PdoPlanning(problems=[*problems, *found])
    plan_drive_pdos(planning, scene, sync, devices)
    if scene.sensor is not None:
        plan_tactile_pdos(planning, scene, sync, ratio, devices[scene.sensor.node_id])
    planning.problems += identifier_problems(planning.pdos)
    traffic, pdos, overload = plan_traffic(planning.pdos, sync, _node_ids(scene), scene.bus)
    return _BusPlan(sync, tuple(pdos), traffic, planning.problems, overload, tuple(planning.not_available))


def _fits(scene: Scene, devices: Mapping[int, Abilities], known: frozenset[str]) -> Traffic | None:
    """The traffic of a changed scene if it fits and brings no problem that is not known already."""
    bus = _plan_bus(scene, devices)
    return None if bus.overload or not known.issuperset(bus.problems) else bus.traffic


def _node_ids(scene: Scene) -> tuple[int, ...]:
    arm = scene.arm.node_ids if scene.arm is not None else ()
    sensor = (scene.sensor.node_id,) if scene.sensor is not None else ()
    return tuple(sorted((*arm, *sensor)))


def _devices(scene: Scene) -> tuple[dict[int, Abilities], list[str]]:
    """The EDS of every node, and what is missing in them; each file is read once."""
    devices: dict[int, Abilities] = {}
    problems: list[str] = []
    wanted: list[tuple[NodeKind, str, tuple[int, ...]]] = []
    if scene.arm is not None:
        wanted.append(("drive", scene.arm.eds, scene.arm.node_ids))
    if scene.sensor is not None:
        wanted.append(("tactile", scene.sensor.eds, (scene.sensor.node_id,)))
    for kind, eds, node_ids in wanted:
        try:
            device = Abilities.of(eds, node_ids[0])
        except EdsError as error:
            problems.append(str(error))
            continue
        problems += missing_objects(device, kind, scene)
        devices.update(dict.fromkeys(node_ids, device))
    return devices, problems


def _nodes(scene: Scene, devices: Mapping[int, Abilities], pdos: tuple[PlannedPdo, ...]) -> tuple[PlannedNode, ...]:
    roles: list[tuple[int, NodeKind, str, bool]] = []
    if scene.arm is not None:
        joints = enumerate(scene.arm.node_ids, start=1)
        roles += [(node_id, "drive", f"joint {axis}", scene.arm.emulated) for axis, node_id in joints]
    if scene.sensor is not None:
        roles.append((scene.sensor.node_id, "tactile", "tactile array", scene.sensor.emulated))
    return tuple(
        PlannedNode(
            node_id=node_id,
            kind=kind,
            role=role,
            eds=devices[node_id].eds,
            identity=devices[node_id].identity,
            emulated=emulated,
            switched_off=_switched_off(node_id, devices[node_id], pdos),
        )
        for node_id, kind, role, emulated in sorted(roles)
    )


def _switched_off(node_id: int, device: Abilities, pdos: tuple[PlannedPdo, ...]) -> tuple[tuple[Direction, int], ...]:
    """PDOs that the device has and the scene does not need."""
    used = {(pdo.direction, pdo.number) for pdo in pdos if pdo.node_id == node_id}
    directions: tuple[Direction, ...] = ("rpdo", "tpdo")
    has = [(direction, number) for direction in directions for number in device.pdo_numbers(direction)]
    return tuple(one for one in has if one not in used)
