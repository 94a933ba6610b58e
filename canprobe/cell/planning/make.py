"""`make_plan`: everything that follows from a setup, or every reason why it cannot be carried out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from canprobe.cell.planning.advice import omitted_features, outputs, warnings
from canprobe.cell.planning.array import array_problems, as_supported, cut_patch, speed_over_array_problems
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.configuration import configure
from canprobe.cell.planning.device_capabilities import SECTIONS, DeviceCapabilities, lacks
from canprobe.cell.planning.external_arm import external_problems, servo_problems
from canprobe.cell.planning.free_parameters import at_rate, candidates, suggested_changes, wants_torque
from canprobe.cell.planning.identifiers import (
    identifier_problems,
    order_by_deadline,
    plan_raw_frames,
    raw_frame_problems,
)
from canprobe.cell.planning.model import SYNC_OVERFLOW, Choice, JointSpeeds, Plan
from canprobe.cell.planning.node_configuration import NodeKind
from canprobe.cell.planning.pdos import BusPlan, plan_drive_pdos, plan_encoder_pdo, plan_tactile_pdos
from canprobe.cell.planning.sync import (
    early_stops,
    is_profiled,
    operation_problems,
    period_problem,
    plan_ratio,
    plan_sync,
)
from canprobe.cell.planning.traffic import plan_traffic
from canprobe.cell.planning.units import range_problems, within_drives
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
    problems += external_problems(setup)
    beyond: list[str] = [*range_problems(setup)]
    narrowed: tuple[str, ...] = ()
    bus: BusPlan | None = None
    if not problems:
        setup, beyond, narrowed = within_drives(setup, devices)
        bus = _choose(setup, devices)
        setup = bus.setup
        problems += [*bus.problems, *bus.overload]
    joint_speeds, unsuited = _check_task(setup, narrowed)
    problems += [*beyond, *unsuited]
    if problems or bus is None or bus.budget is None:
        ways = _ways_out(bus) if bus is not None and bus.overload and find_ways else []
        alone = bus is not None and set(problems) <= {*bus.overload}
        problems = [problem if bus is None else _with_rates(problem, bus) for problem in problems]
        raise PlanError(_shared(problems), ways, "" if alone else ", beside what the other lines ask for")
    bus.setup = setup = setup.with_choices({choice.key: choice.value for choice in bus.choices})
    absent = omitted_features(setup)
    bus.not_available += [(f"bridge {name}", lacks) for name in setup.bridge.use if (lacks := BRIDGES[name].lacks)]
    nodes = [configure(bus, *role) for role in _roles(setup)]
    if bus.problems:
        raise PlanError(_shared(bus.problems))
    return Plan(
        setup=setup,
        nodes=tuple(sorted(nodes, key=lambda node: node.node_id)),
        pdos=tuple(bus.pdos),
        raw=tuple(bus.raw),
        sync=bus.sync,
        buses=tuple(bus.buses),
        budget=bus.budget,
        choices=bus.choices,
        joint_speeds=joint_speeds,
        outputs=outputs(setup, dict(absent)),
        left_out=(*absent, *_unused_axes(setup, devices)),
        not_available=tuple(dict.fromkeys(bus.not_available)),
        warnings=(*narrowed, *early_stops(setup, devices), *warnings(setup, bus.pdos)),
    )


def _check_task(setup: Setup, narrowed: tuple[str, ...] = ()) -> tuple[JointSpeeds | None, list[str]]:
    """Joint speeds that the task needs, and why array, arm and plant cannot carry it out, whatever the bus carries.

    Args:
        setup: the setup; closed where its devices are known.
        narrowed: what the drives allow less than the joints; where the arm cannot move, it may be the reason.
    """
    unsuited = [*array_problems(setup)]
    speeds: JointSpeeds | None = None
    unreachable: list[str] = []
    if setup.arm is not None and not unsuited:
        from canprobe.cell.planning.motion import check_motion

        speeds, unreachable = check_motion(setup, setup.arm)
    problems = [*unsuited, *speed_over_array_problems(setup), *servo_problems(setup)]
    cut, safe = cut_patch(setup) or ("", True)
    problems += [cut] if not safe else []
    if setup.bus.direct and setup.bus.bit_error_rate > 0:
        problems.append('bus.interface = "direct" has no wire: bus.bit_error_rate needs a bus, such as lockstep')
    if setup.bus.direct and setup.array is not None and setup.array.raw is not None:
        problems.append('bus.interface = "direct" has no frames: an array of raw frames needs a bus, such as lockstep')
    problems += [*unreachable, *narrowed] if unreachable else []
    truth, arm = setup.truth, setup.arm
    if arm is not None and truth.fidelity == "dynamic" and setup.emulates_arm:
        from canprobe.mechanics.robot.dynamics import dynamics_problem, impossible_bodies

        problem = dynamics_problem(arm.model.name, truth.bodies)
        problems += [problem] if problem is not None else impossible_bodies(arm.model.chain.joints, truth.bodies or ())
    return speeds, problems


def _ways_out(bus: BusPlan) -> list[str]:
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
    setup, beyond, _ = within_drives(setup, _devices(setup)[0])
    return [*beyond, *_check_task(setup)[1]]


def _shared(problems: Sequence[str]) -> list[str]:
    """The problems; one that several nodes share is listed once, with their numbers."""
    nodes: dict[str, list[str]] = {}
    for problem in problems:
        node, text = re.fullmatch(r"(?:node (\d+): )?(.*)", problem, re.DOTALL).groups()  # type: ignore[union-attr]
        nodes.setdefault(text, []).extend([node] if node is not None else [])
    lists = {text: ", ".join(dict.fromkeys(numbers)) for text, numbers in nodes.items()}
    return [f"node{'s' * (',' in its)} {its}: {text}" if its else text for text, its in lists.items()]


def device_problems(setup: Setup) -> list[str]:
    """What the devices of a setup lack for its task, whatever the rate."""
    return _devices(setup)[1]


def _choose(setup: Setup, devices: Mapping[int, DeviceCapabilities]) -> BusPlan:
    """The first candidate that fits; else the nearest to fitting."""
    found: list[BusPlan] = []
    for candidate, choices in candidates(setup):
        bus = _plan_bus(candidate, devices, choices)
        if not bus.overload and not bus.problems:
            return bus
        found.append(bus)
    found = [bus for bus in found if wants_torque(bus.setup) == wants_torque(setup)]
    nearest = min(found, key=_rank)
    if len(found) > 1:
        chosen = ", ".join(f"{choice.key} = {choice.written}" for choice in nearest.choices)
        nearest.problems.insert(0, f"none of {len(found)} ways to fill what is left open fits; the nearest: {chosen}")
    return nearest


def _rank(bus: BusPlan) -> tuple[int, float]:
    """Sort key of a candidate: number of problems, then the largest share of bus or trigger time used."""
    return len(bus.problems), max(max(one.load, *(demand.share for demand in one.demands)) for one in bus.buses)


def _plan_bus(setup: Setup, devices: Mapping[int, DeviceCapabilities], choices: tuple[Choice, ...] = ()) -> BusPlan:
    sync, exact = plan_sync(setup)
    drives = [devices[drive.node_id] for drive in setup.drives if not is_profiled(devices[drive.node_id])]
    unset, periods = period_problem(setup.rate_hz, sync.period_us, exact, drives)
    ratio, untimed, image_rates = plan_ratio(setup)
    bus = BusPlan(setup, devices, sync, _channels(setup), choices)
    nodes = sorted(devices.items())
    if uncounted := [f"node {id_}" for id_, device in nodes if not device.takes(SYNC_COUNTER, 0, SYNC_OVERFLOW)]:
        bus.sync = replace(sync, overflow=0)
        bus.not_available.append(("SYNC counter", f"{', '.join(uncounted)} cannot take one: no 1019h"))
    if unset is not None:
        slower = [(rate, *at_rate(setup, rate)) for rate in periods]
        bus.untaken[unset] = [(f"{rate:.6g}{' Hz' * bool(more)}{more}", one) for rate, more, one in slower]
    if untimed is not None:
        near = image_rates[:_TRIED_RATES]
        bus.untaken[untimed] = [(f"{rate:.6g}", setup.changed("array", rate_hz=rate)) for rate in near]
    bus.problems += bus.untaken
    plan_drive_pdos(bus)
    plan_encoder_pdo(bus)
    plan_tactile_pdos(bus, ratio)
    if setup.bus.cob_ids == "by_deadline":
        bus.pdos = order_by_deadline(bus.pdos, devices.values())
    bus.problems += identifier_problems(bus.pdos)
    if setup.array is not None:
        bus.raw = [*plan_raw_frames(setup)]
        bus.problems += raw_frame_problems(bus, setup.array)
    plan_traffic(bus)
    return bus


_OFFERED_RATES, _TRIED_RATES = 2, 12


def _with_rates(problem: str, bus: BusPlan) -> str:
    """A problem of a bus; one with a rate is followed by the first rates to take in its place that fit."""
    changes = bus.untaken.get(problem)
    if not changes:
        return problem
    known, elsewhere = set(bus.problems) - {problem}, _keys(_problems_beside_bus(bus.setup))
    fitting, in_turn = [], []
    for text, changed in changes:
        other = _plan_bus(changed, bus.devices)
        if other.overload or not known.issuperset(other.problems):
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


def _fits(setup: Setup, known: frozenset[str]) -> BusPlan | None:
    """The bus plan of a changed setup; None where it does not fit or has a new problem.

    The motor torque may be given up for it, as in a plan.
    """
    devices, problems = _devices(setup)
    buses = (_plan_bus(candidate, devices) for candidate, _ in (candidates(setup) if not problems else ()))
    return next((bus for bus in buses if not bus.overload and known.issuperset(bus.problems)), None)


def _roles(setup: Setup) -> list[tuple[NodeKind, str, Node]]:
    """Every node with its kind and its role, the drives from the base, then the encoder, the array last."""
    roles: list[tuple[NodeKind, str, Node]] = [
        ("drive", f"joint {axis}", drive) for axis, drive in enumerate(setup.drives, start=1)
    ]
    if setup.carrier is not None:
        roles.append(("encoder", "encoder of the carrier", setup.carrier))
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
