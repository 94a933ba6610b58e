"""`make_plan`: everything that follows from a setup, or every reason why it cannot be carried out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from canprobe.cell.planning.advice import omitted_features, outputs, warnings
from canprobe.cell.planning.array import array_problems, as_supported, cut_patch, speed_over_array_problems
from canprobe.cell.planning.bridges import unavailable_bridges
from canprobe.cell.planning.configuration import make_configurations
from canprobe.cell.planning.device_capabilities import SECTIONS, DeviceCapabilities, lacks
from canprobe.cell.planning.free_parameters import at_rate, candidates, suggested_changes
from canprobe.cell.planning.identifiers import (
    identifier_problems,
    order_by_deadline,
    plan_raw_frames,
    raw_frame_problems,
)
from canprobe.cell.planning.model import (
    SYNC_OVERFLOW,
    Choice,
    JointSpeeds,
    NodeKind,
    Plan,
    PlannedNode,
    PlannedPdo,
    SyncPlan,
    Traffic,
)
from canprobe.cell.planning.pdos import PdoPlanning, plan_drive_pdos, plan_tactile_pdos
from canprobe.cell.planning.sync import (
    choose_mode,
    early_stops,
    interpolations,
    is_profiled,
    operation_problems,
    period_problem,
    plan_ratio,
    plan_sync,
)
from canprobe.cell.planning.traffic import PlannedTraffic, plan_traffic
from canprobe.cell.planning.units import range_problems, speed_problems, within_drives
from canprobe.cell.scene.setup import Node, Setup
from canprobe.errors import EdsError, PlanError

SYNC_COUNTER = 0x1019


def make_plan(setup: Setup, *, find_ways: bool = True) -> Plan:
    """Derive the plan of a setup; what it leaves open ("auto") is chosen so that it fits.

    Args:
        setup: the setup of a scene; see `canprobe.cell.scene.resolve.resolve`.
        find_ways: whether to look for ways out where the bus is overloaded, which takes far longer than the plan.

    Returns:
        Nodes, PDOs, bus load, what is left out and why. No key of its setup is "auto" any more.

    Raises:
        PlanError: when the setup does not fit; the error has every reason with its numbers, and the ways out.
    """
    setup = as_supported(setup)
    devices, problems = _devices(setup)
    beyond = [*range_problems(setup), *(speed_problems(setup, devices) if not problems else ())]
    setup, narrowed = within_drives(setup, devices) if not problems and not beyond else (setup, ())
    unsuited = [*array_problems(setup)]
    bus = _choose(setup, devices, problems) if not problems else None
    problems += [*unsuited, *speed_over_array_problems(setup)]
    if bus is not None:
        setup = bus.setup
        problems += _cut_problems(setup)
    problems += beyond
    if setup.bus.direct and setup.bus.bit_error_rate > 0:
        problems.append('bus.interface = "direct" has no wire: bus.bit_error_rate needs a bus, such as lockstep')
    if setup.bus.direct and setup.array is not None and setup.array.raw is not None:
        problems.append('bus.interface = "direct" has no frames: an array of raw frames needs a bus, such as lockstep')
    joint_speeds, unreachable = _check_motion(setup) if not unsuited else (None, [])
    problems += [*unreachable, *narrowed] if unreachable else []
    truth, arm = setup.truth, setup.arm
    if arm is not None and truth.fidelity == "dynamic" and any(drive.emulated for drive in setup.drives):
        from canprobe.mechanics.robot.dynamics import dynamics_problem, impossible_bodies

        problem = dynamics_problem(arm.model.name, truth.bodies)
        problems += [problem] if problem is not None else impossible_bodies(arm.model.chain.joints, truth.bodies or ())
    if problems or bus is None:
        ways = _ways_out(bus) if bus is not None and bus.traffic.problems and find_ways else []
        alone = bus is not None and set(problems) <= {*bus.traffic.problems}
        problems = [problem if bus is None else _with_rates(problem, bus, devices) for problem in problems]
        raise PlanError(_shared(problems), ways, "" if alone else ", beside what the other lines ask for")
    chosen = {choice.key: choice.value for choice in bus.choices}
    setup = setup.with_choices(chosen)
    absent = omitted_features(setup)
    plan = Plan(
        setup=setup,
        nodes=_nodes(setup, devices, bus.traffic.pdos, bus.sync),
        pdos=bus.traffic.pdos,
        raw=bus.traffic.raw,
        sync=bus.sync,
        buses=bus.traffic.buses,
        choices=bus.choices,
        joint_speeds=joint_speeds,
        outputs=outputs(setup, dict(absent)),
        left_out=(*absent, *_unused_axes(setup, devices)),
        not_available=(*bus.not_available, *unavailable_bridges(setup)),
        warnings=(*narrowed, *early_stops(setup, devices), *warnings(setup, bus.traffic.pdos)),
    )
    return _with_configurations(plan)


def _ways_out(bus: _BusPlan) -> list[str]:
    """Changes that make an overloaded bus fit and ask for nothing new of the rest of the plan."""
    setup, known, elsewhere = bus.setup, frozenset(bus.problems), frozenset(_problems_beside_bus(bus.setup))

    def sound(closed: Setup) -> bool:
        if closed.rate_hz == setup.rate_hz and _images(closed) == _images(setup):  # nothing else depends on the bus
            return True
        return elsewhere.issuperset(_problems_beside_bus(closed))

    return suggested_changes(setup, lambda changed: _fits(changed, known), sound)


def _images(setup: Setup) -> tuple[object, ...]:
    """What the rest of a plan takes from the images of the array."""
    return () if setup.array is None else (setup.array.mode, setup.array.window, setup.array.rate_hz)


def _problems_beside_bus(setup: Setup) -> list[str]:
    """Problems of a setup with known devices, apart from those of its bus."""
    devices, _ = _devices(setup)
    found = [*speed_over_array_problems(setup), *range_problems(setup), *speed_problems(setup, devices)]
    found += _cut_problems(setup)
    return [*found, *([*array_problems(setup)] or _check_motion(within_drives(setup, devices)[0])[1])]


def _check_motion(setup: Setup) -> tuple[JointSpeeds | None, list[str]]:
    """As `check_motion`; of a cell without an arm nothing moves."""
    if setup.arm is None:
        return None, []
    from canprobe.cell.planning.motion import check_motion

    return check_motion(setup, setup.arm)


def _cut_problems(setup: Setup) -> list[str]:
    cut = cut_patch(setup)
    return [] if cut is None or cut.safe else [f"{cut.text}; take {' or '.join(cut.ways)}"]


def _shared(problems: Sequence[str]) -> list[str]:
    """The problems; one that several nodes share is listed once, with their numbers."""
    nodes: dict[str, list[str]] = {}
    for problem in problems:
        node, text = re.fullmatch(r"(?:node (\d+): )?(.*)", problem, re.DOTALL).groups()  # type: ignore[union-attr]
        nodes.setdefault(text, []).extend([node] if node is not None else [])
    lists = {text: ", ".join(dict.fromkeys(numbers)) for text, numbers in nodes.items()}
    return [f"node{'s' * (',' in its)} {its}: {text}" if its else text for text, its in lists.items()]


def _with_configurations(plan: Plan) -> Plan:
    """The plan with the configuration of each node; wished writes that its device cannot take are not available.

    Raises:
        PlanError: when a device cannot take a required write.
    """
    nodes = make_configurations(plan)
    if problems := [problem for node in nodes for problem in node.problems]:
        raise PlanError(_shared(problems))
    lacks = [(one.what, f"{node.eds}: {one.why}: {one.write.absence}") for node in nodes for one in node.left_out]
    return replace(plan, configurations=nodes, not_available=tuple(dict.fromkeys((*plan.not_available, *lacks))))


@dataclass(frozen=True, slots=True)
class _BusPlan:
    """The bus part of a plan.

    Attributes:
        setup: the closed setup: no key is "auto".
        choices: values of the keys that were open.
        traffic: traffic of its buses, with the problems of the bit rate.
        problems: what is wrong at any bit rate.
        untaken: problems with a rate, each with other rates as text and the setups that have them.
    """

    setup: Setup
    choices: tuple[Choice, ...]
    sync: SyncPlan
    traffic: PlannedTraffic
    problems: list[str]
    not_available: tuple[tuple[str, str], ...]
    untaken: list[tuple[str, list[tuple[str, Setup]]]]

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key of a candidate: number of problems, then the largest share of bus or trigger time used."""
        shares = [bus.traffic.load for bus in self.traffic.buses]
        shares += [demand.used_ns / demand.available_ns for bus in self.traffic.buses for demand in bus.traffic.demands]
        return len(self.problems), max(shares)


