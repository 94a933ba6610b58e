"""The plan: frozen data from which bring-up, cycle, emulator and command line work."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from canprobe.cell.planning.node_configuration import Direction, NodeConfiguration, NodeKind
from canprobe.cell.scene.load import SAVED_AS, dump_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.setup import Setup
from canprobe.cell.scene.toml_files import toml_value, written_by_line
from canprobe.fieldbus.protocol.pdo import PdoEntry, PdoLayout

MASTER_NODE_ID = 127
HEARTBEAT_PRODUCED_MS = 100
HEARTBEAT_CONSUMED_MS = 250
SYNC_OVERFLOW = 240
TASK_OVERHEAD_S = 3.0
"""About the time that a task takes besides its phase: enabling, the way to the object, settling, letting go."""

EVERY_SYNC = 1
"""Transmission type of a PDO that is sent in every cycle."""

RawKind = Literal["image", "start", "stop", "poll"]
Part = Literal["SYNC", "feedback", "controller", "command", "tactile", "other", "event"]
"""Part of a frame, or of the controller, in the cycle; an event is a frame that SYNC does not trigger."""


@dataclass(frozen=True, slots=True)
class PlannedPdo:
    """One PDO of one node.

    Attributes:
        node_id: the node.
        direction: `tpdo` or `rpdo`, from the device's view.
        number: number of the PDO, 1 for 1400h/1600h or 1800h/1A00h.
        channel: channel of its bus.
        layout: COB-ID, mapping entries and transmission type.
        rate_hz: rate on the bus; for an event-driven PDO the slowest one.
        bits_worst: bits on the wire with worst-case stuffing.
        deadline_ns: latest time of its end after the SYNC, or after its own queueing where event-driven.
        response_ns: worst case of its end after the SYNC, or after its own queueing where event-driven; None where
            the bus is overloaded.
        event_timer_ms: value of 14xxh:05; 0: none.
        kind: kind of the node.
        used: False for a TPDO that the scene does not need and that cannot be switched off.
        fixed_id: whether its COB-ID cannot be changed.
        constants: values of entries that the cycle does not command, by (index, sub-index).
    """

    node_id: int
    direction: Direction
    number: int
    channel: str
    layout: PdoLayout
    rate_hz: float
    bits_worst: int
    deadline_ns: int
    response_ns: int | None = None
    event_timer_ms: int = 0
    kind: NodeKind = "drive"
    used: bool = True
    fixed_id: bool = False
    constants: tuple[tuple[tuple[int, int], int], ...] = ()

    @property
    def part(self) -> Part:
        """Its part in the cycle."""
        if not self.layout.synchronous:
            return "event"
        if self.direction == "rpdo":
            return "command"
        return "tactile" if self.kind == "tactile" else "feedback" if self.used else "other"

    @property
    def cob_id(self) -> int:
        """11-bit identifier."""
        return self.layout.cob_id

    @property
    def slack_ns(self) -> int | None:
        """Time between the worst case and the deadline; None where the worst case has no bound."""
        return None if self.response_ns is None else self.deadline_ns - self.response_ns

    @property
    def entries(self) -> tuple[PdoEntry, ...]:
        """Mapped objects, dummies included."""
        return self.layout.entries

    @property
    def transmission_type(self) -> int:
        """Value of 18xxh:02 or 14xxh:02."""
        return self.layout.transmission_type


@dataclass(frozen=True, slots=True)
class PlannedFrames:
    """Raw frames of one identifier, of an array that is no CANopen node.

    Attributes:
        can_id: 11-bit identifier.
        channel: channel of their bus.
        what: `image`, `start`, `stop` or `poll`.
        sent: whether the master sends them; else the device does.
        count: number of frames of one image, or of one command.
        length: bytes of the longest frame.
        rate_hz: rate of the images; 0 for what is sent at the beginning and the end.
        bits_worst: bits of all of them with worst-case stuffing.
        response_ns: worst case from the first one's queueing to the last one's end; None where the bus is overloaded,
            or where they have no rate.
    """

    can_id: int
    channel: str
    what: RawKind
    sent: bool
    count: int
    length: int
    rate_hz: float
    bits_worst: int
    response_ns: int | None = None


@dataclass(frozen=True, slots=True)
class SyncPlan:
    """SYNC as 1005h, 1006h and 1019h express it.

    Attributes:
        rate_hz: rate that the scene asks for.
        period_ns: period, a whole number.
        period_us: value of 1006h.
        overflow: value of 1019h.
    """

    rate_hz: float
    period_ns: int
    period_us: int
    overflow: int


@dataclass(frozen=True, slots=True)
class Demand:
    """Time on the bus of the frames that one trigger releases, worst case.

    Attributes:
        what: which frames.
        cycles: number of cycles within which they must be through.
        used_ns: wire time of these and of all frames of higher priority meanwhile.
        available_ns: length of the cycles.
    """

    what: str
    cycles: int
    used_ns: int
    available_ns: int

    @property
    def share(self) -> float:
        """Share of the cycles that the frames take."""
        return self.used_ns / self.available_ns


@dataclass(frozen=True, slots=True)
class CycleBudget:
    """The worst course of one cycle, ns after its SYNC is due; None where a part is missing, or has no bound.

    With several buses each time is that of the slowest: the controller waits for the feedback of all of them.

    Attributes:
        period_ns: period of SYNC.
        looks_ns: times when the cell looks for TPDOs.
        sync_ns: time when the SYNC is through.
        feedback_ns: time when the last TPDO of a drive is in.
        start_ns: time when the controller starts, at the first look that finds them all.
        compute_ns: longest computing time, as the scene says.
        commands_ns: time when the last RPDO is through.
        tactile_ns: time when the last PDO of a tactile frame is in.
        slack_ns: rest of the period; negative: the next SYNC comes too early.
    """

    period_ns: int
    looks_ns: tuple[int, ...]
    sync_ns: int | None
    feedback_ns: int | None
    start_ns: int | None
    compute_ns: int
    commands_ns: int | None
    tactile_ns: int | None
    slack_ns: int | None

    @property
    def bus_ns(self) -> int | None:
        """Time of the bus in a period: until the controller starts, and from its end to the last RPDO."""
        if self.start_ns is None or self.slack_ns is None:
            return None
        return self.period_ns - self.compute_ns - self.slack_ns


@dataclass(frozen=True, slots=True)
class PlannedBus:
    """One bus of the cell with its traffic, worst case.

    Attributes:
        channel: its name in the scene.
        node_ids: ids of its nodes.
        load: share of the bit rate of everything that repeats.
        parts: its parts, as (what, share).
        demands: peaks behind one SYNC.
        sync_response_ns: worst-case response time of SYNC.
    """

    channel: str
    node_ids: tuple[int, ...]
    load: float
    parts: tuple[tuple[str, float], ...]
    demands: tuple[Demand, ...]
    sync_response_ns: int | None


@dataclass(frozen=True, slots=True)
class Choice:
    """One value that the scene left to the plan.

    Attributes:
        key: key of the scene file.
        value: the chosen value.
        why: the reason, for people.
    """

    key: str
    value: Any
    why: str

    @property
    def written(self) -> str:
        """The value as a scene file writes it."""
        return toml_value(self.value)


@dataclass(frozen=True, slots=True)
class JointSpeeds:
    """Fastest motion of each joint in the task, and its limit, each in its unit: deg/s or mm/s."""

    needed: tuple[float, ...]
    limit: tuple[float, ...]
    units: tuple[str, ...]

    @property
    def worst_share(self) -> float:
        """Largest share of a joint's limit that the task needs; above 1 it is too fast."""
        return max(need / limit for need, limit in zip(self.needed, self.limit, strict=True))


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that follows from a scene before anything is started.

    Attributes:
        setup: the resolved scene in SI units, with every choice of the plan; its `scene` has them too.
        nodes: nodes that are brought up, with their configuration, by node id.
        pdos: PDOs of all nodes, by priority on the bus.
        raw: frames of an array that is no CANopen node.
        sync: rate and period of SYNC.
        buses: the bus of the first joint, then the others in the order of the joints, the array's last.
        budget: time budget of one cycle, over all buses.
        choices: values that the scene left to the plan, with reasons.
        joint_speeds: needed and allowed joint speeds; None without an arm.
        outputs: files that a run writes.
        left_out: what this scene does not bring up, and why.
        not_available: what the devices lack by their EDS files, and what that means.
        warnings: what is carried out although a number of the plan does not hold for it.
    """

    setup: Setup
    nodes: tuple[NodeConfiguration, ...]
    pdos: tuple[PlannedPdo, ...]
    raw: tuple[PlannedFrames, ...]
    sync: SyncPlan
    buses: tuple[PlannedBus, ...]
    budget: CycleBudget
    choices: tuple[Choice, ...]
    joint_speeds: JointSpeeds | None
    outputs: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    not_available: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]

    @property
    def scene(self) -> Scene:
        """The scene with every choice of the plan filled in."""
        return self.setup.scene

    def with_seed(self, seed: int) -> Plan:
        """The plan with another seed of the emulation, on which nothing else in it depends."""
        return replace(self, setup=replace(self.setup.with_choices({"scene.seed": seed}), seed=seed))

    @property
    def files(self) -> dict[str, bytes]:
        """The files of the scene by name, `SAVED_AS` and those that it names, as they were read for this plan."""
        text = f"{written_by_line()}\n{dump_scene(self.setup.saved)}"
        return {SAVED_AS: text.encode(), **self.setup.files}

    @property
    def traffic(self) -> PlannedBus:
        """The first bus, which is that of the first joint, with its traffic."""
        return self.buses[0]

    @property
    def cycles(self) -> int:
        """About the number of cycles of the whole task, with the ways to the object and back."""
        return round((self.setup.task.duration_s + TASK_OVERHEAD_S) * self.sync.rate_hz)

    @property
    def emulated_channels(self) -> tuple[str, ...]:
        """Channels of the buses on which something is emulated."""
        channels = dict.fromkeys(node.channel for node in self.nodes if node.emulated)
        array = self.setup.array
        if array is not None and array.raw is not None and array.emulated:
            channels[array.channel] = None
        return tuple(channels)

    @property
    def node_ids(self) -> tuple[int, ...]:
        """Ids of the nodes that are brought up."""
        return tuple(node.node_id for node in self.nodes)

    def pdos_of(self, node_id: int, direction: Direction) -> tuple[PlannedPdo, ...]:
        """The PDOs of one node in one direction that the scene uses, by number."""
        found = [pdo for pdo in self.pdos if pdo.node_id == node_id and pdo.direction == direction and pdo.used]
        return tuple(sorted(found, key=lambda pdo: pdo.number))
