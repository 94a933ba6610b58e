"""`make_plan`: everything that follows from a scene, or every reason why it cannot be carried out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from canprobe.errors import EdsError, PlanError
from canprobe.planning.abilities import Abilities
from canprobe.planning.bridges import unavailable_bridges
from canprobe.planning.cut_patch import cut_patch
from canprobe.planning.cycle import plan_ratio, plan_sync
from canprobe.planning.identifiers import identifier_problems, order_by_deadline
from canprobe.planning.left_out import left_out, outputs
from canprobe.planning.model import (
    Choice,
    Direction,
    NodeKind,
    Plan,
    PlannedBus,
    PlannedNode,
    PlannedPdo,
    SyncPlan,
    Traffic,
)
from canprobe.planning.needs import missing_bitrate, missing_objects
from canprobe.planning.open_keys import candidates
from canprobe.planning.pdos import PdoPlanning, plan_drive_pdos, plan_tactile_pdos
from canprobe.planning.traffic import plan_traffic
from canprobe.planning.turning import plan_motion
from canprobe.planning.warnings import plan_warnings
from canprobe.planning.ways_out import ways_out
from canprobe.scene import Scene
from canprobe.scene_values import need_scene

SYNC_COUNTER = 0x1019


def make_plan(scene: Scene) -> Plan:
    """Derive the plan of a scene; what the scene leaves open ("auto") is chosen so that it fits.

    Args:
        scene: as `load_scene` gave it.

    Returns:
        Nodes, PDOs, bus load, what is left out and why. Its scene has nothing open any more.

    Raises:
        UsageError: this is no scene.
        PlanError: with every reason why the scene does not fit, its numbers and the ways out.
    """
    need_scene(scene)
    devices, problems = _devices(scene)
    found = _choose(scene, devices) if not problems else None
    ways: list[str] = []
    if found is not None:
        problems += found.reasons()
        ways += found.ways_out()
        scene = found.scene
    scene, joint_speeds, unreachable, turn = plan_motion(scene)
    cut = cut_patch(scene) if found is not None else None
    if cut is not None and cut.true_n is None:
        problems.append(cut.text)
        ways += cut.ways if not ways else ()
    problems += unreachable
    if problems or found is None:
        raise PlanError(problems, ways)
    bus = found.bus
    return Plan(
        scene=scene,
        nodes=_nodes(scene, devices, bus.pdos),
        pdos=bus.pdos,
        sync=bus.sync,
        buses=bus.buses,
        choices=(*found.choices, *turn),
        joint_speeds=joint_speeds,
        estimator=scene.shape.method if scene.shape is not None else None,
        offline_estimators=scene.shape.also if scene.shape is not None else (),
        strategy=scene.task.strategy if scene.task.kind == "scan" else None,
        fidelity=scene.plant.fidelity if scene.plant is not None and scene.emulated_node_ids else None,
        outputs=outputs(scene),
        left_out=left_out(scene),
        not_available=(*bus.not_available, *unavailable_bridges(scene)),
        warnings=plan_warnings(scene, bus.pdos),
    )


@dataclass(frozen=True, slots=True)
class _BusPlan:
    """The bus part of a plan; `problems` are wrong whatever the bit rate, `overload` does not fit it."""

    sync: SyncPlan
    pdos: tuple[PlannedPdo, ...]
    buses: tuple[PlannedBus, ...]
    problems: list[str]
    overload: list[str]
    not_available: tuple[tuple[str, str], ...]

    @property
    def peak(self) -> float:
        """The largest share of a bus, or of the time that a trigger's frames have, that is asked for."""
        demands = (demand for bus in self.buses for demand in bus.traffic.demands)
        return max(
            *(bus.traffic.load for bus in self.buses), *(demand.used_ns / demand.available_ns for demand in demands)
        )


@dataclass(frozen=True, slots=True)
class _Found:
    """The first candidate that fits, or else the nearest to it."""

    scene: Scene
    choices: tuple[Choice, ...]
    bus: _BusPlan
    tried: int

    def reasons(self) -> list[str]:
        """Why it does not fit; empty where it does."""
        problems = [*self.bus.problems, *self.bus.overload]
        if problems and self.tried > 1:
            chosen = ", ".join(f"{choice.key} = {choice.value}" for choice in self.choices)
            problems.insert(0, f"none of {self.tried} ways to fill what is left open fits; the nearest: {chosen}")
        return problems

    def ways_out(self) -> list[str]:
        """What would make it fit its bus; empty where it does."""
        if not self.bus.overload:
            return []
        known = frozenset(self.bus.problems)
        return ways_out(self.scene, lambda changed: _fits(changed, known))


def _choose(scene: Scene, devices: Mapping[int, Abilities]) -> _Found:
    nearest: _Found | None = None
    for tried, (candidate, choices) in enumerate(candidates(scene), start=1):
        found = _Found(candidate, choices, _plan_bus(candidate, devices), tried)
        if not found.bus.overload and not found.bus.problems:
            return found
        if nearest is None or _distance(found.bus) < _distance(nearest.bus):
            nearest = found
    assert nearest is not None
    return replace(nearest, tried=tried)


