"""Modes with a target for every SYNC: cyclic synchronous position, velocity and torque, and interpolated position.

Source: CiA 402-2, "Cyclic synchronous position mode", "Cyclic synchronous velocity mode", "Cyclic synchronous torque
mode", "Interpolated position mode".
"""

from __future__ import annotations

from functools import partial

from canprobe.fieldbus.drive.mode import REACHED_FLAG, CyclicMode
from canprobe.fieldbus.drive.parameters import PEAK_TORQUE_PERMILLE, check_among
from canprobe.fieldbus.drive.parts import DriveParts
from canprobe.fieldbus.drive.profile import torque_run, uniform
from canprobe.fieldbus.node.dictionary import key_of
from canprobe.fieldbus.protocol.cia402 import ENABLE_INTERPOLATION_BIT, INTERPOLATION_ACTIVE_BIT, OperationMode
from canprobe.fieldbus.protocol.emcy import REFERENCE_LIMIT_CODE

MAX_ROUNDING_COUNTS = 2
POSITION_TARGET_KEY, _POSITION_OFFSET_KEY = key_of(0x607A), key_of(0x60B0)
_RECORD_KEY = key_of(0x60C1, 1)
_SUBMODES = range(-(1 << 15), 1)  # of 60C0h
_VELOCITY_TARGET_KEY, _VELOCITY_OFFSET_KEY = key_of(0x60FF), key_of(0x60B1)
_TORQUE_TARGET_KEY, _TORQUE_OFFSET_KEY = key_of(0x6071), key_of(0x60B2)


class CyclicPosition(CyclicMode):
    """Mode 8: the motor reaches a target latched at a SYNC by a straight ramp after 60C2h.

    A missing target does not begin the ramp under way again.

    Attributes:
        wanted: dictionary keys of the two values whose sum is the target, position units.
    """

    number = OperationMode.CYCLIC_SYNC_POSITION
    target = 0x607A
    needs = (key_of(target),)
    repeats, lags = False, True
    wanted = POSITION_TARGET_KEY, _POSITION_OFFSET_KEY

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._latched_ns = 0

    def start(self, word: int, t_ns: int) -> None:
        """Start; the first target may be as far away as the time from now on allows."""
        self._latched_ns = t_ns
        super().start(word, t_ns)

    def latch(self, t_ns: int) -> None:
        """Follow the target from the one before it."""
        parameters, units, motion, values = self._parameters, self._units, self._motion, self._values
        key, offset = self.wanted
        target: int = values[key] + values.get(offset, 0)  # type: ignore[assignment, operator]  # they are whole numbers
        low, high = parameters.low, parameters.high
        allowed = target if low <= target <= high else parameters.clamp(target)
        counts, onset = allowed * units.scale + units.origin, motion.onset(t_ns)
        reach_ns, passed_ns = parameters.interpolation_ns, t_ns - self._latched_ns
        passed_ns = passed_ns if passed_ns > reach_ns else reach_ns
        # followed as far as it goes, the target of one corrupted RPDO threw the arm
        if abs(counts - onset) > parameters.max_speed * passed_ns * 1e-9 + MAX_ROUNDING_COUNTS:
            self.parts.fault(REFERENCE_LIMIT_CODE, t_ns)
            return
        self._latched_ns = t_ns
        if self.parts.loop.changed:
            self.parts.loop.feed_forward()
        motion.reach(onset, counts, t_ns, t_ns + reach_ns)
        # `_strains` compares the torque limit as well; here that saves a call in each cycle of most drives
        limited = allowed != target or (parameters.max_torque < PEAK_TORQUE_PERMILLE and self._strains())
        if limited is not self.limited:
            self._limit(limited)


class InterpolatedPosition(CyclicPosition):
    """Mode 7: 60C1h:01 is the target of the next SYNC while bit 4 of the controlword is set.

    Bit 4 starts the interpolation and sets statusword bit 12; without it the reference slows down by 6084h to rest. The
    target at the time of bit 4 is followed even if it is old, as drives do: the master has to write the present
    position first. 60C0h is linear interpolation (0) or that of a maker (below 0). There is no buffer (60C4h): the last
    target that was written counts.
    """

    number = OperationMode.INTERPOLATED_POSITION
    target = 0x60C1
    needs = (_RECORD_KEY,)
    wanted = _RECORD_KEY, 0  # 0000h has no value

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._active = False
        parts.node.dictionary.on_check(0x60C0, partial(check_among, _SUBMODES))

    def start(self, word: int, t_ns: int) -> None:
        """Start; the interpolation is active at once if bit 4 is already set."""
        super().start(word, t_ns)
        self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION_BIT & 1)

    def status(self) -> int:
        """Bit for active interpolation; with halt, or without bit 4, that for rest."""
        return 1 << INTERPOLATION_ACTIVE_BIT if self._active and not self.halted else REACHED_FLAG * self._standstill

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Start the interpolation with bit 4, and stop it when the bit is cleared."""
        if changed >> ENABLE_INTERPOLATION_BIT & 1:
            self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION_BIT & 1)
            if self._active:
                self._latched_ns = t_ns
            elif not self.halted:
                self._standstill = False
                self._motion.decelerate(t_ns, self._parameters.deceleration, self._at_standstill)

    def latch(self, t_ns: int) -> None:
        """Follow the target, where the interpolation is active."""
        if self._active:
            super().latch(t_ns)


class CyclicVelocity(CyclicMode):
    """Mode 9: 60FFh + 60B1h is the velocity from one SYNC to the next.

    The velocity is cut to 607Fh and 6080h and the motor waits at a software limit; both set bit 11. The reference is
    the integral of the velocity: the plant follows it as it follows positions.
    """

    number = OperationMode.CYCLIC_SYNC_VELOCITY
    target = 0x60FF
    needs = (key_of(target),)

    def latch(self, t_ns: int) -> None:
        """Move the reference on from where it is, with the new velocity."""
        values, parameters = self._values, self._parameters
        target, offset = int(values[_VELOCITY_TARGET_KEY]), int(values.get(_VELOCITY_OFFSET_KEY, 0))
        wanted = (target + offset) * self._units.speed_scale
        velocity = min(max(wanted, -parameters.max_speed), parameters.max_speed)
        self.parts.loop.feed_torque()
        here, (low, high) = self._motion.demand(t_ns), parameters.fence
        self._motion.follow(uniform(here, velocity).fenced(low, high), t_ns)
        fenced = (here >= high and velocity > 0.0) or (here <= low and velocity < 0.0)
        self._limit(velocity != wanted or fenced or self._strains())


class CyclicTorque(CyclicMode):
    """Mode 10: 6071h + 60B2h, within 6072h, moves the motor against inertia and friction.

    The ideal plant follows references. So the drive computes the motion that the torque causes, from inertia, viscous
    and Coulomb friction at the joint (`MotorDynamics`), and gives the plant that motion. Gravity, contact force and
    coupling between the joints are not in it. Speed is cut to 607Fh and 6080h, and the motor waits at a software limit;
    a cut of torque, speed or position sets bit 11. 6074h and 6077h show the torque that acts: the torque loop is ideal.
    Torques are in 1/1000 of the plant's rated torque, which 6076h shows to the master.
    """

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
        dynamics, limit = self._motion.plant.motor_dynamics(self._motion.axis), parameters.max_speed
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
