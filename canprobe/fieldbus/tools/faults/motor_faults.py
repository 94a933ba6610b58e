"""Faults of motors that do not speak CANopen, and those of the link that happen to them as to nodes."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import cast

from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.protocol import MotorStatus, Rid
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.tools.faults.fault import Effect, Fault, FaultKind, Host
from canprobe.fieldbus.tools.faults.faulty_node import FaultyNode
from canprobe.fieldbus.tools.faults.registry import BUS_FAULTS, kinds_of

_LINK = ("drop", "delay", "duplicate", "corrupt", "reorder", "mute", "deaf", "reboot", "freeze")


class FaultyMotor(FaultyNode):
    """A motor in the place of a node, for the kinds of `MOTOR_FAULTS`.

    Args:
        motor: the motor.
    """

    def __init__(self, motor: DamiaoMotor) -> None:
        super().__init__(cast(SlaveNode, motor))  # these kinds ask for no service that only a node has
        self.motor = motor

    @property
    def is_drive(self) -> bool:
        return True

    @property
    def states(self) -> frozenset[str]:
        return frozenset({"enabled"} if self.motor.status is MotorStatus.ENABLED else ())


class MotorEffect(Effect):
    """Base class of the faults of a motor."""

    needs = "motor"

    def __init__(self, fault: Fault, host: Host) -> None:
        super().__init__(fault, host)
        self.motor = cast(DamiaoMotor, self.node)


class BrownOut(MotorEffect):
    """The supply sags: the motor starts anew, disabled, without what was not stored. It says nothing of it."""

    name = "brown-out"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.node.advance(t_ns)  # up to here the last command moves it
        return self.node.start(t_ns)


class OverTemperature(MotorEffect):
    """A limit of the motor is exceeded: it trips after the delay of that limit, and again after each FBh."""

    name = "over-temperature"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.motor.heat = (30, int(self.fault.value("deg_c")))
        self.motor.exceeded_ns[MotorStatus(int(self.fault.value("status")))] = t_ns
        return ()

    def end(self, t_ns: int) -> None:
        self.motor.heat = (30, 30)
        self.motor.exceeded_ns.pop(MotorStatus(int(self.fault.value("status"))), None)


class WatchdogTrip(MotorEffect):
    """The watchdog of an enabled motor trips although frames come."""

    name = "watchdog-trip"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        out = self.node.advance(t_ns)
        if self.motor.status is MotorStatus.ENABLED:
            self.motor.turn(MotorStatus.COMMUNICATION_LOST)
        return out


class WrongRange(MotorEffect):
    """Registers 21 to 23 are those of another type; they are put back at the end, unless somebody wrote them."""

    name = "wrong-range"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        out = self.node.advance(t_ns)
        self._found = {int(rid): self.motor.registers[rid] for rid in (Rid.PMAX, Rid.VMAX, Rid.TMAX)}
        self._wrong = {rid: value * self.fault.value("ratio") for rid, value in self._found.items()}
        self.motor.registers |= self._wrong
        return out

    def end(self, t_ns: int) -> None:
        if self._wrong.items() <= self.motor.registers.items():
            self.motor.registers |= self._found


class EncoderWrap(MotorEffect):
    """The position is off by whole turns from here on, as where their count was lost."""

    name = "encoder-wrap"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        out = self.node.advance(t_ns)
        self.motor.joint.q += math.tau * self.fault.value("turns")
        return out


MOTOR_FAULTS: Mapping[str, FaultKind] = {name: BUS_FAULTS[name] for name in _LINK} | {**kinds_of(sys.modules[__name__])}
"""Kinds of faults of motors by name."""
