"""The modes of operation: cyclic synchronous position, velocity and torque, profile position, homing.

A target that is further from the one before than 607Fh and 6080h let the motor go in the time between them is not
followed: reference limit, a fault. A target that was corrupted on its way is one, unless it is off by less.
Offsets of velocity and torque (60B1h, 60B2h) are feed-forwards of a dynamic plant; the ideal one needs none.
Source: CiA 402-2, "Cyclic synchronous position mode", objects 607Ah, 607Dh, 607Fh, 6080h, 60B0h–60B2h,
60C2h; error code 8612h.
"""

from __future__ import annotations

from enum import Enum, auto
from math import ceil, floor
from typing import NamedTuple

from canprobe.emulator.drive.mode import REACHED, CyclicMode, DriveMode, DriveParts, ProfiledMode
from canprobe.emulator.drive.reference import STEP_NS, Rates, torque_run, uniform
from canprobe.emulator.node.dictionary import Abort, SdoAbort, Value, key_of
from canprobe.protocol.cia402 import (
    CHANGE_IMMEDIATELY,
    HOMING_ATTAINED,
    HOMING_ERROR,
    HOMING_START,
    NEW_SETPOINT,
    RELATIVE,
    SETPOINT_ACKNOWLEDGE,
    OperationMode,
)
from canprobe.protocol.frames import REFERENCE_LIMIT

# Cyclic synchronous position: a target latched at a SYNC is reached by a straight ramp after 60C2h.

ROUNDING_COUNTS = 2
_POSITION_TARGET = key_of(0x607A)
_POSITION_OFFSET = key_of(0x60B0)


class CyclicPosition(CyclicMode):
    """Mode 8. A ramp under way is not begun again where a target is missing."""

    number = OperationMode.CYCLIC_SYNC_POSITION
    target = 0x607A
    needs = (target,)
    repeats = False

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._latched_ns = 0

    def start(self, word: int, t_ns: int) -> None:
        """The first target is as far away as the time since now allows."""
        self._latched_ns = t_ns
        super().start(word, t_ns)

    def sync(self, t_ns: int, counts: float) -> None:
        """Watch the following error too."""
        if not self._lags(t_ns, counts):
            super().sync(t_ns, counts)

    def latch(self, t_ns: int) -> None:
        """Follow the target from where the reference is."""
        values, parameters, units, loop = self._values, self._parameters, self._units, self.parts.loop
        target: int = values[_POSITION_TARGET] + values.get(_POSITION_OFFSET, 0)  # type: ignore[assignment, operator]
        allowed = parameters.clamp(target)
        counts = allowed * units.scale + units.origin
        passed_ns = max(parameters.interpolation_ns, t_ns - self._latched_ns)
        if abs(counts - self._motion.demand(t_ns)) > parameters.max_speed * passed_ns * 1e-9 + ROUNDING_COUNTS:
            self.parts.fault(REFERENCE_LIMIT, t_ns)
            return
        self._latched_ns = t_ns
        if loop.changed:
            loop.feed_forward()
        self._motion.reach(counts, t_ns, parameters.interpolation_ns)
        self._limit(allowed != target or self._strains())


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
    needs = (target,)

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
    needs = (target,)

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
    needs = (0x607A, 0x6081)

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
        speed = min(int(self._values.get(_PROFILE_SPEED, 0)) * units.magnitude, parameters.max_speed)
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


# Homing: the present position (methods 35, 37), or the first index pulse in one direction (33 negative, 34 positive).
#
# The plant has no limit and no home switches, so methods 1–30 are refused with 06090030h. The encoder gives one index
# pulse a motor turn, where the counter is a multiple of 608Fh; it is caught by hardware, at its exact place, while the
# motor searches at 6099h:02 with 609Ah, and then driven back to. Bits 13, 12, 10 of the statusword:
# 000 under way, 001 not started or interrupted, 011 done, 100 error and moving, 101 error and at rest.
# Zero is the home position *plus* the home offset, by the clause: at home the actual position is then -607Ch.
# An error is: no such method, a search speed of 0, no pulse within two turns. Software limits do not act meanwhile.
# Source: CiA 402-2, "Homing mode", objects 607Ch, 6098h, 6099h, 609Ah.

HERE = frozenset({35, 37})
INDEX_DIRECTIONS = {33: -1, 34: 1}
METHODS = frozenset({0, *HERE, *INDEX_DIRECTIONS})
SEARCH_TURNS = 2.0
_METHOD = key_of(0x6098)


class Phase(Enum):
    """Where a homing run is."""

    IDLE = auto()
    SEARCHING = auto()
    RETURNING = auto()
    DONE = auto()
    FAILED = auto()


_BITS = {Phase.DONE: REACHED | 1 << HOMING_ATTAINED, Phase.FAILED: 1 << HOMING_ERROR}
_UNDER_WAY = frozenset({Phase.SEARCHING, Phase.RETURNING})


