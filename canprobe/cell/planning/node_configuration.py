"""A node of the plan as data: what it must be, and the writes that make it so."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Literal

from canopen import ObjectDictionary

from canprobe.errors import NodeError
from canprobe.fieldbus.protocol.cia402 import OperationMode

NodeKind = Literal["drive", "tactile", "encoder"]
Direction = Literal["tpdo", "rpdo"]

MOST_DAYS, DAY_MS = 0xFFFF, 86_400_000
_TOLERANCE = 1e-3
"""Share by which units may differ: a factor of the device is a quotient of integers."""


@dataclass(frozen=True, slots=True)
class Write:
    """One entry that bring-up writes and reads back.

    Attributes:
        index, subindex: the entry.
        value: integer value.
        purpose: what the device needs it for.
        absence: what follows where the device lacks the entry; None: the write is required.
        read_back: False for commands, whose entry answers another value than the written one.
        own_bits: bits that the device sets: it may refuse other values of them, or keep its own.
    """

    index: int
    subindex: int
    value: int
    purpose: str
    absence: str | None = None
    read_back: bool = True
    own_bits: int = 0

    @property
    def place(self) -> str:
        """The entry for messages, such as ``60C2h:01``."""
        return f"{self.index:04X}h:{self.subindex:02X}"


@dataclass(frozen=True, slots=True)
class FixedEntry:
    """One entry that the device cannot change and the scene relies on.

    Attributes:
        index, subindex: the entry.
        value: value that it must hold.
        says: who states the value.
        otherwise: what would be wrong, and what puts it right.
    """

    index: int
    subindex: int
    value: int
    says: str
    otherwise: str


@dataclass(frozen=True, slots=True)
class TurnUnits:
    """Position units of a motor turn as the cell states them, and the objects in which the device states them.

    Attributes:
        units: units of the cell per turn of the motor.
        gear: turns of the motor per turn of the joint.
        feed: index of the units per turn, 6092h, or 608Fh where the device has no 6092h; the quotient of :01 and :02.
        ratio: index of the motor turns per shaft turn, 6091h; None where the device lacks it, or 6092h.
    """

    units: float
    gear: float
    feed: int
    ratio: int | None

    def mismatch(self, feed: float, ratio: float) -> str | None:
        """Difference of a device's quotients from the cell, in words; None where they fit.

        The shaft of a device may be that of the motor, or that of the joint.

        Args:
            feed: value of the object `feed`, a quotient.
            ratio: value of the object `ratio`, a quotient; 1 without.
        """
        by_motor, by_joint = feed / ratio / self.units, feed / (self.units * self.gear)
        if min(abs(by_motor - 1), abs(by_joint - 1)) <= _TOLERANCE:
            return None
        objects = f"{self.feed:04X}h" + (f" and {self.ratio:04X}h" if self.ratio is not None else "")
        return (
            f"counts {feed / ratio:g} units a motor turn by its {objects}, the cell {self.units:g} (counts_per_turn):"
            " check which is right before it moves"
        )


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 1018h by the EDS, and the serial number of the scene; None where any value is good."""

    vendor_id: int | None
    product_code: int | None
    revision_number: int | None
    serial_number: int | None = None

    @property
    def numbers(self) -> tuple[int | None, int | None, int | None, int | None]:
        """Values of 1018h:01 to :04."""
        return self.vendor_id, self.product_code, self.revision_number, self.serial_number

    @property
    def stated(self) -> dict[int, int]:
        """The values that are checked, by sub-index."""
        return {sub: value for sub, value in enumerate(self.numbers, start=1) if value is not None}


@dataclass(frozen=True, slots=True)
class Interpolation:
    """A time as 60C2h expresses it: value · 10^index s.

    Attributes:
        value: value of 60C2h:01.
        index: value of 60C2h:02.
    """

    value: int
    index: int

    def __str__(self) -> str:
        return f"{self.value}·10{str(self.index).translate(_SUPERSCRIPT)} s"


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, slots=True)
class NodeConfiguration:
    """A node that is brought up: what it must be, and the writes that make it so.

    Attributes:
        node_id: node id, 1–126.
        kind: `drive`, `tactile` or `encoder`.
        name: its name for people: `joint 3`, `tactile array`.
        eds: name or path of its EDS.
        dictionary: object dictionary of the package canopen, as the EDS was read for this plan. Treat it as read-only.
        identity: what 1018h must answer.
        emulated: whether the emulator serves it.
        channel: channel of its bus.
        switched_off: PDOs of the EDS that the scene does not need, (direction, number).
        writes: its configuration, in order.
        given: what it must hold by itself.
        left_out: wished writes that the EDS excludes.
        mode: mode of operation, which 6061h must confirm; None: the node is no drive.
        interpolation: values of 60C2h that express the period, the first is tried first; empty: the node needs none.
        otherwise: writes of the other values of `interpolation`, tried in order where the device refuses the first.
        homing: writes for homing, in order; empty: the drive is not homed. Where the drive is coupled to other
            joints, the home offset depends on their positions; here they are in the start posture.
        turn: position units of a motor turn, to compare with those that the device states; None: not known.
        speed_unit: position units/s in one velocity unit of the drive.
        counts_range: number of counts after which the position value of an encoder begins again.
    """

    node_id: int
    kind: NodeKind
    name: str
    eds: str
    dictionary: ObjectDictionary = field(repr=False, compare=False)
    identity: Identity
    emulated: bool
    channel: str
    switched_off: tuple[tuple[Direction, int], ...]
    writes: tuple[Write, ...]
    given: tuple[FixedEntry, ...]
    left_out: tuple[Write, ...]
    mode: OperationMode | None = None
    interpolation: tuple[Interpolation, ...] = ()
    otherwise: tuple[tuple[Write, ...], ...] = ()
    homing: tuple[Write, ...] = ()
    turn: TurnUnits | None = None
    speed_unit: float = 1.0
    counts_range: int = 1 << 32

    def error(self, reason: str) -> NodeError:
        """The error of this node, by its name."""
        return NodeError(self.node_id, f"({self.name}) {reason}")

    @property
    def configuration_date(self) -> dict[int, int]:
        """Value of 1020h in a node with this configuration: days since 1984, milliseconds after midnight.

        They follow from the values, so that any change of them, of the EDS or of the scene, gives another date.
        """
        values = [(write.index, write.subindex, write.value) for write in self.writes if write.read_back]
        text = repr((self.eds, self.identity.stated, values)).encode()
        return {1: 1 + zlib.crc32(text) % MOST_DAYS, 2: 1 + zlib.adler32(text) % DAY_MS}
