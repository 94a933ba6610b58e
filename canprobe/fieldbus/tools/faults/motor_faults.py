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
from canprobe.fieldbus.tools.faults.fault import Effect, FaultKind
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

    def _events(self) -> frozenset[str]:
        return frozenset({"enabled"} if self.motor.status is MotorStatus.ENABLED else ())


class BrownOut(Effect):
    """The supply sags: the motor starts anew, disabled, without what was not stored. It says nothing of it."""

    name = "brown-out"
    needs = "motor"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.node.advance(t_ns)  # up to here the last command moves it
        return self.node.start(t_ns)


class OverTemperature(Effect):
    """A limit of the motor is exceeded: it trips after the delay of that limit, and again after each FBh."""

    name = "over-temperature"
    needs = "motor"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self._motor = cast(DamiaoMotor, self.node)
        self._motor.heat = (30, int(self.fault.value("deg_c")))
        self._motor.exceeded_ns[MotorStatus(int(self.fault.value("status")))] = t_ns
        return ()

    def end(self, t_ns: int) -> None:
        self._motor.heat = (30, 30)
        self._motor.exceeded_ns.pop(MotorStatus(int(self.fault.value("status"))), None)


class WatchdogTrip(Effect):
    """The watchdog of an enabled motor trips although frames come."""

    name = "watchdog-trip"
    needs = "motor"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        out = self.node.advance(t_ns)
        if (motor := cast(DamiaoMotor, self.node)).status is MotorStatus.ENABLED:
            motor.turn(MotorStatus.COMMUNICATION_LOST)
        return out


class WrongRange(Effect):
    """Registers 21 to 23 are those of another type; they are put back at the end, unless somebody wrote them."""

    name = "wrong-range"
    needs = "motor"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        out = self.node.advance(t_ns)
        self._registers = cast(DamiaoMotor, self.node).registers
        self._found = {int(rid): self._registers[rid] for rid in (Rid.PMAX, Rid.VMAX, Rid.TMAX)}
        self._wrong = {rid: value * self.fault.value("ratio") for rid, value in self._found.items()}
        self._registers |= self._wrong
        return out

    def end(self, t_ns: int) -> None:
        if self._wrong.items() <= self._registers.items():
            self._registers |= self._found


class EncoderWrap(Effect):
    """The position is off by whole turns from here on, as where their count was lost."""

    name = "encoder-wrap"
    needs = "motor"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        out = self.node.advance(t_ns)
        cast(DamiaoMotor, self.node).joint.q += math.tau * self.fault.value("turns")
        return out


MOTOR_FAULTS: Mapping[str, FaultKind] = {name: BUS_FAULTS[name] for name in _LINK} | {**kinds_of(sys.modules[__name__])}
"""Kinds of faults of motors by name."""
