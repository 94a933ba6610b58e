"""The modes of operation: cyclic synchronous position, velocity and torque, interpolated and profile position.

A target that is further from the one before than 607Fh and 6080h let the motor go in the time between them is not
followed: reference limit, a fault. A target that was corrupted on its way is one, unless it is off by less.
Offsets of velocity and torque (60B1h, 60B2h) are feed-forwards of a dynamic plant; the ideal one needs none.
Source: CiA 402-2, "Cyclic synchronous position mode", objects 607Ah, 607Dh, 607Fh, 6080h, 60B0h–60B2h,
60C2h; error code 8612h.
"""

from __future__ import annotations

from typing import NamedTuple

from canprobe.fieldbus.drive.homing import Homing
from canprobe.fieldbus.drive.mode import REACHED, CyclicMode, DriveMode, DriveParts, ProfiledMode
from canprobe.fieldbus.drive.parameters import PEAK_PERMILLE
from canprobe.fieldbus.drive.reference import STEP_NS, Rates, torque_run, uniform
from canprobe.fieldbus.node.dictionary import Abort, SdoAbort, Value, key_of
from canprobe.fieldbus.protocol.cia402 import (
    CHANGE_IMMEDIATELY,
    ENABLE_INTERPOLATION,
    INTERPOLATION_ACTIVE,
    NEW_SETPOINT,
    RELATIVE,
    SETPOINT_ACKNOWLEDGE,
    OperationMode,
)
from canprobe.fieldbus.protocol.frames import REFERENCE_LIMIT

# Cyclic synchronous position: a target latched at a SYNC is reached by a straight ramp after 60C2h.

ROUNDING_COUNTS = 2
_POSITION_TARGET = key_of(0x607A)
_POSITION_OFFSET = key_of(0x60B0)


class CyclicPosition(CyclicMode):
    """Mode 8. A ramp under way is not begun again where a target is missing.

    Attributes:
        wanted: dictionary keys whose sum is the target, position units.
    """

    number = OperationMode.CYCLIC_SYNC_POSITION
    target = 0x607A
    needs = (key_of(target),)
    repeats, lags = False, True
    wanted = _POSITION_TARGET, _POSITION_OFFSET

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._latched_ns = 0

    def start(self, word: int, t_ns: int) -> None:
        """The first target is as far away as the time since now allows."""
        self._latched_ns = t_ns
        super().start(word, t_ns)

    def latch(self, t_ns: int) -> None:
        """Follow the target from the one before it."""
        parameters, units, motion, values = self._parameters, self._units, self._motion, self._values
        key, offset = self.wanted
        target: int = values[key] + values.get(offset, 0)  # type: ignore[assignment, operator]  # of whole numbers
        low, high = parameters.low, parameters.high
        allowed = target if low <= target <= high else parameters.clamp(target)
        counts, onset = allowed * units.scale + units.origin, motion.onset(t_ns)
        reach_ns, passed_ns = parameters.interpolation_ns, t_ns - self._latched_ns
        passed_ns = passed_ns if passed_ns > reach_ns else reach_ns
        if abs(counts - onset) > parameters.max_speed * passed_ns * 1e-9 + ROUNDING_COUNTS:
            self.parts.fault(REFERENCE_LIMIT, t_ns)
            return
        self._latched_ns = t_ns
        if self.parts.loop.changed:
            self.parts.loop.feed_forward()
        motion.reach(onset, counts, t_ns, t_ns + reach_ns)
        limited = allowed != target or (parameters.max_torque < PEAK_PERMILLE and self._strains())
        if limited is not self.limited:
            self._limit(limited)


# Interpolated position: 60C1h:01 is the target of the next SYNC, as 607Ah is in mode 8, while controlword bit 4 is set.
#
# With bit 4 the interpolation becomes active and statusword bit 12 set; without it the reference slows down by 6084h
# and stands. The target that stands when bit 4 comes is followed even if it is an old one, as drives do: the master
# has to write the present position first. 60C0h is linear interpolation (0) or what a maker calls so (below 0); there
# is no buffer (60C4h): the last target written counts.
# Source: CiA 402-2, "Interpolated position mode", objects 60C0h, 60C1h, 60C2h.

_RECORD = key_of(0x60C1, 1)


