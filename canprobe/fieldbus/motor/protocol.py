"""Frames of Damiao motors and their meaning, pure: MIT commands, feedback, targets of the other modes, registers.

A command of MIT mode has five numbers in 64 bits, high bits first, and a feedback frame has as many. A number is a
place between the two ends of a range, cut off and not rounded, so that 0 is never exact. The ranges are not in the
frame: both sides have to know them.

Source: enactic/openarm_can, dm_motor_control.cpp; damiao_firmware, can_protocol.c and parameter_protocol.c. Where
public sources disagree, `damiao.toml` says it.
"""

from __future__ import annotations

import math
import struct
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES

REGISTER_ID = 0x7FF
"""Identifier of requests for registers, which every motor hears."""
KP_MAX, KD_MAX = 500.0, 5.0
"""Largest stiffness, N·m/rad, and damping, N·m·s/rad, of a command, for all types."""
TICK_NS = 50_000
"""Unit of TIMEOUT and of the delays of trips: the period of the motor's own loop."""
Field = tuple[float, float, int]
"""A number in a frame: the values of its lowest and highest bits, and how many there are."""
SPECIAL = b"\xff" * 7
"""Beginning of a special command; its last byte is a `Special`."""


class Mode(IntEnum):
    """Value of register CTRL_MODE."""

    MIT, POS_VEL, VEL, POS_FORCE = range(1, 5)


class Special(IntEnum):
    """Last byte of a command whose other seven are FFh."""

    CLEAR, ENABLE, DISABLE, ZERO = range(0xFB, 0xFF)


class RegisterOp(IntEnum):
    """Third byte of a request on `REGISTER_ID`."""

    READ, WRITE, STORE, FEEDBACK = 0x33, 0x55, 0xAA, 0xCC


class Rid(IntEnum):
    """Numbers of the registers that mean something here; `damiao.toml` has all."""

    MST_ID, ESC_ID, TIMEOUT, CTRL_MODE, PMAX, VMAX, TMAX, P_M, XOUT = 7, 8, 9, 10, 21, 22, 23, 80, 81


class MotorStatus(IntEnum):
    """High nibble of the first byte of a feedback frame; from 8 on a fault, which is latched."""

    DISABLED, ENABLED, OUTPUT_NOT_CALIBRATED, OUTPUT_CALIBRATION, OUTPUT_SENSOR = range(5)
    OVERVOLTAGE, UNDERVOLTAGE, OVERCURRENT, MOS_OVERTEMPERATURE, ROTOR_OVERTEMPERATURE = range(8, 13)
    COMMUNICATION_LOST, OVERLOAD = 13, 14


class Ranges(NamedTuple):
    """Full scale: position `p` rad, velocity `v` rad/s, torque `t` N·m, each from minus to plus; see `damiao.toml`."""

    p: float
    v: float
    t: float

    @property
    def fields(self) -> tuple[Field, Field, Field, Field, Field]:
        """Position, velocity, stiffness, damping and torque in a command."""
        p, v, t = self
        return (-p, p, 16), (-v, v, 12), (0, KP_MAX, 12), (0, KD_MAX, 12), (-t, t, 12)


class Register(NamedTuple):
    """A register; see `damiao.toml`. One without `low` can only be read."""

    name: str
    form: str = "<f"
    low: float | None = None
    high: float = 0
    value: float = 0


_FACTS = tomllib.loads(Path(__file__).with_name("damiao.toml").read_text(encoding="utf-8"))
TYPES: Mapping[str, Ranges] = {name: Ranges(one["p"], one["v"], one["t"]) for name, one in _FACTS["types"].items()}
"""Ranges by type, such as `dm4310`; one place for what sources disagree on."""
REGISTERS: Mapping[int, Register] = {int(rid): Register(**facts) for rid, facts in _FACTS["registers"].items()}
"""Registers by their numbers."""
_TARGETS = {Mode.POS_VEL: ("<ff", (1, 1)), Mode.VEL: ("<f", (1,)), Mode.POS_FORCE: ("<fHH", (1, 100, 10_000))}


class MitCommand(NamedTuple):
    """Command of MIT mode: torque = kp (p − q) + kd (v − q̇) + t, in rad, rad/s, N·m/rad, N·m·s/rad, N·m."""

    p: float = 0.0
    v: float = 0.0
    kp: float = 0.0
    kd: float = 0.0
    t: float = 0.0

    def pack(self, ranges: Ranges) -> bytes:
        """The frame's eight bytes; values outside of the ranges are clamped, as hosts do."""
        fields = ranges.fields
        return _pack((min(max(x, low), high) for x, (low, high, _) in zip(self, fields, strict=True)), fields)

    @classmethod
    def unpack(cls, data: bytes, ranges: Ranges) -> MitCommand:
        """The command in eight bytes.

        Raises:
            ProtocolError: there are more or fewer.
        """
        return cls(*_unpack(data, ranges.fields))