def device_problems(setup: Setup) -> list[str]:
    """What the devices of a setup lack for its task, whatever the rate."""
    return _devices(setup)[1]


def _choose(setup: Setup, devices: Mapping[int, DeviceCapabilities], problems: list[str]) -> _BusPlan:
    """The first candidate that fits; else the nearest to fitting, whose problems are added."""
    found: list[_BusPlan] = []
    for candidate, choices in candidates(setup):
        bus = _plan_bus(candidate, devices, choices)
        if not bus.traffic.problems and not bus.problems:
            return bus
        found.append(bus)
    wanted = setup.arm is None or setup.arm.torque
    found = [bus for bus in found if bus.setup.arm is None or bus.setup.arm.torque == wanted]
    nearest = min(found, key=lambda bus: bus.rank)
    if len(found) > 1:
        chosen = ", ".join(f"{choice.key} = {choice.written}" for choice in nearest.choices)
        problems.append(f"none of {len(found)} ways to fill what is left open fits; the nearest: {chosen}")
    problems += [*nearest.problems, *nearest.traffic.problems]
    return nearest


def _plan_bus(setup: Setup, devices: Mapping[int, DeviceCapabilities], choices: tuple[Choice, ...] = ()) -> _BusPlan:
    sync, exact = plan_sync(setup)
    drives = [devices[drive.node_id] for drive in setup.drives if not is_profiled(devices[drive.node_id])]
    unset, periods = period_problem(setup.rate_hz, sync.period_us, exact, drives)
    ratio, untimed, image_rates = plan_ratio(setup)
    not_available = []
    if uncounted := [f"node {node_id}" for node_id, device in sorted(devices.items()) if not _counts_syncs(device)]:
        sync = replace(sync, overflow=0)
        not_available.append(("SYNC counter", f"{', '.join(uncounted)} cannot take one: no 1019h"))
    untaken: list[tuple[str, list[tuple[str, Setup]]]] = []
    if unset is not None:
        slower = [(rate, *at_rate(setup, rate)) for rate in periods]
        untaken.append((unset, [(f"{rate:.6g}{' Hz' * bool(more)}{more}", one) for rate, more, one in slower]))
    if untimed is not None:
        near = image_rates[:_TRIED_RATES]
        untaken.append((untimed, [(f"{rate:.6g}", setup.changed("array", rate_hz=rate)) for rate in near]))
    problems: list[str] = []
    channels = _channels(setup)
    channel_of = {node_id: channel for channel, node_ids in channels.items() for node_id in node_ids}
    planning = PdoPlanning(setup, sync, devices, channel_of, problems=problems, not_available=not_available)
    plan_drive_pdos(planning)
    plan_tactile_pdos(planning, ratio)
    by_deadline = setup.bus.cob_ids == "by_deadline"
    planned = order_by_deadline(planning.pdos, devices.values()) if by_deadline else planning.pdos
    planning.problems += identifier_problems(planned)
    frames = plan_raw_frames(setup)
    if setup.array is not None:
        planning.problems += raw_frame_problems(frames, planned, channels, setup.array.name)
    traffic = plan_traffic(planned, sync, channels, setup.bus, setup.compute_ns, raw=frames)
    return _BusPlan(
        setup=setup,
        choices=choices,
        sync=sync,
        traffic=traffic,
        problems=[*(problem for problem, _ in untaken), *planning.problems],
        not_available=tuple(dict.fromkeys(planning.not_available)),
        untaken=untaken,
    )


