"""A plan's frames as named signals, and as DBC or KCD by cantools: for SavvyCAN, Vector's tools, Kayak and whatever
reads those.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from canprobe.bus.disk import write_text
from canprobe.errors import UsageError
from canprobe.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan, PlannedPdo
from canprobe.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SYNC_ID, NmtState
from canprobe.protocol.pdo import PdoEntry

# Packages of optional extras: imported where they are used, with the pip line where they are missing.


def need(module: str, extra: str, purpose: str) -> Any:
    """Import a package that belongs to an extra.

    Args:
        module: its import name.
        extra: of canprobe's.
        purpose: what it is needed for, for the message.

    Raises:
        UsageError: it is not installed; with the line that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"{purpose} needs {module}: pip install 'canprobe[{extra}]'") from error


# Every frame of a plan as named signals: where each stands in the data, what it means, who sends and who reads it.
#
# Neutral: `database` makes DBC and KCD of it. Bit positions count from the least significant bit of byte 0, as CANopen
# does (little endian).

MASTER = "master"
_SYNCHRONOUS = 240
_UNITS = {0x6064: "counts", 0x607A: "counts", 0x6077: "permille"}
_STATES = {int(state): state.name.lower() for state in NmtState}
_Field = tuple[str, int, bool, str]  # name, bits, signed, unit
_COUNTERS: tuple[_Field, ...] = (("frame_counter", 8, False, ""), ("sync_counter", 8, False, ""))
_REST: tuple[_Field, ...] = (
    ("mode", 2, False, ""),
    ("overload", 1, False, ""),
    ("reserved", 1, False, ""),
    ("window", 4, False, ""),
    ("sample_age", 16, False, "us"),
    ("crc", 16, False, ""),
)
_PACKED: dict[tuple[int, int], tuple[_Field, ...]] = {  # as `protocol.tactile_wire` packs them
    (0x2120, 0): (*_COUNTERS, ("origin_col", 4, False, ""), ("origin_row", 4, False, ""), *_REST),
    (0x2130, 1): (*_COUNTERS, ("peak", 8, False, "counts"), *_REST),
    (0x2130, 2): (
        ("force", 12, False, ""),
        ("centroid_row", 11, False, ""),
        ("centroid_col", 11, False, ""),
        ("variance_row", 10, False, ""),
        ("covariance", 10, True, ""),
        ("variance_col", 10, False, ""),
    ),
}
_TAXELS = (0x2100, 0x2110)


@dataclass(frozen=True, slots=True)
class FrameSignal:
    """One value in a frame.

    Attributes:
        name: letters, digits and underscores.
        start, bits: where it stands.
        signed: two's complement.
        unit: empty where it has none.
        comment: the object it comes from.
        receivers: names of nodes.
        choices: words for values, None where there are none.
    """

    name: str
    start: int
    bits: int
    signed: bool
    unit: str
    comment: str
    receivers: tuple[str, ...]
    choices: dict[int, str] | None = None


@dataclass(frozen=True, slots=True)
class FrameDescription:
    """One identifier on the bus.

    Attributes:
        name: such as ``joint_1_TPDO1``.
        cob_id: 11 bits.
        length: data bytes.
        sender: name of a node.
        period_ms: between two frames; None where it comes on an event.
        comment: for people.
        signals: in the order of the data.
        channel: the bus; of what goes to every bus, the first one.
    """

    name: str
    cob_id: int
    length: int
    sender: str
    period_ms: float | None
    comment: str
    signals: tuple[FrameSignal, ...]
    channel: str


def node_names(plan: Plan) -> dict[int, str]:
    """The plan's nodes and the master as identifiers of a database."""
    return {MASTER_NODE_ID: MASTER} | {node.node_id: identifier(node.role) for node in plan.nodes}


