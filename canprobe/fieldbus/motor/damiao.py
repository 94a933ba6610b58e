"""A Damiao motor as its masters see it on the bus, without I/O: frames and time in, frames and the next deadline out.

What is known of the motor's side comes from one unofficial source, damiao_firmware: the firmware of a DM4310, recovered
from a binary. What that leaves open is decided here, and docs/motors.md has each decision.
"""

from __future__ import annotations

import math
from contextlib import suppress
from struct import pack, unpack

from canprobe.errors import ProtocolError
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.motor import protocol
from canprobe.fieldbus.motor.joint import MotorJoint
from canprobe.fieldbus.motor.protocol import TICK_NS, MitCommand, Mode, MotorStatus, RegisterOp, Rid, Special
from canprobe.fieldbus.protocol.frames import Frame

_STEP_NS, _MAX_STEPS = 250_000, 100
"""Step of the joint, and most steps between two frames. Behind more than 25 ms they are longer.

The motor's own loop has 50 µs; seven motors would take more than a processor then. The joint is stable in any step.
"""
_FLASH_NS = 30_000_000
"""Time that writing the flash takes; the answers to all frames that come meanwhile leave when it is done."""
_TRIP_TICKS = dict(zip(range(MotorStatus.OVERVOLTAGE, 13), (20_001, 5_001, 5_001, 8_001, 8_001), strict=True))
"""Ticks for which the limit behind a fault is exceeded before the motor trips, by status."""