_OFFERED_RATES, _TRIED_RATES = 2, 12


def _with_rates(problem: str, bus: _BusPlan, devices: Mapping[int, DeviceCapabilities]) -> str:
    """A problem of a bus; one with a rate is followed by the first rates to take in its place that fit."""
    changes = dict(bus.untaken).get(problem)
    if not changes:
        return problem
    known, elsewhere = set(bus.problems) - {problem}, _keys(_problems_beside_bus(bus.setup))
    fitting, in_turn = [], []
    for text, changed in changes:
        other = _plan_bus(changed, devices)
        if other.traffic.problems or not known.issuperset(other.problems):
            continue
        if further := _keys(_problems_beside_bus(other.setup)) - elsewhere:
            in_turn.append((text, ", which asks for another " + " and ".join(sorted(further))))
            continue
        fitting.append(text)
        if len(fitting) == _OFFERED_RATES:
            break
    none_fits = ""
    if not fitting and in_turn:
        fitting, none_fits = [in_turn[0][0]], in_turn[0][1]
    elif not fitting:
        fitting, none_fits = [text for text, _ in changes[:_OFFERED_RATES]], ", which the bus has no room for as it is"
    unit = "" if "=" in fitting[-1] else " Hz"
    return f"{problem}; take {' or '.join(fitting)}{unit}{none_fits}"


