"""A plan as DBC or KCD, by cantools: for SavvyCAN, Vector's tools, Kayak, cantools itself and whatever reads those."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from canprobe.bridge.extras import need
from canprobe.bridge.signals import FrameDescription, FrameSignal, describe_frames, identifier, node_names
from canprobe.planning import Plan
from canprobe.whole_file import write_text

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