class DamiaoMotor(Participant):
    """One motor.

    Args:
        type_name: its type, one of `protocol.TYPES`.
        motor_id: ESC_ID.
        mst_id: MST_ID; 0 as the factory leaves it.
        q: position at first, rad.

    Attributes:
        node_id: id by which faults name it, which is its first ESC_ID.
        ranges: what it is made for, whatever its registers 21 to 23 say.
        joint: what it turns.
        registers: values by number, in RAM.
        status: its status; a fault is latched.
        heat: temperatures of power stage and rotor, °C.
        exceeded_ns: since when the limit behind a fault is exceeded; FB changes nothing in it.
        next_deadline_ns: when the flash is written; None while it is not. All else is computed when a frame comes.
    """

    next_deadline_ns: int | None = None
    _tripped = frozenset[MotorStatus]()

    def __init__(self, type_name: str, motor_id: int, mst_id: int = 0, q: float = 0.0) -> None:
        self.node_id, self.ranges = motor_id, protocol.TYPES[type_name]
        self.joint, self.heat = MotorJoint(self.ranges, q), (30, 30)
        self._flash = {rid: register.value for rid, register in protocol.REGISTERS.items()}
        own = (Rid.ESC_ID, Rid.MST_ID, Rid.PMAX, Rid.VMAX, Rid.TMAX)
        self._flash |= zip(own, (motor_id, mst_id, *self.ranges), strict=True)
        self.start(0)

    @property
    def name(self) -> str:
        return f"motor {self.node_id}"

    def start(self, t_ns: int) -> list[Frame]:
        """Power on. What was not stored is lost, and so are frames that wait; the position is kept."""
        self.registers = dict(self._flash)
        self._now_ns = self._fed_ns = t_ns
        self._late, self._waiting, self.next_deadline_ns = list[Frame](), list[Frame](), None
        self.exceeded_ns = dict[MotorStatus, int]()
        self.turn(MotorStatus.DISABLED)
        return []

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Take any frame; return the answer. No frame makes it raise."""
        foreign = can_id & 0xFF ^ int(self.registers[Rid.ESC_ID]) & 0xFF  # the firmware compares no more than that
        if can_id > protocol.REGISTER_ID or (foreign and can_id != protocol.REGISTER_ID):
            return []
        self._waiting.append((can_id, data))
        return self.advance(t_ns)

    def advance(self, t_ns: int) -> list[Frame]:
        while (trip := min(self._trips(), default=(t_ns + 1, MotorStatus.DISABLED)))[0] <= t_ns:
            self._move(trip[0])
            self.turn(trip[1])
        self._move(t_ns)
        out = list[Frame]()
        if self.next_deadline_ns is not None and self.next_deadline_ns <= t_ns:
            out, self.next_deadline_ns = self._late, None
        while self._waiting and self.next_deadline_ns is None:
            out += self._answers(*self._waiting.pop(0))
        return out

    def turn(self, status: MotorStatus) -> None:
        """Change the status; a fault takes the place of an earlier one.

        The command becomes 0: enabled again, the motor has no torque before the first one.
        """
        self.status = status
        self._tripped = self._tripped | {status} if status >= MotorStatus.OVERVOLTAGE else frozenset()
        self._command, self._goal, self._speed, self._limit = MitCommand(), 0.0, 0.0, self.ranges.t

    def _trips(self) -> list[tuple[int, MotorStatus]]:
        """What the motor will trip of, and when, unless something changes."""
        trips = [(since_ns + _TRIP_TICKS[status] * TICK_NS, status) for status, since_ns in self.exceeded_ns.items()]
        if self.status is MotorStatus.ENABLED and (ticks := int(self.registers[Rid.TIMEOUT])):
            trips.append((self._fed_ns + (ticks + 1) * TICK_NS, MotorStatus.COMMUNICATION_LOST))
        return [trip for trip in trips if trip[1] not in self._tripped]

    def _move(self, t_ns: int) -> None:
        took_ns, self._now_ns = max(t_ns - self._now_ns, 0), max(t_ns, self._now_ns)
        steps = min(-(-took_ns // _STEP_NS), _MAX_STEPS)
        for _ in range(steps):
            h = took_ns * 1e-9 / steps
            if way := self._speed * h:
                ahead = self._goal - self._command.p
                self._command = self._command._replace(p=self._command.p + min(max(ahead, -way), way))
            self.joint.step(h, self._command, self._limit)

    def _answers(self, can_id: int, data: bytes) -> list[Frame]:
        esc_id = int(self.registers[Rid.ESC_ID])
        if can_id == protocol.REGISTER_ID:
            return self._asked(data) if data[:2] == esc_id.to_bytes(2, "little") and len(data) == 8 else []
        self._fed_ns = self._now_ns  # a frame that is not executed feeds the watchdog, too
        special, enabled = protocol.special_of(data), self.status is MotorStatus.ENABLED
        if special is Special.ENABLE and self.status is MotorStatus.DISABLED:
            self.turn(MotorStatus.ENABLED)
        elif special is Special.CLEAR or (special is Special.DISABLE and enabled):
            self.turn(MotorStatus.DISABLED)
        elif special is None and enabled and can_id >> 8 == self.registers[Rid.CTRL_MODE] - 1:
            self._take(Mode((can_id >> 8) + 1), data)
        if special is not Special.ZERO:
            return [self._feedback()]
        self.joint.q, self._command = 0.0, self._command._replace(p=0.0)
        self._goal = 0.0 if math.isfinite(self._goal) else self._goal  # a velocity leads to infinity
        self._late, self.next_deadline_ns = [self._feedback()], self._now_ns + _FLASH_NS
        return []

    def _take(self, mode: Mode, data: bytes) -> None:
        """Take a target; modes but MIT move theirs there, and follow it by the law of MIT at its stiffest."""
        with suppress(ProtocolError):
            target = protocol.unpack_target(mode, data, self._scale)
            if mode is Mode.MIT:
                self._command = MitCommand(*target)
                return
            v = target[0]
            self._goal, speed, share = (math.copysign(math.inf, v), v, 1.0) if mode is Mode.VEL else (*target, 1.0)[:3]
            self._speed, self._limit = min(abs(speed), self.ranges.v), self.ranges.t * min(share, 1.0)
            start = self._command.p if self._command.kp else self.joint.q
            self._command = MitCommand(start, kp=protocol.KP_MAX, kd=protocol.KD_MAX)

    @property
    def _scale(self) -> protocol.Ranges:
        return protocol.Ranges(*(self.registers[rid] for rid in (Rid.PMAX, Rid.VMAX, Rid.TMAX)))

    def _feedback(self) -> Frame:
        low, joint = int(self.registers[Rid.ESC_ID]) & 0xFF, self.joint
        feedback = protocol.Feedback(self.status, low, joint.q, joint.qd, joint.tau, *self.heat)
        return int(self.registers[Rid.MST_ID]), feedback.pack(self._scale)

    def _asked(self, data: bytes) -> list[Frame]:
        """Answer a request for registers."""
        mst_id, op, rid, register = int(self.registers[Rid.MST_ID]), data[2], data[3], protocol.REGISTERS.get(data[3])
        if op == RegisterOp.STORE and self.status is MotorStatus.DISABLED:
            self._flash = dict(self.registers)
            self._late, self.next_deadline_ns = [(mst_id, data[:3] + b"\1")], self._now_ns + _FLASH_NS
        if op == RegisterOp.FEEDBACK and rid < 4:
            precise = pack("<f", (0.0, self.joint.q, self.joint.qd, self.joint.tau)[rid])
            return [(mst_id, bytes((data[0], self.status, *self.heat)) + precise) if rid else self._feedback()]
        if op not in (RegisterOp.READ, RegisterOp.WRITE) or register is None:
            return []
        self.registers[Rid.P_M] = self.registers[Rid.XOUT] = self.joint.q
        (value,) = unpack(register.form, data[4:])
        if op == RegisterOp.WRITE and register.low is not None and register.low <= value <= register.high:
            self.registers[rid] = value
            if rid == Rid.CTRL_MODE:
                self.turn(self.status)
        return [(mst_id, data[:4] + pack(register.form, self.registers[rid]))]
