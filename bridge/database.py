"""A plan's frames as a DBC or KCD file, by cantools: for SavvyCAN, Vector's tools, Kayak and other readers.

It has a message for SYNC, each PDO, emergencies and heartbeats; a signal for each mapped object, taxel, and each
field of what the array packs. Bit positions count from the least significant bit of byte 0, as CANopen does.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from canprobe.cell.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan, PlannedPdo
from canprobe.errors import needed_module
from canprobe.fieldbus.bus.files import write_text
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, EMCY_BASE, HEARTBEAT_BASE, SYNC_ID, NmtState
from canprobe.fieldbus.protocol.pdo import PdoEntry

FORMATS = ("dbc", "kcd")
_MASTER = "master"
_UNITS = {0x6064: "counts", 0x607A: "counts", 0x6077: "permille"}
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
_PACKED: dict[tuple[int, int], tuple[_Field, ...]] = {  # as `protocol.tactile` packs them
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
_FRAME_FORMATS = ["StandardCAN", "ExtendedCAN", *["reserved"] * 12, "StandardCAN_FD", "ExtendedCAN_FD"]
_FD_ATTRIBUTES = f"""VERSION ""
BU_:
BA_DEF_ "BusType" STRING ;
BA_DEF_ BO_ "VFrameFormat" ENUM {",".join(f'"{name}"' for name in _FRAME_FORMATS)};
BA_DEF_DEF_ "BusType" "CAN";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "BusType" "CAN FD";
"""


def identifier(text: str) -> str:
    """The text as an identifier: letters, digits and underscores, without a digit at the beginning."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or "signal"
    return f"_{name}" if name[0].isdigit() else name


def write_database(plan: Plan, folder: Path, form: str) -> Path:
    """Write ``<scene>.dbc`` or ``<scene>.kcd``.

    Args:
        plan: whose frames.
        folder: existing folder.
        form: format, one of `FORMATS`.

    Returns:
        The file.
    """
    database = plan_database(plan)
    text = database.as_dbc_string() if form == "dbc" else database.as_kcd_string()
    path = folder / f"{plan.scene.name}.{form}"
    write_text(path, text, encoding="cp1252" if form == "dbc" else "utf-8", newline="")
    return path


def plan_database(plan: Plan) -> Any:
    """The frames of a plan as a cantools database.

    Args:
        plan: whose frames.

    Returns:
        `cantools.database.can.Database`, with a message for SYNC, each PDO, emergencies and heartbeats.

    Raises:
        UsageError: when cantools is not installed.
    """
    return _Describer(plan).database()


