"""`make_plan`: everything that follows from a setup, or every reason why it cannot be carried out."""

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
from canprobe.planning.reach import check_motion
from canprobe.planning.traffic import plan_traffic
from canprobe.planning.warnings import plan_warnings
from canprobe.planning.ways_out import ways_out
from canprobe.scene_setup import Array, Drive, Setup, Touch

SYNC_COUNTER = 0x1019


def make_plan(setup: Setup) -> Plan:
    """Derive the plan of a setup; what it leaves open ("auto") is chosen so that it fits.

    Args:
        setup: of a scene; see `canprobe.scene_resolve.resolve`.

    Returns:
        Nodes, PDOs, bus load, what is left out and why. Its setup has nothing open any more.

    Raises:
        PlanError: with every reason why the setup does not fit, its numbers and the ways out.
    """
    devices, problems = _devices(setup)
    found = _choose(setup, devices) if not problems else None
    ways: list[str] = []
    if found is not None:
        problems += found.reasons()
        ways += found.ways_out()
        setup = found.setup
    joint_speeds, unreachable = check_motion(setup)
    cut = cut_patch(setup) if found is not None else None
    if cut is not None and cut.true_n is None:
        problems.append(cut.text)
        ways += cut.ways if not ways else ()
    problems += unreachable
    if problems or found is None:
        raise PlanError(problems, ways)
    bus = found.bus
    scan = setup.task.scan if isinstance(setup.task, Touch) else None
    return Plan(
        setup=setup,
        nodes=_nodes(setup, devices, bus.pdos),
        pdos=bus.pdos,
        sync=bus.sync,
        buses=bus.buses,
        choices=found.choices,
        joint_speeds=joint_speeds,
        estimator=setup.shape.method if setup.shape is not None else None,
        offline_estimators=setup.shape.also if setup.shape is not None else (),
        strategy=scan.name if scan is not None else None,
        fidelity=setup.truth.fidelity if setup.emulated_node_ids else None,
        outputs=outputs(setup),
        left_out=left_out(setup),
        not_available=(*bus.not_available, *unavailable_bridges(setup)),
        warnings=plan_warnings(setup, bus.pdos),
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

    setup: Setup
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
        return ways_out(self.setup, lambda changed: _fits(changed, known))


def _choose(setup: Setup, devices: Mapping[int, Abilities]) -> _Found:
    nearest: _Found | None = None
    for tried, (candidate, choices) in enumerate(candidates(setup), start=1):
        found = _Found(candidate, choices, _plan_bus(candidate, devices), tried)
        if not found.bus.overload and not found.bus.problems:
            return found
        if nearest is None or _distance(found.bus) < _distance(nearest.bus):
            nearest = found
    assert nearest is not None
    return replace(nearest, tried=tried)


def _distance(bus: _BusPlan) -> tuple[int, float]:
    return len(bus.problems), bus.peak


def _plan_bus(setup: Setup, devices: Mapping[int, Abilities]) -> _BusPlan:
    sync, problems = plan_sync(setup)
    ratio, found = plan_ratio(setup)
    planning = PdoPlanning(problems=[*problems, *found])
    if uncounted := [f"node {node_id}" for node_id, device in sorted(devices.items()) if SYNC_COUNTER not in device.od]:
        sync = replace(sync, overflow=0)
        planning.not_available.append(("SYNC counter", f"{', '.join(uncounted)} cannot take one: no 1019h"))
    plan_drive_pdos(planning, setup, sync, devices)
    if setup.array is not None:
        plan_tactile_pdos(planning, setup, sync, ratio, devices[setup.array.node_id])
    planned = order_by_deadline(planning.pdos) if setup.bus.cob_ids == "by_deadline" else planning.pdos
    planning.problems += identifier_problems(planned)
    buses: list[PlannedBus] = []
    pdos: list[PlannedPdo] = []
    overload: list[str] = []
    for channel, node_ids in _channels(setup).items():
        mine = [replace(pdo, channel=channel) for pdo in planned if pdo.node_id in node_ids]
        settings = replace(setup.bus, channel=channel)
        traffic, timed, late = plan_traffic(mine, sync, node_ids, settings, setup.compute_ns)
        buses.append(PlannedBus(channel, node_ids, traffic))
        pdos += timed
        overload += late
    return _BusPlan(
        sync, tuple(pdos), tuple(buses), planning.problems, overload, tuple(dict.fromkeys(planning.not_available))
    )


def _channels(setup: Setup) -> dict[str, tuple[int, ...]]:
    """Which nodes are on which bus, the arm's first."""
    channels: dict[str, tuple[int, ...]] = {}
    if setup.arm is not None:
        channels[setup.bus.channel] = tuple(sorted(setup.arm.node_ids))
    if setup.array is not None:
        channel = setup.array.channel or setup.bus.channel
        channels[channel] = tuple(sorted((*channels.get(channel, ()), setup.array.node_id)))
    return channels


def _fits(setup: Setup, known: frozenset[str]) -> Traffic | None:
    """The fullest bus of a changed scene if it fits and brings no problem that is not known already."""
    devices, problems = _devices(setup)
    if problems:
        return None
    bus = _plan_bus(setup, devices)
    if bus.overload or not known.issuperset(bus.problems):
        return None
    return max((one.traffic for one in bus.buses), key=lambda traffic: traffic.load)


def _devices(setup: Setup) -> tuple[dict[int, Abilities], list[str]]:
    """The EDS of every node, and what is missing in them; each file is read once."""
    devices: dict[int, Abilities] = {}
    problems: list[str] = []
    wanted: dict[tuple[NodeKind, str], list[int]] = {}
    for drive in setup.arm.drives if setup.arm is not None else ():
        wanted.setdefault(("drive", drive.eds), []).append(drive.node_id)
    if setup.array is not None:
        wanted["tactile", setup.array.eds] = [setup.array.node_id]
    for (kind, eds), node_ids in wanted.items():
        try:
            device = Abilities.of(eds, node_ids[0])
        except EdsError as error:
            problems.append(str(error))
            continue
        problems += missing_objects(device, kind, setup) + missing_bitrate(device, kind, setup)
        devices.update(dict.fromkeys(node_ids, device))
    return devices, problems


def _nodes(setup: Setup, devices: Mapping[int, Abilities], pdos: tuple[PlannedPdo, ...]) -> tuple[PlannedNode, ...]:
    roles: list[tuple[NodeKind, str, Drive | Array]] = []
    if setup.arm is not None:
        roles += [("drive", f"joint {axis}", drive) for axis, drive in enumerate(setup.arm.drives, start=1)]
    if setup.array is not None:
        roles.append(("tactile", "tactile array", setup.array))
    channel_of = {node_id: channel for channel, node_ids in _channels(setup).items() for node_id in node_ids}
    return tuple(
        PlannedNode(
            node_id=node.node_id,
            kind=kind,
            role=role,
            eds=devices[node.node_id].eds,
            identity=replace(devices[node.node_id].identity, serial_number=node.serial),
            emulated=node.emulated,
            channel=channel_of[node.node_id],
            switched_off=_switched_off(node.node_id, devices[node.node_id], pdos),
        )
        for kind, role, node in sorted(roles, key=lambda one: one[2].node_id)
    )


def _switched_off(node_id: int, device: Abilities, pdos: tuple[PlannedPdo, ...]) -> tuple[tuple[Direction, int], ...]:
    """PDOs that the device has and the scene does not need."""
    used = {(pdo.direction, pdo.number) for pdo in pdos if pdo.node_id == node_id}
    directions: tuple[Direction, ...] = ("rpdo", "tpdo")
    has = [(direction, number) for direction in directions for number in device.pdo_numbers(direction)]
    return tuple(one for one in has if one not in used)
