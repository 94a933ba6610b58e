"""Homing: limit switches, index pulses, or the present position.

    method  home
    1, 2    first index pulse behind the edge of the negative or positive limit switch
    17, 18  the edge of the negative or positive limit switch
    33, 34  first index pulse in negative or positive direction
    35, 37  the present position

The motor searches the switch at 6099h:01 and passes its edge and the pulses at 6099h:02, all with 609Ah. Hardware
catches edge and pulse at their exact place; then the motor drives back to it. The encoder gives one pulse a motor turn.
There is no home switch: other methods are refused with 06090030h. Bits 13, 12 and 10 of the statusword mean: 000 under
way, 001 not started or interrupted, 011 done, 100 error and moving, 101 error and at rest.
Zero is the home position *plus* the home offset, by the clause: at home the actual position is then -607Ch.
These are errors: an unknown method, a speed of 0, no switch within `MAX_SEARCH_S`, no pulse within two turns. Software
limits do not act meanwhile.
Source: CiA 402-2, "Homing mode", objects 607Ch, 6098h, 6099h, 609Ah.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from enum import Enum, auto
from functools import partial
from math import ceil, floor

from canprobe.fieldbus.drive.mode import REACHED_FLAG, ProfiledMode
from canprobe.fieldbus.drive.parameters import check_among
from canprobe.fieldbus.drive.parts import NEGATIVE_SWITCH_FLAG, POSITIVE_SWITCH_FLAG, DriveParts
from canprobe.fieldbus.drive.profile import Rates
from canprobe.fieldbus.drive.reference import STEP_NS
from canprobe.fieldbus.node.dictionary import key_of
from canprobe.fieldbus.protocol.cia402 import HOMING_ATTAINED_BIT, HOMING_ERROR_BIT, HOMING_START_BIT, OperationMode

PRESENT_POSITION_METHODS = frozenset({35, 37})
INDEX_DIRECTIONS = {33: -1, 34: 1}
SWITCH_DIRECTIONS = {1: -1, 2: 1, 17: -1, 18: 1}
SWITCH_AND_INDEX_METHODS = frozenset({1, 2})
_SEARCHING_METHODS = frozenset({*INDEX_DIRECTIONS, *SWITCH_DIRECTIONS})
HOMING_METHODS = frozenset({0, *PRESENT_POSITION_METHODS, *_SEARCHING_METHODS})
MAX_SEARCH_TURNS = 2.0
MAX_SEARCH_S = 180.0
"""Longest time at full speed to find a limit switch, or to leave it."""
_METHOD_KEY = key_of(0x6098)
_SWITCH_SPEED_SUB, _ZERO_SPEED_SUB = 1, 2  # sub-indices of 6099h


class HomingPhase(Enum):
    """Phases of a homing run."""

    IDLE = auto()
    SEARCHING = auto()
    RETURNING = auto()
    DONE = auto()
    FAILED = auto()


_PHASE_BITS = {HomingPhase.DONE: REACHED_FLAG | 1 << HOMING_ATTAINED_BIT, HomingPhase.FAILED: 1 << HOMING_ERROR_BIT}
_MOVING_PHASES = frozenset({HomingPhase.SEARCHING, HomingPhase.RETURNING})


class HomingMode(ProfiledMode):
    """Mode 6."""

    number = OperationMode.HOMING
    needs = (_METHOD_KEY,)

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._phase = HomingPhase.IDLE
        self._method = 0
        self._home = 0.0  # counts
        parts.node.dictionary.on_check(0x6098, partial(check_among, HOMING_METHODS))

    def reset(self) -> None:
        """Power on: the drive is not homed."""
        self._phase = HomingPhase.IDLE

    def start(self, word: int, t_ns: int) -> None:
        """Start; a drive that was homed stays homed."""
        if self._phase is not HomingPhase.DONE:
            self._phase = HomingPhase.IDLE
        super().start(word, t_ns)
        if not self.halted:
            self._motion.decelerate(t_ns, self._parameters.deceleration, self._at_standstill)

    def leave(self, t_ns: int) -> None:
        """Give up a run that is under way."""
        self._give_up()

    def status(self) -> int:
        """Bits for homing attained, error, and target reached, when at rest."""
        rests = self._standstill and self._phase in (HomingPhase.IDLE, HomingPhase.FAILED)
        return _PHASE_BITS.get(self._phase, 0) | REACHED_FLAG * rests

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Start with bit 4, and interrupt the run when it is cleared."""
        starts = word >> HOMING_START_BIT & 1
        if changed >> HOMING_START_BIT & 1 and not self.halted:
            if starts:
                self._begin(t_ns)
            elif self._phase in _MOVING_PHASES:
                self._stop(HomingPhase.IDLE, t_ns)

    def resume(self, t_ns: int) -> None:
        """Start homing again, if bit 4 is still set."""
        if self._word >> HOMING_START_BIT & 1:
            self._begin(t_ns)

    def _halt(self, t_ns: int) -> None:
        self._give_up()
        super()._halt(t_ns)

    def _give_up(self) -> None:
        self._timer.cancel()
        if self._phase in _MOVING_PHASES:
            self._phase = HomingPhase.IDLE

    def _begin(self, t_ns: int) -> None:
        self._method, self._standstill = int(self._values.get(_METHOD_KEY, 0)), False
        here = self.parts.feedback.measure(t_ns)
        speeds = (_SWITCH_SPEED_SUB, _ZERO_SPEED_SUB) if self._method in SWITCH_DIRECTIONS else (_ZERO_SPEED_SUB,)
        if self._method in PRESENT_POSITION_METHODS:
            self._motion.decelerate(t_ns, self._parameters.homing_acceleration)
            self._home = here
            self._attain(t_ns)
        elif self._method in _SEARCHING_METHODS and all(map(self._speed, speeds)):
            self._phase = HomingPhase.SEARCHING
            self._search = self._find_home(here, t_ns)
            next(self._search)
            self._timer.arm(t_ns + STEP_NS)
        else:
            self._stop(HomingPhase.FAILED, t_ns)

    def watch(self, t_ns: int, counts: float) -> None:
        """Catch the switch, its edge, and the index pulse."""
        if self._phase is HomingPhase.SEARCHING:
            with suppress(StopIteration):
                self._search.send((t_ns, counts))

    def _find_home(self, counts: float, t_ns: int) -> Generator[None, tuple[int, float], None]:
        """Drive to the switch, off it and to the pulse, as far as the method has them, and turn round.

        It gets the time and the position of the motor, counts, at each look.
        """
        direction = 1 if self._units.scale > 0.0 else -1  # in which the motor passes the edge or the pulse
        if self._method in SWITCH_DIRECTIONS:
            direction *= -SWITCH_DIRECTIONS[self._method]  # away from the switch
            if not self._on_switch():
                reach = MAX_SEARCH_S * self._speed(_SWITCH_SPEED_SUB)
                self._drive_to(counts - direction * reach, t_ns, _SWITCH_SPEED_SUB)
            while not self._on_switch():
                t_ns, counts = yield
            self._drive_to(counts + direction * MAX_SEARCH_S * self._speed(_ZERO_SPEED_SUB), t_ns)
            while self._on_switch():
                t_ns, counts = yield
            home = self.parts.feedback.switch_positions()[SWITCH_DIRECTIONS[self._method] > 0]
        else:
            direction, home = direction * INDEX_DIRECTIONS[self._method], counts
        if self._method in SWITCH_AND_INDEX_METHODS or self._method in INDEX_DIRECTIONS:
            self._drive_to(home + direction * MAX_SEARCH_TURNS * self._units.turn, t_ns)
            home = next_pulse(home, direction, self._units.turn)
            while (counts - home) * direction < 0.0:
                t_ns, counts = yield
        self._phase, self._home = HomingPhase.RETURNING, home
        self._drive_to(home, t_ns)

    def _on_switch(self) -> bool:
        wanted = NEGATIVE_SWITCH_FLAG if SWITCH_DIRECTIONS[self._method] < 0 else POSITIVE_SWITCH_FLAG
        return bool(self.parts.feedback.switches() & wanted)

    def _drive_to(self, counts: float, t_ns: int, speed: int = _ZERO_SPEED_SUB) -> None:
        rate = self._parameters.homing_acceleration
        self._motion.move(counts, t_ns, Rates(self._speed(speed), rate, rate), self._arrived)

    def _speed(self, subindex: int) -> float:
        wanted = self.parts.node.dictionary.number(0x6099, subindex) * self._units.speed
        return min(wanted, self._parameters.max_speed)

    def _arrived(self, t_ns: int) -> None:
        if self._phase is HomingPhase.RETURNING:
            self._attain(t_ns)
        else:
            self._timer.cancel()
            self._phase, self._standstill = HomingPhase.FAILED, True
        self.parts.show()

    def _attain(self, t_ns: int) -> None:
        self._timer.cancel()
        units, dictionary = self._units, self.parts.node.dictionary
        units.origin = self._home + dictionary.number(0x607C) * units.scale
        dictionary.put(0x607A, 0, round(units.position(self._motion.demand(t_ns))))
        self._phase = HomingPhase.DONE

    def _stop(self, phase: HomingPhase, t_ns: int) -> None:
        self._timer.cancel()
        self._phase = phase
        self._motion.decelerate(t_ns, self._parameters.homing_acceleration, self._at_standstill)


def next_pulse(counts: float, direction: int, turn: float) -> float:
    """Position of the next index pulse behind `counts`, in a direction; a pulse right there has been passed."""
    turns = counts / turn
    return (floor(turns) + 1 if direction > 0 else ceil(turns) - 1) * turn
