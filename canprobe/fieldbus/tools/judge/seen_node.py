"""One node as it is seen on the bus: its states, the objects that passed, its PDOs, and whether it moves."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from canprobe.errors import ProtocolError
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveState, OperationMode, known_state
from canprobe.fieldbus.protocol.frames import INVALID_FLAG, NmtState
from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS, RPDOS, TO_MAPPING, TPDOS, PdoEntry, PdoLayout
from canprobe.fieldbus.protocol.sdo import Place
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame

TARGETS = frozenset({cia402.TARGET_POSITION, cia402.TARGET_VELOCITY, cia402.TARGET_TORQUE, cia402.INTERPOLATION_DATA})
TARGET_OF_MODE = {
    OperationMode.PROFILE_POSITION: cia402.TARGET_POSITION,
    3: cia402.TARGET_VELOCITY,
    4: cia402.TARGET_TORQUE,
    OperationMode.INTERPOLATED_POSITION: cia402.INTERPOLATION_DATA,
    OperationMode.CYCLIC_SYNC_POSITION: cia402.TARGET_POSITION,
    OperationMode.CYCLIC_SYNC_VELOCITY: cia402.TARGET_VELOCITY,
    OperationMode.CYCLIC_SYNC_TORQUE: cia402.TARGET_TORQUE,
}
_SIGNED = frozenset({cia402.MODE, cia402.MODE_DISPLAY, cia402.POSITION, cia402.VELOCITY, 0x6077, 0x60C2}) | TARGETS
"""Objects that are signed where no EDS says it. 60C2h:02 is, too."""
_HEARTBEAT_TIME = 0x1017
_SPEED_LIMIT, _SPEED_UNIT, _SOFT_LIMITS, _RANGE = 0x607F, 0x60A9, 0x607D, 0x607B
_UNLIMITED = 0x7FFFFFFF
_NOISE = 20
"""Least tolerance of a position, user units: an axis that is held is never quite still."""
_FRESH_NS = 300_000_000
"""Age up to which positions show whether an axis moves."""
_LOST_BEATS = 3
"""Heartbeats without one frame of a node after which it may be in any state."""
_MOVING_SHARE = 0.01
"""Share of the largest speed from which on an axis moves."""


@dataclass(frozen=True, slots=True)
class Known:
    """A value of an object, and the frame that showed it."""

    value: int
    frame: BusFrame

    @property
    def t_ns(self) -> int:
        """Time of the frame."""
        return self.frame.t_ns


@dataclass(frozen=True, slots=True)
class PdoView:
    """A valid PDO of a node.

    Attributes:
        number: number, 1 for 1400h or 1800h.
        layout: its mapping.
        event_timer_ms: 14xxh:05 or 18xxh:05.
        certain: whether its parameters passed on the bus or belong to a served node; else they are those of the EDS.
        used: whether the master has read or written its parameters.
    """

    number: int
    layout: PdoLayout
    event_timer_ms: int
    certain: bool
    used: bool

    def maps(self, *indices: int) -> bool:
        """Whether it maps one of these objects."""
        return any(entry.index in indices for entry in self.layout.entries)


class SeenNode:
    """What is known about a node.

    Args:
        node_id: id.
        description: its EDS, as read for this id.
        served: whether it is an emulated node that is served here, so that its values after a boot-up are the EDS's.

    Attributes:
        nmt: NMT state as last seen, or commanded; None before.
        booted: whether a boot-up was seen.
        seen: whether the node has sent anything.
        heard_ns: time of its last frame.
        answers: whether it has sent anything but a boot-up.
        asked: whether it got an SDO request.
        started_ns: time of the last NMT start; None while it is not started.
        syncs: number of SYNCs since then.
        heartbeats_ns: times of the last heartbeats.
        addressed: whether the master has sent anything to this node.
        touched: indices of the objects that the master has read or written.
        configured: whether the master has written an object by SDO.
        rpdos, tpdos: valid PDOs by COB-ID.
        rpdo_counts: number of frames by number of the RPDO since the last boot-up.
    """

    def __init__(self, node_id: int, description: Description, *, served: bool) -> None:
        self.node_id, self.name = node_id, f"node {node_id}"
        self._description = description
        self._served = served
        self.nmt: NmtState | None = None
        self.nmt_ns = self.heard_ns = 0
        self.booted = self.seen = self.answers = self.asked = self.addressed = self.configured = self.stored = False
        self.started_ns: int | None = None
        self.syncs = 0
        self.heartbeats_ns: deque[int] = deque(maxlen=8)
        self.touched: set[int] = set()
        self._known: dict[Place, Known] = {}
        self.rpdo_counts: Counter[int] = Counter()
        self.rpdos: dict[int, PdoView] = {}
        self.tpdos: dict[int, PdoView] = {}
        self.positions: deque[tuple[int, int]] = deque(maxlen=6)
        self.read_pdos()

    def boot(self) -> None:
        """Forget what a boot-up resets."""
        self.booted = True
        self.started_ns = None
        self.positions.clear()
        self.rpdo_counts.clear()
        kept = range(0x1000, 0x6000) if self.stored else ()
        self._known = {place: known for place, known in self._known.items() if place[0] in kept}
        self.read_pdos()

    def hear(self, t_ns: int) -> None:
        """Note a frame of the node; behind a silence its last statusword says nothing any more."""
        if self.silent(t_ns):
            self._known.pop((cia402.STATUSWORD, 0), None)
        self.seen, self.heard_ns = True, t_ns

    def silent(self, t_ns: int) -> bool:
        """Whether heartbeats were missed since its last frame: a drive without its link stops, or loses its power."""
        beat_ms = self.number(_HEARTBEAT_TIME) or 0
        return beat_ms > 0 and self.seen and t_ns - self.heard_ns > _LOST_BEATS * beat_ms * 1_000_000

    def known(self, index: int, subindex: int = 0) -> Known | None:
        """The last value of an object that passed on the bus since the boot-up."""
        return self._known.get((index, subindex))

    def number(self, index: int, subindex: int = 0) -> int | None:
        """That value; None where none passed."""
        found = self._known.get((index, subindex))
        return found.value if found is not None else None

    def value(self, index: int, subindex: int = 0) -> int | None:
        """The last value that passed, or else that of the EDS; None where neither has one."""
        if (passed := self.number(index, subindex)) is not None:
            return passed
        entry = self._description.entry(index, subindex)
        return entry.initial if entry is not None and isinstance(entry.initial, int) else None

    def sure_value(self, index: int, subindex: int = 0) -> int | None:
        """The last value that passed, or that of the EDS where it is true of the device; None where neither is."""
        return self.value(index, subindex) if self.is_sure(index) else self.number(index, subindex)

    def is_sure(self, index: int) -> bool:
        """Whether `value` is true of the device: it passed on the bus, the node has booted, or it is served here."""
        return self._served or self.booted or index in self.touched

    def take(self, place: Place, value: int, frame: BusFrame) -> None:
        """Take the value of an object, written or read. A mode that is asked for again keeps its first time."""
        if place[0] != cia402.MODE or self.number(cia402.MODE) != value:
            self._known[place] = Known(value, frame)
        if place[0] in PDO_OBJECTS:
            self.read_pdos()
        if place[0] == cia402.POSITION:
            self.positions.append((frame.t_ns, value))

    def value_of(self, place: Place, data: bytes) -> int | None:
        """The number in the bytes of an object; None where it is none."""
        if not 0 < len(data) <= 8:
            return None
        entry = self._description.entry(*place)
        if entry is not None and not entry.is_integer:
            return None
        if entry is not None and 0 < entry.bits < 8 * len(data):
            data = data[: (entry.bits + 7) // 8]
        return int.from_bytes(data, "little", signed=self._is_signed(place))

    def read_pdos(self) -> None:
        """Read the PDOs anew from their parameters."""
        self.rpdos = self._valid_pdos(self._description.rpdos, RPDOS)
        self.tpdos = self._valid_pdos(self._description.tpdos, TPDOS)

    def _valid_pdos(self, numbers: Sequence[int], area: range) -> dict[int, PdoView]:
        found = {}
        for number in numbers:
            index = area[number - 1]
            cob_id = self.value(index, 1)
            count = self.value(index + TO_MAPPING)
            if cob_id is None or cob_id & INVALID_FLAG or not count or count > 64:
                continue
            words = [self.value(index + TO_MAPPING, sub) or 0 for sub in range(1, count + 1)]
            entries = tuple(PdoEntry.from_word(word, self._is_signed((word >> 16, word >> 8 & 0xFF))) for word in words)
            try:
                layout = PdoLayout(cob_id & 0x7FF, entries, self.value(index, 2) or 0)
            except ProtocolError:
                continue
            touched = {index, index + TO_MAPPING} & self.touched
            certain = self._served or len(touched) == 2
            found[layout.cob_id] = PdoView(number, layout, self.value(index, 5) or 0, certain, bool(touched))
        return found

    def _is_signed(self, place: Place) -> bool:
        entry = self._description.entry(*place)
        return entry.signed if entry is not None else place[0] in _SIGNED

    @property
    def is_drive(self) -> bool:
        """Whether it is a CiA 402 drive."""
        return self._description.entry(cia402.CONTROLWORD) is not None

    @property
    def operational(self) -> bool:
        """Whether it is in the NMT state operational, as seen or commanded."""
        return self.nmt is NmtState.OPERATIONAL

    @property
    def settled(self) -> bool:
        """Whether it is operational and three SYNCs have passed since its start."""
        return self.operational and self.syncs > 3

    @property
    def state(self) -> DriveState | None:
        """State by the last statusword."""
        word = self.number(cia402.STATUSWORD)
        return known_state(word) if word is not None else None

    @property
    def enabled(self) -> bool:
        """Whether its last statusword is that of operation enabled."""
        return self.state is DriveState.OPERATION_ENABLED

    @property
    def mode(self) -> int | None:
        """Mode of operation: as the drive displays it, or else as it was asked for."""
        shown = self.number(cia402.MODE_DISPLAY)
        return shown if shown is not None else self.number(cia402.MODE)

    @property
    def mode_confirmed(self) -> bool:
        """Whether 6061h showed the mode since 6060h was written, or 6060h never was."""
        asked, shown = self.known(cia402.MODE), self.known(cia402.MODE_DISPLAY)
        if asked is None or asked.value == 0:
            return True
        return shown is not None and shown.value == asked.value and shown.t_ns >= asked.t_ns

    def target(self, mode: int | None) -> Known | None:
        """Last target of a mode."""
        index = TARGET_OF_MODE.get(mode or 0)
        return None if index is None else self.known(index, index == cia402.INTERPOLATION_DATA)

    def _speed_limit(self) -> int:
        """Largest speed (607Fh), user units a second; 0 where it is not known in these units."""
        speed = self.value(_SPEED_LIMIT) or 0
        return speed if 0 < speed < _UNLIMITED and not self.value(_SPEED_UNIT) else 0

    def step_limit(self, period_ns: int) -> float | None:
        """Way in a period at the largest speed, user units; None where the one or the other is not known."""
        return self._speed_limit() * period_ns * 1e-9 or None

    def tolerance(self, period_ns: int) -> float:
        """Difference of positions that is not a jump: the way of a period, or 0.1 % of the range."""
        limit = self.step_limit(period_ns)
        return max(limit, _NOISE) if limit is not None else 0.001 * self._range()

    def soft_limits(self) -> tuple[int, int] | None:
        """Limits of positions (607Dh); None where there are none."""
        low, high = self.value(_SOFT_LIMITS, 1), self.value(_SOFT_LIMITS, 2)
        return (low, high) if low is not None and high is not None and low < high else None

    def _range(self) -> float:
        low, high = self.soft_limits() or (self.value(_RANGE, 1), self.value(_RANGE, 2))
        return float(high - low) if low is not None and high is not None and low < high else float(1 << 32)

    @property
    def least_speed(self) -> float:
        """Speed from which on the axis moves, user units a second."""
        return _MOVING_SHARE * self._speed_limit() or 1e-4 * self._range()

    def moves(self, t_ns: int) -> bool:
        """Whether the axis moves: by 606Ch, or by the last positions."""
        least = self.least_speed
        shown = self.known(cia402.VELOCITY)
        if shown is not None and t_ns - shown.t_ns < _FRESH_NS:
            return abs(shown.value) > least
        fresh = [(t, at) for t, at in self.positions if t_ns - t < _FRESH_NS]
        if len(fresh) < 3:
            return False
        steps = [b - a for (_, a), (_, b) in pairwise(fresh)][-3:]
        took = (fresh[-1][0] - fresh[-1 - len(steps)][0]) * 1e-9
        same_way = all(step > 0 for step in steps) or all(step < 0 for step in steps)
        return took > 0 and same_way and abs(sum(steps)) / took > least