class InterpolatedPosition(CyclicPosition):
    """Mode 7."""

    number = OperationMode.INTERPOLATED_POSITION
    target = 0x60C1
    needs = (_RECORD,)
    wanted = _RECORD, 0  # 0000h has no value

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._active = False
        parts.node.dictionary.on_check(0x60C0, _check_submode)

    def start(self, word: int, t_ns: int) -> None:
        """Active at once where bit 4 is set already."""
        super().start(word, t_ns)
        self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION & 1)

    def status(self) -> int:
        """Interpolation active; with halt, or without bit 4, at rest."""
        return 1 << INTERPOLATION_ACTIVE if self._active and not self.halted else REACHED * self._standstill

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Bit 4 starts the interpolation, and stops it when it is taken away."""
        if changed >> ENABLE_INTERPOLATION & 1:
            self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION & 1)
            if self._active:
                self._latched_ns = t_ns
            elif not self.halted:
                self._standstill = False
                self._motion.decelerate(t_ns, self._parameters.deceleration, self._at_standstill)

    def latch(self, t_ns: int) -> None:
        """Follow the record, where the interpolation is active."""
        if self._active:
            super().latch(t_ns)


def _check_submode(subindex: int, value: Value) -> None:
    if int(value) > 0:
        raise SdoAbort(Abort.VALUE)


# Cyclic synchronous velocity: 60FFh + 60B1h is the velocity from one SYNC to the next.
#
# The velocity is cut to 607Fh and 6080h and the motor waits at a software limit; both set bit 11. The reference is
# the integral of the velocity: the plant follows it as it follows positions.
# Source: CiA 402-2, "Cyclic synchronous velocity mode", objects 60FFh, 60B1h, 60B2h, 607Dh, 607Fh, 6080h.

_VELOCITY_TARGET, _VELOCITY_OFFSET = key_of(0x60FF), key_of(0x60B1)


class CyclicVelocity(CyclicMode):
    """Mode 9."""

    number = OperationMode.CYCLIC_SYNC_VELOCITY
    target = 0x60FF
    needs = (key_of(target),)

    def latch(self, t_ns: int) -> None:
        """Go on from where the reference is, with the new velocity."""
        values, parameters = self._values, self._parameters
        wanted = (int(values[_VELOCITY_TARGET]) + int(values.get(_VELOCITY_OFFSET, 0))) * self._units.speed_scale
        velocity = min(max(wanted, -parameters.max_speed), parameters.max_speed)
        self.parts.loop.feed_torque()
        here, (low, high) = self._motion.demand(t_ns), parameters.fence
        self._motion.follow(uniform(here, velocity).fenced(low, high), t_ns)
        fenced = (here >= high and velocity > 0.0) or (here <= low and velocity < 0.0)
        self._limit(velocity != wanted or fenced or self._strains())


# Cyclic synchronous torque: 6071h + 60B2h, within 6072h, moves the motor against inertia and friction.
#
# The ideal plant follows references, so the drive works out what the torque does, from the motor's inertia, viscous
# and Coulomb friction at the joint (`MotorDynamics`), and gives the plant that motion. There is no gravity, no contact
# force and no coupling between the joints in it. Speed is cut to 607Fh and 6080h, and the motor waits at a software
# limit; a cut of torque, speed or position sets bit 11. 6074h and 6077h show the torque that acts: the torque loop
# is ideal. Torques are in 1/1000 of the plant's rated torque, which 6076h shows to the master.
# Source: CiA 402-2, "Cyclic synchronous torque mode", objects 6071h, 6072h, 6074h, 6077h, 60B2h.

_TORQUE_TARGET, _TORQUE_OFFSET = key_of(0x6071), key_of(0x60B2)


class CyclicTorque(CyclicMode):
    """Mode 10."""

    number = OperationMode.CYCLIC_SYNC_TORQUE
    target = 0x6071
    needs = (key_of(target),)

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._torque = 0

    def start(self, word: int, t_ns: int) -> None:
        """No torque until a target comes."""
        self._torque = 0
        super().start(word, t_ns)

    def leave(self, t_ns: int) -> None:
        """The torque is the plant's again."""
        self._give_up()

    def latch(self, t_ns: int) -> None:
        """Go on with the velocity that the last torque has left."""
        values, parameters, parts = self._values, self._parameters, self.parts
        wanted = int(values[_TORQUE_TARGET]) + int(values.get(_TORQUE_OFFSET, 0))
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


# Profile position: set-points by handshake, one under way and one waiting, each a trapezoidal move.
#
# A rising edge of controlword bit 4 offers a set-point (607Ah with 6081h, 6083h and 6084h of that moment); bit 5 puts
# it in place of everything else at once, bit 6 makes it relative to the set-point before. Statusword bit 12 is set when
# it was taken, and stays while bit 4 does or while no further one could be taken; one offered then is ignored.
# The next set-point starts when the last is reached: the actual position has been within 6067h for 6068h (bit 10).
# Not here: bit 9 (change on set-point), 60F2h. Halt interrupts a move, which goes on when halt is over.
# Source: CiA 402-2, "Profile position mode", objects 6067h, 6068h, 607Ah, 607Dh, 607Fh, 6081h, 6083h, 6084h, 6086h.

