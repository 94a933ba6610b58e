"""Parameters of a CiA 402 drive as its application uses them, read from the dictionary whenever one is written.

Source: CiA 402-2, objects 6007h, 605Ah–605Eh, 6065h–6068h, 6072h, 607Dh, 607Fh, 6080h, 6083h–6085h, 609Ah, 60C2h.
"""

from __future__ import annotations

from collections.abc import Container
from functools import partial
from math import inf

from canprobe.fieldbus.drive.units import FACTOR_INDICES, Delivery, Units
from canprobe.fieldbus.eds.packaged import MISSED_SYNCS, SYNC_FACTOR
from canprobe.fieldbus.node.dictionary import Dictionary, Value
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

STAYING_QUICK_STOP_OPTIONS = frozenset({5, 6})  # values of 605Ah by which the drive stays in QUICK_STOP_ACTIVE
UNLIMITED_WINDOW = 0xFFFFFFFF
DEFAULT_ACCELERATION = 100_000
"""Acceleration of a drive whose EDS has no profile acceleration, position units/s²."""
DEFAULT_WINDOW = 10
"""Position window of a drive whose EDS has no 6067h, position units."""
CONTROL_PERIOD_NS = 1_000_000
"""Period of the position loop in the drive; a target is reached after it where 60C2h is 0."""
PEAK_TORQUE_PERMILLE = 2000
"""Greatest torque of the motors of the plant, 1/1000 of the rated torque."""
_ALLOWED_OPTIONS = {0x605A: frozenset({1, 2, 5, 6}), 0x605D: frozenset({1, 2}), 0x6086: frozenset({0})}
_INDICES = (
    *(0x1006, MISSED_SYNCS, SYNC_FACTOR, 0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E),
    *(0x6065, 0x6066, 0x6067, 0x6068, 0x6072, 0x607D, 0x607F, 0x6080, 0x6083, 0x6084, 0x6085, 0x609A, 0x60C2),
    *FACTOR_INDICES,
)


class DriveParameters:
    """Parameters of a drive as numbers, which `read` refreshes. Lengths, speeds and accelerations are in counts here.

    Attributes:
        units: units of the factor group.
        interpolation_ns: time to reach a latched target: 60C2h, or 1006h of a drive without it; never 0.
        following_window, following_timeout_ns: window 6065h (counts, infinite for none) and time-out 6066h.
        position_window, position_time_ns: window 6067h (counts, infinite for none) and time 6068h.
        misses: number of missed SYNCs after which the master counts as lost: 2000h or 200Eh, by the make; 0: never.
        patience_ns: time without a SYNC after which the master counts as lost: that many periods of 1006h, or else of
            60C2h, and a half; 0: never, as where neither is set.
        low, high: software limits 607Dh, position units; low >= high means no limits.
        abort_connection, quick_stop, shutdown, disable: option codes 6007h, 605Ah, 605Bh, 605Ch.
        acceleration, deceleration, homing_acceleration: rates 6083h, 6084h, 609Ah, counts/s².
        quick_stop_rate, halt_rate, fault_rate: decelerations by 605Ah, 605Dh, 605Eh: the slow-down ramp 6084h or the
            quick stop ramp 6085h, counts/s²; 0 means the brake at once.
        max_speed: the lower limit of 607Fh and 6080h, counts/s; infinite without both.
        max_torque: torque limit 6072h, permille.
    """

    def __init__(self, dictionary: Dictionary, delivery: Delivery) -> None:
        self._dictionary = dictionary
        self._delivered_misses = delivery.misses
        self._misses = [index for index in (MISSED_SYNCS, SYNC_FACTOR) if dictionary.has_known(index)]
        self.units = Units(dictionary, delivery)
        self.read()
        dictionary.on_change(self.read, *_INDICES)
        for index, allowed in _ALLOWED_OPTIONS.items():
            dictionary.on_check(index, partial(check_among, allowed))
        dictionary.on_check(0x60C2, partial(_check_interpolation, dictionary.number(0x60C2, 1, -1)))

    def read(self) -> None:
        """Read the present values of the dictionary."""
        number = self._dictionary.number
        self.units.read()
        sync_ns, value = number(0x1006) * 1000, number(0x60C2, 1, -1)
        period_ns = sync_ns if value < 0 else value * 10 ** max(0, 9 + number(0x60C2, 2, -3))  # CiA 402: ms by default
        self.interpolation_ns = period_ns or CONTROL_PERIOD_NS
        self.following_window, self.following_timeout_ns = self._window(0x6065), number(0x6066) * 1_000_000
        self.position_window = self._window(0x6067, DEFAULT_WINDOW)
        self.position_time_ns = number(0x6068) * 1_000_000
        self.misses = number(self._misses[0]) if self._misses else self._delivered_misses
        cycle_ns = sync_ns or period_ns
        self.patience_ns = self.misses * cycle_ns + cycle_ns // 2 if self.misses else 0
        self.low, self.high = number(0x607D, 1), number(0x607D, 2)
        self.abort_connection, self.quick_stop = number(0x6007, 0, 3), number(0x605A, 0, 2)
        self.shutdown, self.disable = number(0x605B, 0, 0), number(0x605C, 0, 1)
        units = self.units
        slow, quick = number(0x6084) * units.acceleration, number(0x6085) * units.acceleration
        self.acceleration = number(0x6083) * units.acceleration or DEFAULT_ACCELERATION * units.magnitude
        self.homing_acceleration = number(0x609A) * units.acceleration or DEFAULT_ACCELERATION * units.magnitude
        self.deceleration = slow
        self.quick_stop_rate = slow if self.quick_stop in (1, 5) else quick
        self.halt_rate = quick if number(0x605D, 0, 1) == 2 else slow
        self.fault_rate = {1: slow, 2: quick}.get(number(0x605E, 0, 2), 0)
        profile = number(0x607F) * units.speed if units.knows_speed else 0.0
        motor = number(0x6080) / 60.0 * units.turn if units.knows_turn else 0.0
        self.max_speed = min(profile or inf, motor or inf)
        self.max_torque = min(number(0x6072, 0, PEAK_TORQUE_PERMILLE), PEAK_TORQUE_PERMILLE)

    def _window(self, index: int, absent: int = UNLIMITED_WINDOW) -> float:
        value = self._dictionary.number(index, 0, absent)
        return inf if value == UNLIMITED_WINDOW else value * self.units.magnitude

    @property
    def fence(self) -> tuple[float, float]:
        """Software limits, counts, the lower one first; infinite for none."""
        if self.low >= self.high:
            return -inf, inf
        ends = self.units.counts(self.low), self.units.counts(self.high)
        return min(ends), max(ends)

    def clamp(self, target: int) -> int:
        """The target within the software limits."""
        low, high = self.low, self.high
        return target if low <= target <= high or low >= high else min(max(target, low), high)


def check_among(allowed: Container[Value], subindex: int, value: Value) -> None:
    """Check that a value is an allowed one. Raises SdoAbort."""
    if value not in allowed:
        raise SdoAbort(Abort.VALUE)


def _check_interpolation(initial: int, subindex: int, value: Value) -> None:
    """Refuse a period of 0, except in a drive that boots with it."""
    if (subindex == 1 and not value and initial) or (subindex == 2 and not -9 <= int(value) <= 0):
        raise SdoAbort(Abort.VALUE)
