"""The drives of the arm as a group: TPDOs in and joint positions out, targets in and RPDOs out.

The drives hold *motor* positions; gears and couplings are undone here and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from canprobe.cell.master.following import Following
from canprobe.cell.master.position_track import PERIOD_NS, REST_NS, PositionTrack, rest_counts
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.sync import TARGETS, Place
from canprobe.cell.planning.units import lag_s
from canprobe.errors import ArmError, BusError, NodeError, ProtocolError
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveState, OperationMode
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.pdo import PdoLayout
from canprobe.mechanics.robot.model import ArmModel, joints_to_units, units_to_joints
from canprobe.mechanics.types import Floats

COMMAND_REPEAT_NS = 100_000_000
_FEEDBACK: tuple[Place, ...] = ((0x6041, 0), (0x6064, 0), (0x6077, 0))
_TARGETS = frozenset(TARGETS.values())
_UNTOLD = (None, DriveState.OPERATION_ENABLED)
MOVED_NS = 20_000_000
"""Time for which a drive reports the same place and counts as moving: one wrong report may repeat the last one."""
DOUBTED_CYCLES = 2
"""TPDOs in a row whose statusword is not believed either, where their position cannot be: fewer than make a hold."""
UNSTATED_LAG_S = 0.05
"""Longest usual lag of a drive without a feed-forward, s, where neither scene nor emulation states one."""
_QUICK_STOP, _DISABLE_VOLTAGE = 0x0002, 0x0000
_STATE_BITS, _ENABLED = 0x6F, DriveState.OPERATION_ENABLED.value
"""Bits of the statusword that encode the state, and their value in operation enabled; see `known_state` for others."""


@dataclass(frozen=True, slots=True)
class DriveAxis:
    """The PDOs of a drive.

    Attributes:
        node_id: node id of the drive; 0: it is a coordinate of an external arm.
        feedback: layouts of its TPDOs, which between them have statusword, position (counts) and, where the drive can
            send it, torque (permille). What else they have is not read.
        commands: layouts of its RPDOs, which between them map controlword and target position (counts). Drives whose
            RPDOs share a COB-ID (the foreign half a dummy) get one frame together.
        mode: mode of operation (6060h).
        constants: values of the other entries of the RPDOs, by (index, sub-index).
    """

    node_id: int
    feedback: tuple[PdoLayout, ...]
    commands: tuple[PdoLayout, ...]
    mode: int = OperationMode.CYCLIC_SYNC_POSITION
    constants: Mapping[Place, int] = field(default_factory=dict)

    def error(self, reason: str) -> BusError:
        """The error of the drive, or of the external arm."""
        return NodeError(self.node_id, reason) if self.node_id else ArmError(reason)


@dataclass(frozen=True, slots=True)
class FeedbackFrame:
    """A TPDO frame of a drive.

    Attributes:
        axis: number of the drive, from 0.
        layout: layout of the frame; longer frames are taken too.
        word, counts, torque: places of statusword, position and torque among its values; None: another TPDO has them.
    """

    axis: int
    layout: PdoLayout
    word: int | None
    counts: int | None
    torque: int | None

    def unpack(self, data: bytes) -> tuple[int, ...]:
        """Its values; what is beyond the mapping is not read.

        Raises:
            ProtocolError: the frame is too short.
        """
        layout = self.layout
        if len(data) == layout.length:
            return layout.raw_unpack(data)
        return layout.unpack(data[: layout.length])


def feedback_frames(axes: Sequence[DriveAxis]) -> tuple[FeedbackFrame, ...]:
    """The TPDO frames of all drives."""
    frames = []
    for i, axis in enumerate(axes):
        taken: set[Place] = set()
        for layout in axis.feedback:
            places = [(entry.index, entry.subindex) for entry in layout.signals]
            own = [None if p in taken or p not in places else places.index(p) for p in _FEEDBACK]
            taken.update(places)
            frames.append(FeedbackFrame(i, layout, *own))
    return tuple(frames)


class SetPointOffer:
    """The handshake by which a drive in profile position takes targets (CiA 402-2, "Profile position mode").

    Bit 4 of the controlword offers a target, until bit 12 of the statusword acknowledges it; then it falls, and the
    next one is offered: a target takes two cycles at least, and a lost frame is made good by the next. Bit 5 puts it in
    place of the one under way. An offered target stands until it is acknowledged, as a drive takes it when it likes.
    """

    def __init__(self) -> None:
        self._target: int | None = None
        self._offered = False

    def step(self, statusword: int, word: int, target: int) -> tuple[int, int]:
        """Controlword and target of a cycle.

        Args:
            statusword: the last one of the drive.
            word: controlword towards the goal of the drive; it gets targets where that keeps it enabled.
            target: where it is sent, counts.
        """
        enabled = cia402.known_state(statusword) is DriveState.OPERATION_ENABLED
        if not enabled or word & cia402.ENABLE_WORD != cia402.ENABLE_WORD:
            self._target, self._offered = None, False
        elif statusword >> cia402.SETPOINT_ACKNOWLEDGE_BIT & 1:
            self._offered = False
        elif target != self._target and not self._offered:
            self._target, self._offered = target, True
        if not self._offered or self._target is None:
            return word, target
        return word | 1 << cia402.NEW_SETPOINT_BIT | 1 << cia402.CHANGE_IMMEDIATELY_BIT, self._target


DriveCommand = tuple[int, list[Callable[..., bytes]], list[tuple[int, ...]]]
"""One RPDO, for one drive or for two: COB-ID, what packs the part of each, and the values of each part."""


class DriveGroup:
    """The arm's CiA 402 drives as their TPDOs report them, in cyclic synchronous, interpolated or profile position.

    Args:
        axes: the drives, joint 1 first.
        model: the arm, for drive units ↔ joint positions.
        repeat_cycles: after how many cycles an event-driven RPDO is sent again without a change.
        period_ns: period of the cycle.
        lag_s: lag of the drives behind a ramp.

    Attributes:
        torque_permille: torque of each drive, NaN for one whose TPDO has no torque; empty where none has.
        late, missed, malformed: counts of TPDOs that came late, not at all, or too short.
        lateness_ns: time of the last late TPDO of each drive behind its SYNC, ns.
        implausible: count of TPDOs with a position that an enabled drive cannot have reached.
        sync_ns, deadline_ns: when the SYNC of this cycle was sent, and when it was due.
        answer_ns: time from the SYNC to the last TPDO that was used.
        tracks: positions of the motors as they are reported.
        targets: where the drives are sent.
    """

    def __init__(
        self,
        axes: tuple[DriveAxis, ...],
        model: ArmModel,
        repeat_cycles: int = 40,
        period_ns: int = PERIOD_NS,
        lag_s: float = 0.0,
    ) -> None:
        self.axes, self.model, self.period_ns = axes, model, period_ns
        self.statuswords = [0] * len(axes)
        sources = feedback_frames(axes)
        with_torque = [any(one.torque is not None for one in sources if one.axis == i) for i in range(len(axes))]
        self.torque_permille = [0 if sent else math.nan for sent in with_torque] if any(with_torque) else []
        self.late = self.missed = self.malformed = self.implausible = 0
        self.lateness_ns = dict.fromkeys(range(len(axes)), 0)
        self.answer_ns = 0
        self.tracks = tuple([PositionTrack(base, period_ns) for base in rest_counts(model)])
        self.cycle = -1
        self.sync_ns = self._sync_before_ns = self.deadline_ns = 0
        self._sources = {one.layout.cob_id: (k, one) for k, one in enumerate(sources)}
        self._heard = [-1] * len(sources)
        self._all_heard = False
        self._pending = 0
        self._open = False
        self._quickest_ns = period_ns
        self._irregular = False
        self.targets = DriveTargets(self, repeat_cycles, lag_s)

    @property
    def feedback_ids(self) -> frozenset[int]:
        """COB-IDs of the TPDOs that belong to the group."""
        return frozenset(self._sources)

    def begin(self, cycle: int, t_ns: int = 0, deadline_ns: int | None = None) -> None:
        """Begin a cycle: a SYNC was sent at ``t_ns`` for ``deadline_ns``, and every TPDO is expected once."""
        self.cycle = cycle
        self.deadline_ns = t_ns if deadline_ns is None else deadline_ns
        self._sync_before_ns, self.sync_ns = self.sync_ns, t_ns
        self._pending = len(self._heard)
        self._open, self._irregular = True, False

    @property
    def complete(self) -> bool:
        """Every TPDO of this cycle is in."""
        return self._pending == 0

    def push(self, can_id: int, data: bytes, t_ns: int = 0) -> None:
        """Take one TPDO that arrived at ``t_ns``.

        One from before the SYNC or after the collection window, or a second one for a SYNC, is late and not used; nor
        is a shorter one. One with a position that an enabled drive cannot have reached is not used, up to
        `DOUBTED_CYCLES` in a row where its statusword says that the drive is in another state.
        """
        k, source = self._sources[can_id]
        if not self._open or t_ns < self.sync_ns or self._heard[k] == self.cycle:
            self.late += 1
            self._irregular = True
            self.lateness_ns[source.axis] = t_ns - (self.sync_ns if t_ns >= self.sync_ns else self._sync_before_ns)
            return
        try:
            values = source.unpack(data)
        except ProtocolError:
            self.malformed += 1  # and missed, unless another one comes
            return
        self.take(can_id, values, t_ns)

    def take(self, cob_id: int, values: tuple[int, ...], t_ns: int) -> None:
        """The values of one TPDO at `t_ns`, the first of it for its SYNC; TPDOs of others are not read."""
        if (found := self._sources.get(cob_id)) is None:
            return
        k, source = found
        i = source.axis
        self._heard[k] = self.cycle
        self._pending -= 1
        self.answer_ns = t_ns - self.sync_ns
        word = self.statuswords[i] if source.word is None else values[source.word]
        if source.counts is not None:
            track, counts = self.tracks[i], values[source.counts]
            doubtful = self.cycle - track.cycle <= DOUBTED_CYCLES or cia402.known_state(word) in _UNTOLD
            enabled = self.statuswords[i] & _STATE_BITS == _ENABLED and doubtful
            guarded = enabled and self.targets.sent is not None  # a log does not say where it was to go
            if not track.take(counts, self.cycle, self.deadline_ns, guarded=guarded):
                self.implausible += 1
                return  # nor is the rest of it believed
        self.statuswords[i] = word
        if source.torque is not None:
            self.torque_permille[i] = values[source.torque]

    def end_collect(self) -> None:
        """End the collection window of this cycle: a TPDO that has not come counts as missed."""
        self.missed += self._pending
        self._open = False
        if self._pending:
            self._irregular = True
        elif self.answer_ns < self._quickest_ns:
            self._quickest_ns = self.answer_ns

    @property
    def heard_all(self) -> bool:
        """Every drive was heard at least once."""
        self._all_heard = self._all_heard or min(self._heard, default=-1) >= 0
        return self._all_heard

    def ages(self) -> tuple[int, ...]:
        """Cycles since each drive last reported a position that can be believed."""
        return tuple([self.cycle - track.cycle for track in self.tracks])

    @property
    def rests(self) -> tuple[bool, ...]:
        """Whether each drive has reported the same position for a while."""
        return tuple([track.rested_ns >= REST_NS for track in self.tracks])

    @property
    def brakeable(self) -> tuple[bool, ...]:
        """Whether each drive is enabled and moved a moment ago, by its reports: a target where it is brakes it."""
        moved = [track.cycle == self.cycle and track.rested_ns < MOVED_NS for track in self.tracks]
        return tuple([one and on for one, on in zip(moved, self.enabled_ones(), strict=True)])

    def joints(self) -> Floats:
        """Joint positions (n,), rad or m, at this SYNC; where a report is missing, carried on for a short time."""
        now, now_ns = self.cycle, self.deadline_ns
        counts = [t.counts if t.cycle == now else t.position(now, now_ns) for t in self.tracks]
        q = units_to_joints(self.model, counts)
        q.flags.writeable = False  # it goes into the log as it was measured, whatever a controller does with it
        return q

    @property
    def counts(self) -> tuple[int, ...]:
        """Position of each drive as it was last believed, counts."""
        return tuple([track.counts for track in self.tracks])

    def last_place(self, time_ns: int) -> tuple[Floats, Floats]:
        """Joint positions as last reported (n,), rad or m, and the way (n,) that each may have gone on in a time."""
        ways = np.abs(self.model.q_per_unit) @ np.array([track.way(time_ns) for track in self.tracks])
        return units_to_joints(self.model, self.counts), ways

    @property
    def states(self) -> tuple[DriveState | None, ...]:
        """CiA 402 state of each drive, from its last statusword; None where that is a word of no state."""
        return tuple([cia402.known_state(word) for word in self.statuswords])

    def first_not_in(self, state: DriveState) -> tuple[int, str]:
        """The first drive that is not in a state: its number from 0, and the state that it is in."""
        i = next(i for i, other in enumerate(self.states) if other is not state)
        return i, cia402.describe_state(self.statuswords[i])

    @property
    def enabled(self) -> bool:
        """Every drive reports operation enabled."""
        return all(self.enabled_ones()) or all(state is DriveState.OPERATION_ENABLED for state in self.states)

    def enabled_ones(self) -> tuple[bool, ...]:
        """Whether each drive reported operation enabled last."""
        return tuple([word & _STATE_BITS == _ENABLED for word in self.statuswords])

    @property
    def disbelieved(self) -> bool:
        """A drive reported last a position that it cannot have reached."""
        positions = [(k, source.axis) for k, source in self._sources.values() if source.counts is not None]
        return any(self._heard[k] > self.tracks[axis].cycle for k, axis in positions)

    @property
    def jitter_ns(self) -> int:
        """Time by which the drives may have seen the SYNC of this cycle later than usual."""
        return self.period_ns if self._irregular else max(self.answer_ns - self._quickest_ns, 0)


class DriveTargets:
    """Where the drives are sent, in state and position, the RPDOs that say so, and whether the drives follow.

    No RPDO goes to a drive before its position is known: the first target is where it is.

    Args:
        drives: what the drives report.
        repeat_cycles: after how many cycles an event-driven RPDO is sent again without a change.
        lag_s: lag of the drives behind a ramp.

    Attributes:
        goal: state that the drives are led into.
        stopped: node ids of drives that stop while the others go on.
        sent: targets of the last RPDOs, counts; None before the first ones.
    """

    def __init__(self, drives: DriveGroup, repeat_cycles: int, lag_s: float) -> None:
        axes = drives.axes
        self.goal = DriveState.OPERATION_ENABLED
        self.stopped: frozenset[int] = frozenset()
        self.sent: tuple[int, ...] | None = None
        self._drives = drives
        self._following = Following(drives.model, lag_s, drives.period_ns)
        self._sent_ns = 0
        self._counts: list[int] | None = None
        self._words = [0] * len(axes)
        self._constants: list[int] = []
        self._interpolated = [axis.mode == OperationMode.INTERPOLATED_POSITION for axis in axes]
        self._offers = {
            i: SetPointOffer() for i, axis in enumerate(axes) if axis.mode == OperationMode.PROFILE_POSITION
        }
        self._steady: tuple[object, ...] | None = None
        rpdos: dict[int, list[tuple[int, PdoLayout]]] = {}
        for i, axis in enumerate(axes):
            for layout in axis.commands:
                rpdos.setdefault(layout.cob_id, []).append((i, layout))
        self._plan = [
            (
                cob_id,
                parts[0][1].synchronous,  # in every cycle, else on change
                [layout.pack for _, layout in parts],
                [self._places_of(axes[i], i, layout) for i, layout in parts],
                tuple(i for i, _ in parts),
            )
            for cob_id, parts in sorted(rpdos.items())
        ]
        self._on_change: dict[int, tuple[list[tuple[int, ...]], int]] = {}
        self._repeat = repeat_cycles

    def _places_of(self, axis: DriveAxis, number: int, layout: PdoLayout) -> list[int]:
        """Places of the values of a part in the list of controlwords, targets and constants."""
        places, n = [], len(self._words)
        for entry in layout.signals:
            place = entry.index, entry.subindex
            if place == (0x6040, 0):
                places.append(number)
            elif place in _TARGETS:
                places.append(n + number)
            else:
                places.append(2 * n + len(self._constants))
                self._constants.append(axis.constants[place])
        return places

    def set(self, q: Floats | None) -> None:
        """Joint target (n,), rad or m, of the next RPDOs; None holds the last one."""
        if q is not None:
            self._counts = [round(c) for c in joints_to_units(self._drives.model, q).tolist()]

    def forget(self) -> None:
        """Let the target of each drive be its reported position again, as before the first one was set."""
        self._counts = self.sent = None
        self._following.forget()

    @property
    def aimed(self) -> Floats:
        """Targets (n,) of the last RPDOs, counts; before the first ones the positions."""
        return np.array(self.sent or self._drives.counts, dtype=float)

    def beyond_lag(self) -> dict[int, float]:
        """Drives, by number from 0, that follow their targets less than their lag explains, and how much less, counts.

        Only those count that were heard in this cycle, and are enabled and not stopped.
        """
        drives, found = self._drives, {}
        for i, (axis, track, on) in enumerate(zip(drives.axes, drives.tracks, drives.enabled_ones(), strict=True)):
            heard = track.cycle == drives.cycle and on and axis.node_id not in self.stopped
            if heard and (beyond := self._following.beyond(i, track.counts, drives.sync_ns, drives.jitter_ns)):
                found[i] = beyond
        return found

    def aim(self, targets: Sequence[int]) -> None:
        """Note the `targets` (counts) of this cycle: they bound the motion that the drives may report next."""
        drives, before = self._drives, self.sent
        periods = max((drives.deadline_ns - self._sent_ns) / drives.period_ns, 1.0)
        if before is None:
            before, periods = drives.counts, 1.0
        for track, target, last in zip(drives.tracks, targets, before, strict=True):
            track.aim(abs(target - last), periods)
        self.sent, self._sent_ns = tuple(targets), drives.deadline_ns
        now = [track.counts if track.cycle == drives.cycle else None for track in drives.tracks]
        self._following.aim(self.sent, now, drives.sync_ns, drives.jitter_ns)

    def frames(self) -> list[Frame]:
        """The RPDOs of this cycle, as `commands`, packed."""
        frames = []
        for cob_id, packs, parts in self.commands():
            data, *others = [pack(*values) for pack, values in zip(packs, parts, strict=True)]
            for other in others:  # each leaves zeros where the values of the other are
                bits = int.from_bytes(data, "little") | int.from_bytes(other, "little")
                data = bits.to_bytes(len(data), "little")
            frames.append((cob_id, data))
        return frames

    def commands(self) -> list[DriveCommand]:
        """The RPDOs of this cycle.

        Until a target is set, the target of a drive is its reported position. A drive that was never heard gets none.
        """
        drives = self._drives
        targets = drives.counts if self._counts is None else self._counts
        self.aim(targets)
        key = (self.goal, self.stopped, *drives.statuswords)
        if key != self._steady:  # in operation neither goal nor statuswords change, so neither do the controlwords
            goals = [self._goal_of(axis.node_id) for axis in drives.axes]
            words = list(map(_controlword, drives.states, goals, self._words, self._interpolated))
            # not while words change: a fault reset needs an edge every second cycle, all with one statusword
            self._steady = key if words == self._words else None
            self._words = words
        values = [*self._words, *targets, *self._constants]
        for i, offer in self._offers.items():
            values[i], values[len(self._words) + i] = offer.step(drives.statuswords[i], values[i], targets[i])
        heard_all = drives.heard_all
        commands = []
        for cob_id, every_cycle, packs, places, axes in self._plan:
            if not heard_all and any(drives.tracks[axis].cycle < 0 for axis in axes):
                continue
            parts = [tuple([values[place] for place in part]) for part in places]
            if every_cycle or self._due(cob_id, parts):
                commands.append((cob_id, packs, parts))
        return commands

    def _goal_of(self, node_id: int) -> DriveState:
        held_back = node_id in self.stopped and self.goal is DriveState.OPERATION_ENABLED
        return DriveState.QUICK_STOP_ACTIVE if held_back else self.goal

    def _due(self, cob_id: int, parts: list[tuple[int, ...]]) -> bool:
        """An event-driven frame goes on a change, and again before its receiver's event timer runs out."""
        sent, cycle = self._on_change.get(cob_id, ([], 0))
        if parts == sent and self._drives.cycle - cycle < self._repeat:
            return False
        self._on_change[cob_id] = (parts, self._drives.cycle)
        return True