class Homing(ProfiledMode):
    """Mode 6."""

    number = OperationMode.HOMING
    needs = (0x6098,)

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._phase = Phase.IDLE
        self._direction = 1
        self._home = self._was = 0.0
        parts.node.dictionary.on_check(0x6098, _check_method)

    def reset(self) -> None:
        """Power on: not homed, the zero is the counter's."""
        self._phase, self._units.origin = Phase.IDLE, 0.0

    def start(self, word: int, t_ns: int) -> None:
        """A drive that was homed stays so."""
        if self._phase is not Phase.DONE:
            self._phase = Phase.IDLE
        super().start(word, t_ns)
        if not self.halted:
            self._motion.decelerate(t_ns, self._parameters.deceleration, self._at_standstill)

    def leave(self, t_ns: int) -> None:
        """A run under way is given up."""
        self._give_up()

    def status(self) -> int:
        """Homing attained, error, and target reached (when at rest)."""
        rests = self._standstill and self._phase in (Phase.IDLE, Phase.FAILED)
        return _BITS.get(self._phase, 0) | REACHED * rests

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Bit 4 starts, and interrupts when it is taken away."""
        starts = word >> HOMING_START & 1
        if changed >> HOMING_START & 1 and not self.halted:
            if starts:
                self._begin(t_ns)
            elif self._phase in _UNDER_WAY:
                self._stop(Phase.IDLE, t_ns)

    def resume(self, t_ns: int) -> None:
        """With bit 4 still set, homing starts again."""
        if self._word >> HOMING_START & 1:
            self._begin(t_ns)

    def _halt(self, t_ns: int) -> None:
        self._give_up()
        super()._halt(t_ns)

    def _give_up(self) -> None:
        self._timer.cancel()
        if self._phase in _UNDER_WAY:
            self._phase = Phase.IDLE

    def _begin(self, t_ns: int) -> None:
        method, self._standstill = int(self._values.get(_METHOD, 0)), False
        speed = self._speed()
        if method in HERE:
            self._motion.decelerate(t_ns, self._parameters.homing_acceleration)
            self._home = self.parts.feedback.measure(t_ns)
            self._attain(t_ns)
        elif method in INDEX_DIRECTIONS and speed > 0.0:
            self._direction = INDEX_DIRECTIONS[method] if self._units.scale > 0 else -INDEX_DIRECTIONS[method]
            self._search(t_ns)
        else:
            self._stop(Phase.FAILED, t_ns)

    def _search(self, t_ns: int) -> None:
        self._phase = Phase.SEARCHING
        self._was = self.parts.feedback.measure(t_ns)
        self._drive_to(self._was + self._direction * SEARCH_TURNS * self._units.turn, t_ns)
        self._timer.arm(t_ns + STEP_NS)

    def _drive_to(self, counts: float, t_ns: int) -> None:
        rate = self._parameters.homing_acceleration
        self._motion.move(counts, t_ns, Rates(self._speed(), rate, rate), self._arrived)

    def _speed(self) -> float:
        wanted = self.parts.node.dictionary.number(0x6099, 2) * self._units.magnitude
        return min(wanted, self._parameters.max_speed)

    def watch(self, t_ns: int, counts: float) -> None:
        """Catch the index pulse."""
        if self._phase is Phase.SEARCHING:
            pulse = next_pulse(self._was, self._direction, self._units.turn)
            if (counts - pulse) * self._direction >= 0.0:
                self._home, self._phase = pulse, Phase.RETURNING
                self._drive_to(pulse, t_ns)

    def _arrived(self, t_ns: int) -> None:
        if self._phase is Phase.RETURNING:
            self._attain(t_ns)
        else:
            self._timer.cancel()
            self._phase, self._standstill = Phase.FAILED, True
        self.parts.show()

    def _attain(self, t_ns: int) -> None:
        self._timer.cancel()
        units = self._units
        units.origin = self._home + self.parts.node.dictionary.number(0x607C) * units.scale
        self._values[_POSITION_TARGET] = round(units.position(self._motion.demand(t_ns)))
        self._phase = Phase.DONE

    def _stop(self, phase: Phase, t_ns: int) -> None:
        self._timer.cancel()
        self._phase = phase
        self._motion.decelerate(t_ns, self._parameters.homing_acceleration, self._at_standstill)


def next_pulse(counts: float, direction: int, turn: float) -> float:
    """The next index pulse behind `counts`, in a direction; one that lies right there has been passed."""
    turns = counts / turn
    return (floor(turns) + 1 if direction > 0 else ceil(turns) - 1) * turn


def _check_method(subindex: int, value: Value) -> None:
    if value not in METHODS:
        raise SdoAbort(Abort.VALUE)


MODES: tuple[type[DriveMode], ...] = (
    DriveMode,
    ProfilePosition,
    Homing,
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
        if not mode.number or (claimed >> mode.number - 1 & 1 and all(map(dictionary.has_index, mode.needs)))
    }
