"""`make_plan`: everything that follows from a scene, or every reason why it cannot be carried out; and what is left
out.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from canprobe.errors import EdsError, PlanError
from canprobe.planning.bridges import bridge_outputs, unavailable_bridges
from canprobe.planning.choices import (
    TOLERATED,
    candidates,
    cut_patch,
    measured_share,
    patch_across_taxels,
    plan_ratio,
    plan_sync,
    ways_out,
)
from canprobe.planning.devices import (
    Abilities,
    PdoPlanning,
    identifier_problems,
    missing_bitrate,
    missing_objects,
    order_by_deadline,
    plan_drive_pdos,
    plan_tactile_pdos,
)
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
from canprobe.planning.motion import check_motion
from canprobe.planning.traffic import plan_traffic
from canprobe.protocol.frame_bits import WORST_ERROR_BITS
from canprobe.scene.setup import Array, Bus, Drive, Setup, Touch

# What a scene does not need, and why: one table.

_Reason = Callable[[Setup], str | None]


def _no_arm(setup: Setup) -> str | None:
    return None if setup.arm else f'no [arm]: task.kind = "{setup.kind}" moves nothing'


def _no_sensor(setup: Setup) -> str | None:
    return None if setup.array else f'no [sensor]: task.kind = "{setup.kind}" feels nothing'


def _no_image(setup: Setup) -> str | None:
    if setup.array is None or setup.array.mode == "image":
        return None
    return _by_window(setup, setup.array.window) if setup.array.mode == "window" else _by_sensor(setup)


def _by_window(setup: Setup, side: int | str) -> str:
    touch = setup.touch
    name = f"the {side}×{side} window round the contact"
    if touch is None or isinstance(side, str):
        return f"{name} is sent"
    if side >= patch_across_taxels(touch.force, touch.probe):
        return f"{name} holds the patch"
    outside = 1.0 - measured_share(touch.force, touch.probe, side)
    return f"{name} is sent, with up to {100 * outside:.0f} % of the force outside"


def _no_window(setup: Setup) -> str | None:
    if setup.array is None or setup.array.mode == "window":
        return None
    return "the full image is sent" if setup.array.mode == "image" else _by_sensor(setup)


def _by_sensor(setup: Setup) -> str | None:
    if setup.array is None or setup.array.mode != "features":
        return None
    return 'sensor.mode = "features": the sensor computes force, centroid and moments itself'


def _no_shape(setup: Setup) -> str | None:
    if setup.shape is not None:
        return None
    why = {
        "press": "one touch without motion shows no shape",
        "calibrate": "the ball is known",
        "listen": "nothing moves",
        "free": "nothing is touched",
    }
    return why.get(setup.kind, "no [shape]")


def _no_patch(setup: Setup) -> str | None:
    if setup.shape is None:
        return None
    return "shape.patch = false" if not setup.shape.patch else _by_sensor(setup)


def _no_strategy(setup: Setup) -> str | None:
    why = {
        "press": "the probe holds still",
        "calibrate": "no surface is followed",
        "listen": "nothing moves",
        "free": "the joints swing, no surface is followed",
    }
    return why.get(setup.kind)


def _no_servo(setup: Setup) -> str | None:
    return None if isinstance(setup.task, Touch) else f'task.kind = "{setup.kind}" controls no force'


def _no_emulator(setup: Setup) -> str | None:
    return None if setup.emulated_node_ids else "every node is real"


def _no_truth(setup: Setup) -> str | None:
    if setup.emulated_node_ids and (setup.truth.object is not None or setup.kind == "free"):
        return None
    return "no emulated node" if not setup.emulated_node_ids else "no [object]: nothing to compare with"


def _no_dynamics(setup: Setup) -> str | None:
    emulated_arm = setup.arm is not None and setup.arm.drives[0].emulated and setup.truth.fidelity == "ideal"
    return 'plant.fidelity = "ideal": each drive tracks as a second-order system' if emulated_arm else None


def _no_figure(setup: Setup) -> str | None:
    if not setup.figures:
        return "scene.figures = false"
    if importlib.util.find_spec("matplotlib") is not None:
        return None
    return "the study extra is not installed: pip install 'canprobe[study]'"


def _no_page(setup: Setup) -> str | None:
    if not setup.figures:
        return "scene.figures = false"
    if setup.kind == "listen":
        return 'task.kind = "listen": nothing moves'
    if importlib.util.find_spec("viser") is not None:
        return None
    return "the view extra is not installed: pip install 'canprobe[view]'"


def _no_bridge(setup: Setup) -> str | None:
    return None if setup.bridge is not None and setup.bridge.use else "no [bridge]: no other tool is fed"


def _switch(name: str) -> _Reason:
    def reason(setup: Setup) -> str | None:
        off = setup.array is not None and name in setup.truth.without
        return f"plant.{name} = false" if off else None

    return reason


_TABLE: tuple[tuple[str, _Reason], ...] = (
    ("six drives, their PDOs, joint limits", _no_arm),
    ("tactile node and its PDOs", _no_sensor),
    ("full image (32 PDOs)", _no_image),
    ("window (8 PDOs)", _no_window),
    ("taxels and patch features in the master", _by_sensor),
    ("surface estimator", _no_shape),
    ("curvature from the patch", _no_patch),
    ("exploration strategy", _no_strategy),
    ("tactile servo", _no_servo),
    ("emulator", _no_emulator),
    ("truth and scores against it", _no_truth),
    ("arm dynamics", _no_dynamics),
    ("taxel noise", _switch("noise")),
    ("taxel gain error", _switch("gain_error")),
    ("cover blur", _switch("blur")),
    ("taxel hysteresis", _switch("hysteresis")),
    ("taxel creep", _switch("creep")),
    ("taxel crosstalk", _switch("crosstalk")),
    ("taxel saturation", _switch("saturation")),
    ("the array's own threshold", _switch("threshold")),
    ("figure", _no_figure),
    ("replay to share (report.html)", _no_page),
    ("bridges to other tools", _no_bridge),
)


def left_out(setup: Setup) -> tuple[tuple[str, str], ...]:
    """Everything that this scene leaves out, as (what, why)."""
    reasons = ((what, reason(setup)) for what, reason in _TABLE)
    return tuple((what, why) for what, why in reasons if why is not None)


def outputs(setup: Setup) -> tuple[str, ...]:
    """The files that a run of this scene writes."""
    files = ["summary.json", "log.npz", "bus.log", "scene.toml"]
    if _no_truth(setup) is None:
        files.append("truth.npz")
    if setup.kind == "calibrate":
        files.append("tool.toml")
    mapped = _no_shape(setup) is None
    if mapped:
        files.append("surface.npz")
    if _no_figure(setup) is None:
        files += ["report.png", "surface.png"] if mapped else ["report.png"]
    if _no_page(setup) is None:
        files.append("report.html")
    return (*files, *bridge_outputs(setup))


# What a plan carries out and yet tells its user first: where the numbers in it do not hold.


def plan_warnings(setup: Setup, pdos: Sequence[PlannedPdo]) -> tuple[str, ...]:
    """Everything that a user has to know before he trusts the plan, most important first."""
    return (*_window(setup), *_errors(setup.bus, pdos))


def _window(setup: Setup) -> list[str]:
    cut = cut_patch(setup)
    return (
        [] if cut is None else [f"{cut.text}; {' or '.join(cut.ways)} leaves less than {100 * TOLERATED:.0f} % outside"]
    )


def _errors(bus: Bus, pdos: Sequence[PlannedPdo]) -> list[str]:
    if bus.bit_error_rate <= 0 or not pdos:
        return []
    longest = max(pdo.bits_worst for pdo in pdos)
    lost = 1.0 - (1.0 - bus.bit_error_rate) ** longest
    each_us = (WORST_ERROR_BITS + longest) * 1e6 / bus.bitrate
    return [
        f"bus.bit_error_rate = {bus.bit_error_rate:g}: response times hold for a wire without errors; each error adds "
        f"up to {each_us:.0f} µs, and up to {100 * lost:.2g} % of the frames have one"
    ]


# `make_plan`: everything that follows from a setup, or every reason why it cannot be carried out.

SYNC_COUNTER = 0x1019


def make_plan(setup: Setup) -> Plan:
    """Derive the plan of a setup; what it leaves open ("auto") is chosen so that it fits.

    Args:
        setup: of a scene; see `canprobe.scene.resolve.resolve`.

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
