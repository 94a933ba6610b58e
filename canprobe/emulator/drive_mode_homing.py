"""Homing: the present position (methods 35, 37), or the first index pulse in one direction (33 negative, 34 positive).

The plant has no limit and no home switches, so methods 1–30 are refused with 06090030h. The encoder gives one index
pulse a motor turn, where the counter is a multiple of 608Fh; it is caught by hardware, at its exact place, while the
motor searches at 6099h:02 with 609Ah, and then driven back to. Bits 13, 12, 10 of the statusword:
000 under way, 001 not started or interrupted, 011 done, 100 error and moving, 101 error and at rest.
Zero is the home position *plus* the home offset, as the clause says: at home the actual position is then -607Ch.
An error is: no such method, a search speed of 0, no pulse within two turns. Software limits do not act meanwhile.
Source: CiA 402-2, "Homing mode", objects 607Ch, 6098h, 6099h, 609Ah.
"""

from __future__ import annotations

from enum import Enum, auto
from math import ceil, floor

from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.drive_mode import REACHED, DriveMode, DriveParts
from canprobe.emulator.drive_motion import STEP_NS
from canprobe.emulator.drive_profile import trapezoid
from canprobe.emulator.entries import Value, key_of
from canprobe.protocol.cia402 import HOMING_ATTAINED, HOMING_ERROR, HOMING_START

HERE = frozenset({35, 37})
INDEX_DIRECTIONS = {33: -1, 34: 1}
METHODS = frozenset({0, *HERE, *INDEX_DIRECTIONS})
SEARCH_TURNS = 2.0
_METHOD, _TARGET = key_of(0x6098), key_of(0x607A)


class Phase(Enum):
    """Where a homing run is."""

    IDLE = auto()
    SEARCHING = auto()
    RETURNING = auto()
    DONE = auto()
    FAILED = auto()


_BITS = {
    Phase.IDLE: 0,
    Phase.SEARCHING: 0,
    Phase.RETURNING: 0,
    Phase.DONE: REACHED | 1 << HOMING_ATTAINED,
    Phase.FAILED: 1 << HOMING_ERROR,
}
_UNDER_WAY = frozenset({Phase.SEARCHING, Phase.RETURNING})


class Homing(DriveMode):
    """Mode 6."""

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._timer = parts.node.core.timers.new(self._watch)
        self._phase = Phase.IDLE
        self._direction = 1
        self._home = self._was = self._limit_counts = 0.0
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
        self._timer.cancel()
        if self._phase in _UNDER_WAY:
            self._phase = Phase.IDLE

    def status(self) -> int:
        """Homing attained, error, and target reached (when at rest)."""
        rests = self._standstill and self._phase in (Phase.IDLE, Phase.FAILED)
        return _BITS[self._phase] | REACHED * rests

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
        self._timer.cancel()
        if self._phase in _UNDER_WAY:
            self._phase = Phase.IDLE
        super()._halt(t_ns)

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
        self._limit_counts = self._was + self._direction * SEARCH_TURNS * self._units.turn
        self._drive_to(self._limit_counts, t_ns)
        self._timer.arm(t_ns + STEP_NS)

    def _drive_to(self, counts: float, t_ns: int) -> None:
        rate = self._parameters.homing_acceleration
        here, speed = self._motion.demand(t_ns), self._motion.speed(t_ns)
        profile = trapezoid(here, speed, counts, speed=self._speed(), acceleration=rate, deceleration=rate)
        self._motion.follow(profile, t_ns, self._arrived)

    def _speed(self) -> float:
        wanted = self.parts.node.dictionary.number(0x6099, 2) * self._units.magnitude
        return min(wanted, self._parameters.max_speed)

    def _watch(self, due_ns: int) -> None:
        if (look := self._look()) is None:
            return
        t_ns, counts = look
        self._timer.arm_next(due_ns, STEP_NS)
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
        self._values[_TARGET] = round(units.position(self._motion.demand(t_ns)))
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
