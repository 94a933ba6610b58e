"""A frame in words: candump's form, and what it means to the node under examination."""

from __future__ import annotations

from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.emcy import describe
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState
from canprobe.fieldbus.protocol.lss import LSS_ANSWER_ID, LSS_REQUEST_ID
from canprobe.fieldbus.protocol.sdo import abort_code, place_of, place_text
from canprobe.fieldbus.tools.conform.accepted import abort_text

_CLIENT = ("segment", "write", "read", "next segment", "abort", "block read", "block write", "unknown command")
_SERVER = ("segment", "segment taken", "value", "written", "abort", "block write", "block read", "unknown answer")


def frame_text(can_id: int, data: bytes, node_id: int) -> str:
    """One frame: identifier, data in hex, and its meaning."""
    flags = f"{can_id & frames.EFF_MASK:08X}" if can_id & frames.EFF_FLAG else f"{can_id & 0x7FF:03X}"
    content = "R" if can_id & frames.RTR_FLAG else data.hex(" ").upper()
    meaning = "" if can_id & (frames.EFF_FLAG | frames.RTR_FLAG) else _meaning(can_id, data, node_id)
    return f"{flags}#{content}" + (f"  {meaning}" if meaning else "")


def _meaning(can_id: int, data: bytes, node_id: int) -> str:
    if can_id == frames.NMT_ID:
        known = len(data) == 2 and data[0] in tuple(NmtCommand)
        return f"NMT {NmtCommand(data[0]).name.lower().replace('_', ' ')}" if known else "NMT, not a valid command"
    if can_id == frames.SDO_RX_BASE + node_id:
        return sdo_text(data, _CLIENT)
    if can_id == frames.SDO_TX_BASE + node_id:
        return sdo_text(data, _SERVER)
    if can_id == frames.EMCY_BASE + node_id:
        return f"EMCY {int.from_bytes(data[:2], 'little'):04X}h, {describe(int.from_bytes(data[:2], 'little'))}"
    if frames.HEARTBEAT_BASE < can_id < frames.HEARTBEAT_BASE + 128 and len(data) == 1:
        state = data[0] & 0x7F
        known = state in tuple(NmtState)
        return "boot-up" if not state else f"heartbeat, {NmtState(state).name.lower()}" if known else ""
    return {frames.SYNC_ID: "SYNC", LSS_REQUEST_ID: "LSS request", LSS_ANSWER_ID: "LSS answer"}.get(can_id, "")


def sdo_text(data: bytes, words: tuple[str, ...] = _CLIENT) -> str:
    """An SDO request or answer in words."""
    if len(data) != 8:
        return f"SDO with {len(data)} bytes"
    kind = words[data[0] >> 5]
    if kind == "abort":
        return f"SDO abort of {place_text(*place_of(data))}: {abort_text(abort_code(data))}"
    has_place = kind in ("write", "read", "value", "written") or (kind.startswith("block") and not data[0] & 1)
    return f"SDO {kind} {place_text(*place_of(data))}" if has_place else f"SDO {kind}"
