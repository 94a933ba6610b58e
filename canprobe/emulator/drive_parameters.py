"""Parameters of a CiA 402 drive as its application uses them, read from the dictionary whenever one is written.

Source: CiA 402-2, objects 6007h, 605Ah–605Eh, 6065h, 6066h, 607Dh, 6084h, 6085h, 60C2h.
"""

from __future__ import annotations

from canprobe.eds import MISSED_SYNCS
from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.dictionary import Dictionary
from canprobe.emulator.entries import Value

QUICK_STOP_OPTIONS = frozenset({1, 2, 5, 6})
STAYS_STOPPED = frozenset({5, 6})  # of 605Ah: remain in QUICK_STOP_ACTIVE
NO_WINDOW = 0xFFFFFFFF
DEFAULT_MISSES = 5
"""Of a drive whose EDS has no 2000h."""
_INDICES = (
    0x1006,
    MISSED_SYNCS,
    0x6007,
    0x605A,
    0x605B,
    0x605C,
    0x605E,
    0x6065,
    0x6066,
    0x607D,
    0x6084,
    0x6085,
    0x60C2,
)


class DriveParameters:
    """Plain numbers; `read` refreshes them.

    Attributes:
        interpolation_ns: 60C2h, time to reach a latched target.
        cycle_ns: SYNC period, 1006h or else 60C2h.
        following_window, following_timeout_ns: 6065h (counts), 6066h.
        misses: 2000h, SYNCs missed before the master is taken for dead.
        low, high: 607Dh, counts; low >= high means no limits.
        abort_connection, quick_stop, shutdown, disable, fault_reaction: option codes.
        deceleration, quick_deceleration: 6084h, 6085h, counts/s².
    """

    def __init__(self, dictionary: Dictionary, has_misses: bool = False) -> None:
        """`has_misses` where 2000h is what it is in our own EDS."""
        self._dictionary = dictionary
        self._has_misses = has_misses
        self.read()
        for index in _INDICES:
            dictionary.on_write(index, lambda _sub, _value: self.read())
        dictionary.on_check(0x605A, _check_quick_stop)
        dictionary.on_check(0x60C2, _check_interpolation)

    def read(self) -> None:
        """Take the present values of the dictionary."""
        number = self._dictionary.number
        self.interpolation_ns = number(0x60C2, 1, 25) * 10 ** max(0, 9 + number(0x60C2, 2, -4))
        self.cycle_ns = number(0x1006) * 1000 or self.interpolation_ns
        self.following_window = number(0x6065, 0, NO_WINDOW)
        self.following_timeout_ns = number(0x6066) * 1_000_000
        self.misses = number(MISSED_SYNCS, 0, DEFAULT_MISSES) if self._has_misses else DEFAULT_MISSES
        self.low, self.high = number(0x607D, 1), number(0x607D, 2)
        self.abort_connection = number(0x6007, 0, 3)
        self.quick_stop = number(0x605A, 0, 2)
        self.shutdown, self.disable = number(0x605B, 0, 0), number(0x605C, 0, 1)
        self.fault_reaction = number(0x605E, 0, 2)
        self.deceleration, self.quick_deceleration = number(0x6084), number(0x6085)

    @property
    def quick_stop_rate(self) -> int:
        """Deceleration of a quick stop: the slow-down ramp for 605Ah = 1, 5, the quick stop ramp for 2, 6."""
        return self.deceleration if self.quick_stop in (1, 5) else self.quick_deceleration

    @property
    def fault_rate(self) -> int:
        """Deceleration of the fault reaction, 605Eh; 0 means the brake at once."""
        return {1: self.deceleration, 2: self.quick_deceleration}.get(self.fault_reaction, 0)

    def clamp(self, target: int) -> int:
        """The target within the software limits."""
        return min(max(target, self.low), self.high) if self.low < self.high else target


def _check_quick_stop(subindex: int, value: Value) -> None:
    if value not in QUICK_STOP_OPTIONS:
        raise SdoAbort(Abort.VALUE)


def _check_interpolation(subindex: int, value: Value) -> None:
    too_fine = subindex == 2 and int(value) < -9
    if (subindex == 1 and not value) or too_fine or (subindex == 2 and int(value) > 0):
        raise SdoAbort(Abort.VALUE)
