"""Motors that answer on a bus, found by reading registers: nothing is written, enabled, cleared or stored.

Why not the maker's discovery frame (55h 00h 00h AAh on 7FFh): frames of its kind set ids and start the bootloader, and
a motor that is not there cannot tell them apart. Reading is answered in any state, and does not feed the watchdog.
"""

from __future__ import annotations

import struct
from typing import Any

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.motor.protocol import (
    REGISTER_ID,
    REGISTERS,
    TICK_NS,
    TYPES,
    Mode,
    RegisterOp,
    Rid,
    pack_register,
)
from canprobe.fieldbus.protocol.frames import NMT_ID, SYNC_ID

LISTEN_S = 1.0
"""Time for which the bus is listened to before anything is sent: the longest usual period of a heartbeat."""
MOST_ID = 127
"""Largest ESC_ID that is asked."""
_PACE_S = 1e-3
"""Time between two requests, for motors that take one at a time."""


def find_motors(port: Port, answer_s: float = 0.1) -> list[dict[str, Any]]:
    """Every motor with an ESC_ID up to 127, by what its registers say.

    Args:
        port: the bus.
        answer_s: longest time to an answer.

    Returns:
        By rising id: ``motor_id``, ``mst_id``; ``ranges`` PMAX, VMAX, TMAX, and ``types`` that come with them;
        ``timeout_ms`` of the watchdog, 0 where it is off; ``mode``; ``devices``, how many answer as this one does. None
        stands for what was not answered.

    Raises:
        UsageError: there is CANopen traffic, which answers of a motor at its factory setting would disturb: 000h is
            NMT.
        InterfaceError: the interface failed.
    """
    for can_id, data, _ in _heard(port, LISTEN_S):
        if _is_canopen(can_id, data):
            raise UsageError(
                f"scan --motors: {can_id:03X}h is heard on {port.channel}, as CANopen nodes send it, and a motor at its"
                " factory setting answers on 000h, which is NMT; give motors a bus of their own, or stop the nodes"
            )
    found: list[dict[str, Any]] = []
    first = _read(port, [(motor_id, Rid.MST_ID) for motor_id in range(1, MOST_ID + 1)], answer_s)
    for motor_id, mst_id in sorted({(key[0], can_id) for key, can_id, _ in first}):
        rids = (Rid.PMAX, Rid.VMAX, Rid.TMAX, Rid.TIMEOUT, Rid.CTRL_MODE)
        answers = _read(port, [(motor_id, rid) for rid in rids], answer_s)
        known = {key[1]: value for key, can_id, value in answers if can_id == mst_id}
        *ranges, ticks, mode = (known.get(rid) for rid in rids)
        named = [name for name, one in TYPES.items() if None not in ranges and list(one) == ranges]
        found.append(
            {
                "motor_id": motor_id,
                "mst_id": mst_id,
                "ranges": ranges,
                "types": named,
                "timeout_ms": None if ticks is None else ticks * TICK_NS * 1e-6,
                "mode": Mode(int(mode)).name if mode in tuple(Mode) else None,
                "devices": sum(key[0] == motor_id and can_id == mst_id for key, can_id, _ in first),
            }
        )
    return found


def _read(port: Port, asked: list[tuple[int, Rid]], answer_s: float) -> list[tuple[tuple[int, int], int, float]]:
    """Answers to requests for registers: ESC_ID and register, identifier, value."""
    heard: list[TimedFrame] = []
    for motor_id, rid in asked:
        port.send_batch([(REGISTER_ID, pack_register(motor_id, RegisterOp.READ, rid))])
        heard += _heard(port, _PACE_S)
    answers: list[tuple[tuple[int, int], int, float]] = []
    for can_id, data, _ in heard + _heard(port, answer_s):
        key = (int.from_bytes(data[:2], "little"), data[3] if len(data) == 8 else -1)
        if key in asked and data[2] == RegisterOp.READ:
            (value,) = struct.unpack(REGISTERS[key[1]].form, data[4:])
            answers.append((key, can_id, round(value, 4)))
    return answers


def _heard(port: Port, time_s: float) -> list[TimedFrame]:
    heard, end_ns = list[TimedFrame](), port.clock.now_ns() + round(time_s * 1e9)
    while port.clock.now_ns() < end_ns:
        heard += port.wait_and_drain(end_ns)
    return heard


def _is_canopen(can_id: int, data: bytes) -> bool:
    """Whether only CANopen nodes send this; at 100h, 200h and 300h motors have their targets."""
    if can_id == NMT_ID:
        return len(data) == 2
    return SYNC_ID <= can_id < REGISTER_ID and can_id & ~0x7F not in (0x100, 0x200, 0x300)