def _distance(bus: _BusPlan) -> tuple[int, float]:
    return len(bus.problems), bus.peak


def _plan_bus(scene: Scene, devices: Mapping[int, Abilities]) -> _BusPlan:
    sync, problems = plan_sync(scene)
    ratio, found = plan_ratio(scene)
    planning = PdoPlanning(problems=[*problems, *found])
    if uncounted := [f"node {node_id}" for node_id, device in sorted(devices.items()) if SYNC_COUNTER not in device.od]:
        sync = replace(sync, overflow=0)
        planning.not_available.append(("SYNC counter", f"{', '.join(uncounted)} cannot take one: no 1019h"))
    plan_drive_pdos(planning, scene, sync, devices)
    if scene.sensor is not None:
        plan_tactile_pdos(planning, scene, sync, ratio, devices[scene.sensor.node_id])
    planned = order_by_deadline(planning.pdos) if scene.bus.cob_ids == "by_deadline" else planning.pdos
    planning.problems += identifier_problems(planned)
    buses: list[PlannedBus] = []
    pdos: list[PlannedPdo] = []
    overload: list[str] = []
    for channel, node_ids in _channels(scene).items():
        mine = [replace(pdo, channel=channel) for pdo in planned if pdo.node_id in node_ids]
        settings = replace(scene.bus, channel=channel)
        traffic, timed, late = plan_traffic(mine, sync, node_ids, settings, round(scene.cycle.compute_us * 1000))
        buses.append(PlannedBus(channel, node_ids, traffic))
        pdos += timed
        overload += late
    return _BusPlan(
        sync, tuple(pdos), tuple(buses), planning.problems, overload, tuple(dict.fromkeys(planning.not_available))
    )


def _channels(scene: Scene) -> dict[str, tuple[int, ...]]:
    """Which nodes are on which bus, the arm's first."""
    channels: dict[str, tuple[int, ...]] = {}
    if scene.arm is not None:
        channels[scene.bus.channel] = tuple(sorted(scene.arm.node_ids))
    if scene.sensor is not None:
        channel = scene.sensor.channel or scene.bus.channel
        channels[channel] = tuple(sorted((*channels.get(channel, ()), scene.sensor.node_id)))
    return channels


def _fits(scene: Scene, known: frozenset[str]) -> Traffic | None:
    """The fullest bus of a changed scene if it fits and brings no problem that is not known already."""
    devices, problems = _devices(scene)
    if problems:
        return None
    bus = _plan_bus(scene, devices)
    if bus.overload or not known.issuperset(bus.problems):
        return None
    return max((one.traffic for one in bus.buses), key=lambda traffic: traffic.load)


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
        problems += missing_objects(device, kind, scene) + missing_bitrate(device, kind, scene)
        devices.update(dict.fromkeys(node_ids, device))
    return devices, problems


def _nodes(scene: Scene, devices: Mapping[int, Abilities], pdos: tuple[PlannedPdo, ...]) -> tuple[PlannedNode, ...]:
    roles: list[tuple[int, NodeKind, str, bool]] = []
    if scene.arm is not None:
        joints = enumerate(scene.arm.node_ids, start=1)
        roles += [(node_id, "drive", f"joint {axis}", scene.arm.emulated) for axis, node_id in joints]
    if scene.sensor is not None:
        roles.append((scene.sensor.node_id, "tactile", "tactile array", scene.sensor.emulated))
    channel_of = {node_id: channel for channel, node_ids in _channels(scene).items() for node_id in node_ids}
    return tuple(
        PlannedNode(
            node_id=node_id,
            kind=kind,
            role=role,
            eds=devices[node_id].eds,
            identity=replace(devices[node_id].identity, serial_number=_serial_number(scene, node_id)),
            emulated=emulated,
            channel=channel_of[node_id],
            switched_off=_switched_off(node_id, devices[node_id], pdos),
        )
        for node_id, kind, role, emulated in sorted(roles)
    )


def _serial_number(scene: Scene, node_id: int) -> int | None:
    """What the scene wants 1018h:04 of a node to be."""
    if scene.sensor is not None and node_id == scene.sensor.node_id:
        return scene.sensor.serial_number
    if scene.arm is None or scene.arm.serial_numbers is None:
        return None
    return scene.arm.serial_numbers[scene.arm.node_ids.index(node_id)]


def _switched_off(node_id: int, device: Abilities, pdos: tuple[PlannedPdo, ...]) -> tuple[tuple[Direction, int], ...]:
    """PDOs that the device has and the scene does not need."""
    used = {(pdo.direction, pdo.number) for pdo in pdos if pdo.node_id == node_id}
    directions: tuple[Direction, ...] = ("rpdo", "tpdo")
    has = [(direction, number) for direction in directions for number in device.pdo_numbers(direction)]
    return tuple(one for one in has if one not in used)