_PROFILE_SPEED = key_of(0x6081)


class SetPoint(NamedTuple):
    """One move.

    Attributes:
        counts: target within the software limits, motor counts.
        rates: of the move; with a speed of 0 the drive stands still.
        limited: the master wanted to go beyond.
    """

    counts: float
    rates: Rates
    limited: bool


class ProfilePosition(ProfiledMode):
    """Mode 1."""

    number = OperationMode.PROFILE_POSITION
    needs = (key_of(0x607A), key_of(0x6081))

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._active: SetPoint | None = None
        self._next: SetPoint | None = None
        self._last = 0
        self._inside_ns: int | None = None
        self._reached = self._offered = False

    def start(self, word: int, t_ns: int) -> None:
        """No set-point; the present position is what relative ones begin from."""
        self._active = self._next = self._inside_ns = None
        self._offered = self._reached = False
        self._last = round(self._units.position(self._motion.demand(t_ns)))
        super().start(word, t_ns)
        self._timer.arm(t_ns + STEP_NS)

    def status(self) -> int:
        """Target reached (with halt: standing still), set-point acknowledge."""
        acknowledged = self._offered or self._next is not None
        reached = super().status() if self.halted else REACHED * self._reached
        return reached | acknowledged << SETPOINT_ACKNOWLEDGE

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """A set-point is offered, or the offer taken back."""
        offers = word >> NEW_SETPOINT & 1
        if not offers:
            self._offered = False
        elif changed >> NEW_SETPOINT & 1:
            at_once = bool(word >> CHANGE_IMMEDIATELY & 1)
            if at_once or self._next is None:
                self._offered = True
                point = self._set_point(relative=bool(word >> RELATIVE & 1))
                if at_once or self._active is None or self._reached:
                    self._next = None
                    self._begin(point, t_ns)
                else:
                    self._next = point

    def resume(self, t_ns: int) -> None:
        """The interrupted move goes on."""
        if self._active is not None and not self._reached:
            self._move(self._active, t_ns)

    def _set_point(self, relative: bool) -> SetPoint:
        parameters, units = self._parameters, self._units
        wanted = int(self._values[_POSITION_TARGET]) + (self._last if relative else 0)
        target = self._last = parameters.clamp(wanted)
        speed = min(int(self._values.get(_PROFILE_SPEED, 0)) * units.speed, parameters.max_speed)
        rates = Rates(speed, parameters.acceleration, parameters.deceleration or parameters.acceleration)
        return SetPoint(units.counts(target), rates, limited=target != wanted)

    def _begin(self, point: SetPoint, t_ns: int) -> None:
        self._active, self._inside_ns, self._reached = point, None, False
        self._limit(point.limited)
        if not self.halted:
            self._move(point, t_ns)
        self.parts.show()

    def _move(self, point: SetPoint, t_ns: int) -> None:
        if point.rates.speed:
            self._motion.move(point.counts, t_ns, point.rates)
        else:
            self._motion.decelerate(t_ns, point.rates.deceleration)

    def watch(self, t_ns: int, counts: float) -> None:
        """Look whether the set-point is reached."""
        point = self._active
        if point is not None and not self._reached and not self.halted:
            if abs(point.counts - counts) > self._parameters.position_window:
                self._inside_ns = None
            elif self._inside_ns is None:
                self._inside_ns = t_ns
            if self._inside_ns is not None and t_ns - self._inside_ns >= self._parameters.position_time_ns:
                self._reached = True
                following, self._next = self._next, None
                if following is not None:
                    self._begin(following, t_ns)
                self.parts.show()
        self._limit((point is not None and point.limited) or self._strains())


MODES: tuple[type[DriveMode], ...] = (
    DriveMode,
    ProfilePosition,
    Homing,
    InterpolatedPosition,
    CyclicPosition,
    CyclicVelocity,
    CyclicTorque,
)


def make_modes(parts: DriveParts) -> dict[int, DriveMode]:
    """The modes that a drive offers: known here, their objects in the EDS, and claimed by its 6502h if it has one."""
    dictionary = parts.node.dictionary
    claimed = dictionary.number(0x6502) or ~0
    return {
        int(mode.number): mode(parts)
        for mode in MODES
        if not mode.number or (claimed >> mode.number - 1 & 1 and all(key in dictionary for key in mode.needs))
    }
