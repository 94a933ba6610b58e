"""Cyclic synchronous torque: 6071h + 60B2h, within 6072h, moves the motor against inertia and friction.

The ideal plant follows references. So the drive computes the motion that the torque causes, from inertia, viscous and
Coulomb friction at the joint (`MotorDynamics`), and gives the plant that motion. Gravity, contact force and coupling
between the joints are not in it. Speed is cut to 607Fh and 6080h, and the motor waits at a software
limit; a cut of torque, speed or position sets bit 11. 6074h and 6077h show the torque that acts: the torque loop
is ideal. Torques are in 1/1000 of the plant's rated torque, which 6076h shows to the master.
Source: CiA 402-2, "Cyclic synchronous torque mode", objects 6071h, 6072h, 6074h, 6077h, 60B2h.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.mode import CyclicMode, DriveParts
from canprobe.fieldbus.drive.profile import torque_run
from canprobe.fieldbus.node.entry import key_of
from canprobe.fieldbus.protocol.cia402 import OperationMode

_TORQUE_TARGET_KEY, _TORQUE_OFFSET_KEY = key_of(0x6071), key_of(0x60B2)


class CyclicTorque(CyclicMode):
    """Mode 10."""

    number = OperationMode.CYCLIC_SYNC_TORQUE
    target = 0x6071
    needs = (key_of(target),)

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._torque = 0

    def start(self, word: int, t_ns: int) -> None:
        """Start without torque, until a target comes."""
        self._torque = 0
        super().start(word, t_ns)

    def leave(self, t_ns: int) -> None:
        """Show the torque of the plant again."""
        self._give_up()

    def latch(self, t_ns: int) -> None:
        """Follow the new torque from the velocity that the last one has left."""
        values, parameters, parts = self._values, self._parameters, self.parts
        wanted = int(values[_TORQUE_TARGET_KEY]) + int(values.get(_TORQUE_OFFSET_KEY, 0))
        self._torque = min(max(wanted, -parameters.max_torque), parameters.max_torque)
        parts.feedback.show_torque(lambda: self._torque)
        here, speed, (low, high) = self._motion.demand(t_ns), self._motion.speed(t_ns), parameters.fence
        dynamics, limit = parts.plant.motor_dynamics(parts.axis), parameters.max_speed
        self._motion.follow(torque_run(here, speed, self._torque, dynamics, limit).fenced(low, high), t_ns)
        pushes = abs(self._torque) > dynamics.coulomb
        fenced = pushes and ((here >= high and self._torque > 0) or (here <= low and self._torque < 0))
        fast = pushes and abs(speed) >= limit and speed * self._torque > 0
        self._limit(self._torque != wanted or fenced or fast)

    def _halt(self, t_ns: int) -> None:
        self._give_up()
        super()._halt(t_ns)

    def _give_up(self) -> None:
        feedback = self.parts.feedback
        feedback.show_torque(feedback.plant_torque)