def identifier(text: str) -> str:
    """Letters, digits and underscores only, not beginning with a digit."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or "signal"
    return f"_{name}" if name[0].isdigit() else name


def describe_frames(plan: Plan) -> list[FrameDescription]:
    """SYNC, every PDO, emergencies and heartbeats, by identifier. An RPDO that two drives read is one frame."""
    names = node_names(plan)
    shared: dict[int, list[PlannedPdo]] = {}
    for pdo in plan.pdos:
        shared.setdefault(pdo.cob_id, []).append(pdo)
    frames = [_sync(plan, names), *(_pdo_frame(pdos, names) for pdos in shared.values())]
    channels = {node.node_id: node.channel for node in plan.nodes} | {MASTER_NODE_ID: plan.buses[0].channel}
    frames += [_emergency(node_id, names, channels[node_id]) for node_id in plan.node_ids]
    frames += [_heartbeat(node_id, names, channels[node_id]) for node_id in (*plan.node_ids, MASTER_NODE_ID)]
    return sorted(frames, key=lambda frame: frame.cob_id)


def _sync(plan: Plan, names: dict[int, str]) -> FrameDescription:
    readers = tuple(names[node_id] for node_id in plan.node_ids)
    counter = FrameSignal("counter", 0, 8, False, "", "1 to 1019h", readers)
    period_ms = plan.sync.period_ns / 1e6
    comment, channel = "synchronisation object", plan.buses[0].channel
    return FrameDescription("SYNC", SYNC_ID, 1, MASTER, period_ms, comment, (counter,), channel)


def _pdo_frame(pdos: list[PlannedPdo], names: dict[int, str]) -> FrameDescription:
    first = min(pdos, key=lambda pdo: pdo.node_id)
    owners = "_".join(names[pdo.node_id] for pdo in sorted(pdos, key=lambda pdo: pdo.node_id))
    signals = [signal for pdo in pdos for signal in _pdo_signals(pdo, names, several=len(pdos) > 1)]
    cyclic = first.transmission_type <= _SYNCHRONOUS
    return FrameDescription(
        name=f"{owners}_{first.direction.upper()}{first.number}",
        cob_id=first.cob_id,
        length=first.layout.length,
        sender=names[first.node_id] if first.direction == "tpdo" else MASTER,
        period_ms=1000 / first.rate_hz if cyclic else None,
        comment=f"transmission type {first.transmission_type}, {first.rate_hz:g} a second",
        signals=tuple(sorted(signals, key=lambda signal: signal.start)),
        channel=first.channel,
    )


def _pdo_signals(pdo: PlannedPdo, names: dict[int, str], *, several: bool) -> Iterator[FrameSignal]:
    receivers = (MASTER,) if pdo.direction == "tpdo" else (names[pdo.node_id],)
    suffix = f"_{names[pdo.node_id]}" if several else ""
    start = 0
    for entry in pdo.entries:
        if not entry.is_dummy:
            comment = f"{entry.index:04X}h:{entry.subindex:02X} {entry.name}".strip()
            for offset, (name, bits, signed, unit) in _parts(entry):
                yield FrameSignal(name + suffix, start + offset, bits, signed, unit, comment, receivers)
        start += entry.bits


def _parts(entry: PdoEntry) -> Iterator[tuple[int, _Field]]:
    """An entry as (offset, field): taxels one by one, what the array packs by its parts, everything else as it is."""
    offset = 0
    for part in _PACKED.get((entry.index, entry.subindex)) or _taxels(entry) or (_whole(entry),):
        yield offset, part
        offset += part[1]


def _taxels(entry: PdoEntry) -> tuple[_Field, ...]:
    count = entry.bits // 8 if entry.index in _TAXELS and entry.bits % 8 == 0 else 0
    first = (entry.subindex - 1) * count
    return tuple((f"taxel_{first + i}", 8, False, "counts") for i in range(count))


def _whole(entry: PdoEntry) -> _Field:
    name = identifier(entry.name or f"object_{entry.index:04X}")
    return name, entry.bits, entry.signed, _UNITS.get(entry.index, "")


def _emergency(node_id: int, names: dict[int, str], channel: str) -> FrameDescription:
    fields = (("error_code", 0, 16), ("error_register", 16, 8), ("manufacturer", 24, 40))
    signals = tuple(FrameSignal(name, start, bits, False, "", "", (MASTER,)) for name, start, bits in fields)
    name = f"{names[node_id]}_EMCY"
    return FrameDescription(name, EMCY_BASE + node_id, 8, names[node_id], None, "emergency object", signals, channel)


def _heartbeat(node_id: int, names: dict[int, str], channel: str) -> FrameDescription:
    readers = (MASTER,) if node_id != MASTER_NODE_ID else tuple(n for i, n in names.items() if i != MASTER_NODE_ID)
    state = FrameSignal("nmt_state", 0, 7, False, "", "", readers, _STATES)
    name = f"{names[node_id]}_heartbeat"
    return FrameDescription(
        name, HEARTBEAT_BASE + node_id, 1, names[node_id], HEARTBEAT_PRODUCED_MS, "NMT error control", (state,), channel
    )


# A plan as DBC or KCD, by cantools: for SavvyCAN, Vector's tools, Kayak, cantools itself and whatever reads those.

FORMATS = ("dbc", "kcd")
_PURPOSE = "a DBC or KCD file"
_CLASSIC_BYTES = 8
_FRAME_FORMATS = ["StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD", "ExtendedCAN_FD"]
_FD_ATTRIBUTES = f"""VERSION ""
BU_:
BA_DEF_ "BusType" STRING ;
BA_DEF_ BO_ "VFrameFormat" ENUM {",".join(f'"{name}"' for name in _FRAME_FORMATS)};
BA_DEF_DEF_ "BusType" "CAN";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "BusType" "CAN FD";
"""


def plan_database(plan: Plan) -> Any:
    """The frames of a plan as a cantools database.

    Args:
        plan: whose frames.

    Returns:
        `cantools.database.can.Database`, with a message for SYNC, each PDO, emergencies and heartbeats.

    Raises:
        UsageError: cantools is not installed.
    """
    can = need("cantools.database.can", "can", _PURPOSE)
    nodes = [can.Node(name) for name in node_names(plan).values()]
    messages = [_message(can, frame) for frame in describe_frames(plan)]
    buses = [can.Bus(identifier(bus.channel), baudrate=plan.scene.bus.bitrate) for bus in plan.buses]
    attributes = need("cantools.database", "can", _PURPOSE).load_string(_FD_ATTRIBUTES, "dbc").dbc
    specifics = attributes if any(message.is_fd for message in messages) else None
    return can.Database(messages=messages, nodes=nodes, buses=buses, version=plan.scene.name, dbc_specifics=specifics)


def write_database(plan: Plan, folder: Path, form: str) -> Path:
    """Write ``<scene>.dbc`` or ``<scene>.kcd``.

    Args:
        plan: whose frames.
        folder: exists.
        form: one of `FORMATS`.

    Returns:
        The file.
    """
    database = plan_database(plan)
    text = database.as_dbc_string() if form == "dbc" else database.as_kcd_string()
    path = folder / f"{plan.scene.name}.{form}"
    write_text(path, text, encoding="cp1252" if form == "dbc" else "utf-8", newline="")
    return path


def _message(can: Any, frame: FrameDescription) -> Any:
    return can.Message(
        frame_id=frame.cob_id,
        name=frame.name,
        length=frame.length,
        signals=[_signal(can, signal) for signal in frame.signals],
        comment=frame.comment,
        senders=[frame.sender],
        cycle_time=None if frame.period_ms is None else max(1, round(frame.period_ms)),
        is_fd=frame.length > _CLASSIC_BYTES,
        bus_name=identifier(frame.channel),
    )


def _signal(can: Any, signal: FrameSignal) -> Any:
    conversion = need("cantools.database.conversion", "can", _PURPOSE).BaseConversion
    return can.Signal(
        name=signal.name,
        start=signal.start,
        length=signal.bits,
        is_signed=signal.signed,
        conversion=conversion.factory(choices=signal.choices),
        unit=signal.unit or None,
        comment=signal.comment or None,
        receivers=list(signal.receivers),
    )