class Feedback(NamedTuple):
    """Answer of a motor: status, low byte of its ESC_ID, position rad, velocity rad/s, torque N·m, temperatures °C."""

    status: int
    motor_id: int
    p: float
    v: float
    t: float
    t_mos: int
    t_rotor: int

    def pack(self, ranges: Ranges) -> bytes:
        """The frame's eight bytes, as the firmware makes them.

        Nothing is clamped, so a position beyond PMAX comes out at the other end; and an id from 16 on, which is not
        masked, runs into the status.
        """
        return _pack((self.status | self.motor_id >> 4, *self[1:]), _feedback_fields(ranges))

    @classmethod
    def unpack(cls, data: bytes, ranges: Ranges) -> Feedback:
        """The feedback in eight bytes; of the id, only four bits can be told from the status.

        Raises:
            ProtocolError: there are more or fewer.
        """
        status, motor_id, p, v, t, t_mos, t_rotor = _unpack(data, _feedback_fields(ranges))
        return cls(int(status), int(motor_id), p, v, t, int(t_mos), int(t_rotor))


def special_of(data: bytes) -> Special | None:
    """The special command in a frame to a motor; None where it is none."""
    return Special(data[7]) if len(data) == 8 and data[:7] == SPECIAL and 0xFB <= data[7] <= 0xFE else None


def pack_target(mode: Mode, *values: float) -> bytes:
    """The target of a mode: position and largest speed; velocity; or position, largest speed and share of the torque.

    In rad, rad/s and 0…1. Speed and share of `Mode.POS_FORCE` are clamped to 0…100 rad/s and 0…1.
    """
    form, scales = _TARGETS[mode]
    parts = zip(values, scales, strict=True)
    return struct.pack(form, *(x if scale == 1 else int(min(max(x * scale, 0), 10_000)) for x, scale in parts))


def unpack_target(mode: Mode, data: bytes, ranges: Ranges) -> tuple[float, ...]:
    """What a frame commands in a mode: `MitCommand`, or what `pack_target` takes; bytes behind that mean nothing.

    Raises:
        ProtocolError: there are too few bytes, or a number is none.
    """
    if mode is Mode.MIT:
        return MitCommand.unpack(data, ranges)
    form, scales = _TARGETS[mode]
    numbers = struct.unpack_from(form, data + bytes(CLASSIC_BYTES))
    if len(data) < struct.calcsize(form) or not all(map(math.isfinite, numbers)):
        raise ProtocolError(f"target of {mode.name}: expected numbers as {form}, got {data.hex()}")
    return tuple(x / scale for x, scale in zip(numbers, scales, strict=True))


def pack_register(esc_id: int, op: RegisterOp, rid: int, raw: bytes = bytes(4)) -> bytes:
    """A request on `REGISTER_ID`, or the answer to it on MST_ID: both look the same."""
    return esc_id.to_bytes(2, "little") + bytes((op, rid)) + raw


def status_name(status: int) -> str:
    """Name of a status in words; firmware is seen to send some that no document has."""
    known = status in MotorStatus.__members__.values()
    return MotorStatus(status).name.lower().replace("_", " ") if known else f"unknown status {status}"


def _feedback_fields(ranges: Ranges) -> Sequence[Field]:
    p, v, _, _, t = ranges.fields
    return (0, 15, 4), (0, 15, 4), p, v, t, (0, 255, 8), (0, 255, 8)


def _pack(values: Iterable[float], fields: Sequence[Field]) -> bytes:
    """Each value's place in its range, cut off and not rounded; bits that a field does not have are lost."""
    word = 0
    for value, (low, high, bits) in zip(values, fields, strict=True):
        most = (1 << bits) - 1
        word = word << bits | int((value - low) * most / (high - low)) & most
    return word.to_bytes(CLASSIC_BYTES, "big")


def _unpack(data: bytes, fields: Sequence[Field]) -> list[float]:
    if len(data) != CLASSIC_BYTES:
        raise ProtocolError(f"frame of a motor: expected {CLASSIC_BYTES} bytes, got {len(data)}")
    word, values = int.from_bytes(data, "big"), list[float]()
    for low, high, bits in reversed(fields):
        most = (1 << bits) - 1
        values.append(low + (word & most) * (high - low) / most)
        word >>= bits
    return values[::-1]
