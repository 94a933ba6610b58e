"""What is known of one motor that does not speak CANopen, from its frames; and an event for each of them."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from canprobe.fieldbus.motor import protocol
from canprobe.fieldbus.motor.protocol import Feedback, MitCommand, Mode, Ranges, RegisterOp, Special
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import BusEvent


class SeenMotor:
    """One motor.

    Args:
        motor_id, mst_id: ESC_ID and MST_ID.
        ranges: those by which its master scales, which its type has.

    Attributes:
        answer: last feedback; None before the first one.
        shown: the frame of it.
        unanswered: number of commands since the last answer of any kind.
        registers: values that were read or written, by number.
    """

    def __init__(self, motor_id: int, mst_id: int, ranges: Ranges) -> None:
        self.name = f"motor {motor_id}"
        self.motor_id, self.mst_id, self.ranges = motor_id, mst_id, ranges
        self.answer: Feedback | None = None
        self.shown: BusFrame | None = None
        self.unanswered = 0
        self.registers: dict[int, float] = {}
        self._asked = False

    def take(self, frame: BusFrame) -> Iterable[MotorSeen]:
        """What a frame of the bus means for it; nothing where it is none of its own."""
        can_id, data = frame.can_id, frame.data
        own = data[:2] == self.motor_id.to_bytes(2, "little") and len(data) == 8
        if can_id == protocol.REGISTER_ID:
            self._asked = self._asked or own
        elif can_id == self.mst_id and self._asked and own and data[2] in (RegisterOp.READ, RegisterOp.WRITE):
            self._asked, self.unanswered = False, 0
            if (register := protocol.REGISTERS.get(data[3])) is not None:
                (self.registers[data[3]],) = struct.unpack(register.form, data[4:])
        elif can_id == self.mst_id and len(data) == 8 and (data[0] ^ self.motor_id) & 0xF == 0:
            self.answer, self.shown, self.unanswered = Feedback.unpack(data, self.ranges), frame, 0
            yield MotorSeen(frame, self)
        elif can_id & 0xFF == self.motor_id and can_id >> 8 < Mode.POS_FORCE:
            self.unanswered += 1
            special, mit = protocol.special_of(data), can_id >> 8 == 0 and len(data) == 8
            command = MitCommand.unpack(data, self.ranges) if mit and special is None else None
            yield MotorSeen(frame, self, special, command, drives=special is None)


@dataclass(slots=True, eq=False)
class MotorSeen(BusEvent):
    """A frame to a motor or, with neither `special` nor `drives`, its feedback; `drives`: a command of any mode."""

    motor: SeenMotor
    special: Special | None = None
    command: MitCommand | None = None
    drives: bool = False

    def among(self, nodes: Iterable[object]) -> Iterable[object]:
        return (self.motor,)