def _controlword(state: DriveState | None, goal: DriveState, previous: int, interpolated: bool) -> int:
    """The controlword for a drive; one in an unknown state is stopped, which is right in every state.

    In interpolated position bit 4 lets an enabled drive follow its targets.
    """
    if state is None:
        return _QUICK_STOP if goal is not DriveState.SWITCH_ON_DISABLED else _DISABLE_VOLTAGE
    word = cia402.controlword_toward(state, goal, previous)
    follows = interpolated and state is goal is DriveState.OPERATION_ENABLED
    return word | 1 << cia402.ENABLE_INTERPOLATION_BIT if follows else word


def make_drives(plan: Plan) -> DriveGroup | None:
    """The plan's drives as a group; None without an arm."""
    arm = plan.setup.arm
    if arm is None:
        return None
    period_ns = plan.sync.period_ns
    repeat_cycles = max(1, COMMAND_REPEAT_NS // period_ns)
    return DriveGroup(drive_axes(plan), arm.model, repeat_cycles, period_ns, lag_s(plan.setup, UNSTATED_LAG_S))


def drive_axes(plan: Plan) -> tuple[DriveAxis, ...]:
    """The PDOs of the plan's drives, joint by joint; empty without an arm."""
    modes = {node.node_id: node.mode for node in plan.nodes}
    axes = []
    for node_id in [drive.node_id for drive in plan.setup.drives]:
        rpdos, mode = plan.pdos_of(node_id, "rpdo"), modes[node_id]
        assert mode is not None
        axes.append(
            DriveAxis(
                node_id,
                feedback=tuple(pdo.layout for pdo in plan.pdos_of(node_id, "tpdo")),
                commands=tuple(pdo.layout for pdo in rpdos),
                mode=mode,
                constants={place: value for pdo in rpdos for place, value in pdo.constants},
            )
        )
    return tuple(axes)