class _Describer:
    """Makes cantools' messages and signals of one plan."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        cantools = needed_module("cantools.database", "can", "a DBC or KCD file needs cantools; type:")
        self._can, self._conversion = cantools.can, cantools.conversion.BaseConversion
        self._load = cantools.load_string
        self._names = {MASTER_NODE_ID: _MASTER} | {node.node_id: identifier(node.name) for node in plan.nodes}
        self._channels = {node.node_id: node.channel for node in plan.nodes} | {MASTER_NODE_ID: plan.buses[0].channel}

    def database(self) -> Any:
        plan, can = self._plan, self._can
        shared: dict[int, list[PlannedPdo]] = {}  # an RPDO that two drives read is one frame
        for pdo in plan.pdos:
            shared.setdefault(pdo.cob_id, []).append(pdo)
        messages = [self._sync(), *(self._pdos(pdos) for pdos in shared.values())]
        messages += [self._emergency(node_id) for node_id in plan.node_ids]
        messages += [self._heartbeat(node_id) for node_id in (*plan.node_ids, MASTER_NODE_ID)]
        has_fd = any(message.is_fd for message in messages)
        return can.Database(
            messages=sorted(messages, key=lambda message: message.frame_id),
            nodes=[can.Node(name) for name in self._names.values()],
            buses=[can.Bus(identifier(bus.channel), baudrate=plan.scene.bus.bitrate) for bus in plan.buses],
            version=plan.scene.name,
            dbc_specifics=self._load(_FD_ATTRIBUTES, "dbc").dbc if has_fd else None,
        )

    def _sync(self) -> Any:
        readers = [self._names[node_id] for node_id in self._plan.node_ids]
        counter = self._signal("counter", 0, 8, readers, comment="1 to 1019h")
        period_ms = _whole_ms(self._plan.sync.period_ns / 1e6)
        return self._message(
            SYNC_ID, "SYNC", 1, MASTER_NODE_ID, [counter], cycle_time=period_ms, comment="synchronisation object"
        )

    def _pdos(self, pdos: list[PlannedPdo]) -> Any:
        """One PDO, or the RPDO that several nodes read."""
        pdos_by_node = sorted(pdos, key=lambda pdo: pdo.node_id)
        first = pdos_by_node[0]
        signals = [signal for pdo in pdos for signal in self._pdo_signals(pdo, several=len(pdos) > 1)]
        owners = "_".join(self._names[pdo.node_id] for pdo in pdos_by_node)
        name = f"{owners}_{first.direction.upper()}{first.number}"
        sender = first.node_id if first.direction == "tpdo" else MASTER_NODE_ID
        comment = f"transmission type {first.transmission_type}, {first.rate_hz:g} a second"
        period_ms = _whole_ms(1000 / first.rate_hz) if first.layout.synchronous else None
        more = {"comment": comment, "cycle_time": period_ms, "bus_name": identifier(first.channel)}
        return self._message(first.cob_id, name, first.layout.length, sender, signals, **more)

    def _pdo_signals(self, pdo: PlannedPdo, *, several: bool) -> Iterator[Any]:
        readers = [_MASTER if pdo.direction == "tpdo" else self._names[pdo.node_id]]
        suffix = f"_{self._names[pdo.node_id]}" if several else ""
        start = 0
        for entry in pdo.entries:
            comment = f"{entry.index:04X}h:{entry.subindex:02X} {entry.name}".strip()
            for name, bits, signed, unit in _fields(entry):
                if not entry.is_dummy:
                    yield self._signal(
                        name + suffix, start, bits, readers, is_signed=signed, unit=unit or None, comment=comment
                    )
                start += bits

    def _emergency(self, node_id: int) -> Any:
        fields = (("error_code", 0, 16), ("error_register", 16, 8), ("manufacturer", 24, 40))
        signals = [self._signal(name, start, bits, [_MASTER]) for name, start, bits in fields]
        name = f"{self._names[node_id]}_EMCY"
        return self._message(EMCY_BASE + node_id, name, 8, node_id, signals, comment="emergency object")

    def _heartbeat(self, node_id: int) -> Any:
        others = [name for other, name in self._names.items() if other != MASTER_NODE_ID]
        choices = {int(state): state.name.lower() for state in NmtState}
        state = self._signal("nmt_state", 0, 7, others if node_id == MASTER_NODE_ID else [_MASTER], choices=choices)
        cob_id, name = HEARTBEAT_BASE + node_id, f"{self._names[node_id]}_heartbeat"
        period_ms = HEARTBEAT_PRODUCED_MS
        return self._message(cob_id, name, 1, node_id, [state], comment="NMT error control", cycle_time=period_ms)

    def _message(self, cob_id: int, name: str, length: int, sender: int, signals: list[Any], **more: Any) -> Any:
        """A message; `more` are arguments of cantools."""
        more = {"bus_name": identifier(self._channels[sender])} | more
        return self._can.Message(
            cob_id, name, length, signals, senders=[self._names[sender]], is_fd=length > CLASSIC_BYTES, **more
        )

    def _signal(
        self, name: str, start: int, bits: int, receivers: list[str], choices: dict[int, str] | None = None, **more: Any
    ) -> Any:
        """A signal; `more` are arguments of cantools."""
        conversion = self._conversion.factory(choices=choices)
        return self._can.Signal(name, start, bits, receivers=receivers, conversion=conversion, **more)


def _whole_ms(period_ms: float) -> int:
    return max(1, round(period_ms))


def _fields(entry: PdoEntry) -> tuple[_Field, ...]:
    """The fields of an entry: its taxels, the fields that the array packs, or the entry itself."""
    if packed := _PACKED.get((entry.index, entry.subindex)):
        return packed
    if entry.index in _TAXELS and entry.bits % 8 == 0:
        count = entry.bits // 8
        first = (entry.subindex - 1) * count
        return tuple((f"taxel_{first + i}", 8, False, "counts") for i in range(count))
    name = identifier(entry.name or f"object_{entry.index:04X}")
    return ((name, entry.bits, entry.signed, _UNITS.get(entry.index, "")),)