def _keys(problems: Sequence[str]) -> set[str]:
    """The keys that problems begin with: another rate changes the figures behind them."""
    return {problem.partition(" ")[0] for problem in problems}


def _counts_syncs(device: DeviceCapabilities) -> bool:
    """Whether a device can take a SYNC with our counter."""
    entry = device.description.entry(SYNC_COUNTER)
    return entry is not None and (entry.initial == SYNC_OVERFLOW or (entry.writable and entry.allows(SYNC_OVERFLOW)))


def _unused_axes(setup: Setup, devices: Mapping[int, DeviceCapabilities]) -> list[tuple[str, str]]:
    """The axes of drives of several axes that the cell does not drive, as (what, why)."""
    unused = []
    for kind, role, node in _roles(setup):
        if kind == "drive" and (others := [axis for axis in devices[node.node_id].axes if axis > 1]):
            objects = ", ".join(f"{0x6000 + 0x800 * (axis - 1):04X}h" for axis in others)
            axes = f"ax{'es' if len(others) > 1 else 'is'} {', '.join(map(str, others))}"
            why = f"{node.eds} has objects of more axes, from {objects}: a joint has the first of its node"
            unused.append((f"{axes} of node {node.node_id} ({role})", why))
    return unused


def _channels(setup: Setup) -> dict[str, tuple[int, ...]]:
    """Which nodes are on which bus, in the order of `_roles`; an array of raw frames is on one without being a node."""
    nodes = [node for _, _, node in _roles(setup)]
    others = [setup.array.channel] if setup.array is not None and setup.array.raw is not None else []
    names = dict.fromkeys([*(node.channel for node in nodes), *others])
    return {name: tuple(sorted(node.node_id for node in nodes if node.channel == name)) for name in names}


def _fits(setup: Setup, known: frozenset[str]) -> tuple[Setup, Traffic] | None:
    """A changed setup, closed, and the traffic of its fullest bus; None where it does not fit or has a new problem.

    The motor torque may be given up for it, as in a plan.
    """
    devices, problems = _devices(setup)
    if problems:
        return None
    for candidate, _ in candidates(setup):
        bus = _plan_bus(candidate, devices)
        if not bus.traffic.problems and known.issuperset(bus.problems):
            return candidate, max((one.traffic for one in bus.traffic.buses), key=lambda traffic: traffic.load)
    return None


def _roles(setup: Setup) -> list[tuple[NodeKind, str, Node]]:
    """Every node with its kind and its role, the drives from the base, the array last."""
    roles: list[tuple[NodeKind, str, Node]] = [
        ("drive", f"joint {axis}", drive) for axis, drive in enumerate(setup.drives, start=1)
    ]
    array = setup.array
    return roles if array is None or array.raw is not None else [*roles, ("tactile", "tactile array", array)]


def _devices(setup: Setup) -> tuple[dict[int, DeviceCapabilities], list[str]]:
    """Capabilities of each node by its EDS, and what it lacks, once for a file that several nodes share."""
    seen: set[tuple[NodeKind, str]] = set()
    devices: dict[int, DeviceCapabilities] = {}
    problems: list[str] = []
    for kind, _, node in _roles(setup):
        first = (kind, node.eds) not in seen
        seen.add((kind, node.eds))
        try:
            device = devices[node.node_id] = DeviceCapabilities.of(node.eds, node.node_id)
        except EdsError as error:
            problems += [f"{SECTIONS[kind]}.eds: {error}"] if first else []
            continue
        if first:
            problems += lacks(device, kind, setup)
            problems += operation_problems(device, setup) if kind == "drive" else []
    return devices, problems


def _nodes(
    setup: Setup, devices: Mapping[int, DeviceCapabilities], pdos: tuple[PlannedPdo, ...], sync: SyncPlan
) -> tuple[PlannedNode, ...]:
    nodes = []
    for kind, role, node in _roles(setup):
        device, is_drive = devices[node.node_id], kind == "drive"
        used = {(pdo.direction, pdo.number) for pdo in pdos if pdo.node_id == node.node_id}
        nodes.append(
            PlannedNode(
                node_id=node.node_id,
                kind=kind,
                role=role,
                eds=node.eds,
                dictionary=device.od,
                identity=replace(device.identity, serial_number=node.serial),
                emulated=node.emulated,
                channel=node.channel,
                switched_off=tuple(one for one in device.switchable_pdos if one not in used),
                mode=choose_mode(device) if is_drive else None,
                interpolation=interpolations(device, sync.period_us) if is_drive and not is_profiled(device) else (),
            )
        )
    return tuple(sorted(nodes, key=lambda node: node.node_id))
