"""Factor group: the master's position units ↔ motor counts, polarity, and where the zero is.

    position = (counts - origin) · 6092h / (608Fh · 6091h),   each a quotient :01 / :02

As delivered the quotients cancel: a unit is a count. Of an EDS without one of the objects it counts as 1.
Source: CiA 402-2, "Factor group", objects 607Eh (bit 7 position, bit 6 velocity), 608Fh, 6091h, 6092h.
"""

from __future__ import annotations

from canprobe.emulator.dictionary import Dictionary

FACTORS = (0x607E, 0x608F, 0x6091, 0x6092)
_RESOLUTION, _GEAR, _FEED = FACTORS[1:]
_POSITION, _VELOCITY = 7, 6  # bits of 607Eh


class Units:
    """Conversions of one drive.

    Attributes:
        scale: counts per position unit; negative where 607Eh turns positions round.
        speed_scale: the same for velocities, with their own polarity.
        magnitude: without sign, for windows, speeds and accelerations.
        turn: counts of one motor turn, 608Fh; also the distance of the index pulses.
        origin: counts at position 0; homing sets it.
    """

    __slots__ = ("magnitude", "origin", "scale", "speed_scale", "turn")

    def __init__(self) -> None:
        self.scale = self.speed_scale = self.magnitude = self.turn = 1.0
        self.origin = 0.0

    def read(self, dictionary: Dictionary) -> None:
        """Take the present factors."""
        self.turn = _quotient(dictionary, _RESOLUTION)
        self.magnitude = self.turn * _quotient(dictionary, _GEAR) / _quotient(dictionary, _FEED)
        polarity = dictionary.number(0x607E)
        self.scale = -self.magnitude if polarity >> _POSITION & 1 else self.magnitude
        self.speed_scale = -self.magnitude if polarity >> _VELOCITY & 1 else self.magnitude

    def position(self, counts: float) -> float:
        """Motor counts → position units."""
        return (counts - self.origin) / self.scale

    def counts(self, position: float) -> float:
        """Position units → motor counts."""
        return position * self.scale + self.origin


def _quotient(dictionary: Dictionary, index: int) -> float:
    return (dictionary.number(index, 1) or 1) / (dictionary.number(index, 2) or 1)
