"""Factor group: the master's position units ↔ units of the plant's axis, polarity, and where the zero is.

    position = (counts - origin) · 6092h / (608Fh · 6091h),   each a quotient :01 / :02

A count is the position unit of the drive as delivered, whatever factors its EDS has: a cell states the units of its
drives, not the lines of their encoders. An object that the EDS lacks counts as 1. Velocities and accelerations are in
the units of 60A9h and 60AAh, whose turns are those of the shaft: 6091h motor turns each.
Source: CiA 402-2, "Factor group", objects 607Eh (bit 7 position, bit 6 velocity), 608Fh, 6091h, 6092h, 60A9h, 60AAh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from canprobe.fieldbus.node.dictionary import Dictionary
from canprobe.fieldbus.protocol.si_unit import ACCELERATION_UNIT_INDEX, VELOCITY_UNIT_INDEX, rate_unit

FACTOR_INDICES = (0x607E, 0x608F, 0x6091, 0x6092, VELOCITY_UNIT_INDEX, ACCELERATION_UNIT_INDEX)
_RESOLUTION_INDEX, _GEAR_INDEX, _FEED_INDEX = FACTOR_INDICES[1:4]
_POSITION_POLARITY_BIT, _VELOCITY_POLARITY_BIT = 7, 6  # bits of 607Eh
DEFAULT_COUNTS_PER_TURN = 4096.0
"""Counts of a motor turn of a drive whose EDS has no 608Fh."""
DEFAULT_MISSED_SYNCS = 5
"""Missed SYNCs after which the master counts as lost, for a drive whose EDS has no object for it."""
_Number = Callable[[int, int], int]


@dataclass(frozen=True, slots=True)
class Delivery:
    """Settings of a drive as it is delivered for its cell, where its EDS has no object for them.

    Attributes:
        turn: number of position units in a motor turn; None: unknown.
        metre: number of position units in a metre; None: unknown.
        misses: number of missed SYNCs after which the master counts as lost.
    """

    turn: float | None = DEFAULT_COUNTS_PER_TURN
    metre: float | None = None
    misses: int = DEFAULT_MISSED_SYNCS


class Units:
    """Conversions of one drive.

    Args:
        dictionary: dictionary of the drive; its defaults are the factors as delivered.
        delivery: turn and metre of its axis.

    Attributes:
        scale: counts per position unit; negative where 607Eh reverses positions.
        magnitude: counts per position unit without sign, for windows.
        speed: counts/s per unit of velocity, without sign.
        speed_scale: counts/s per unit of velocity, with the polarity of velocities.
        acceleration: counts/s² per unit of acceleration.
        turn: counts of one motor turn, 608Fh; also the distance of the index pulses.
        knows_turn, knows_speed: whether speeds in turns, and those in the unit of 60A9h, can be converted.
        origin: counts at position 0; homing sets it.
    """

    __slots__ = (
        *("_delivery", "_dictionary", "acceleration", "knows_speed", "knows_turn", "magnitude", "origin", "scale"),
        *("speed", "speed_scale", "turn"),
    )

    def __init__(self, dictionary: Dictionary, delivery: Delivery) -> None:
        self._dictionary = dictionary
        self._delivery = delivery
        self.origin = 0.0
        self.read()

    def read(self) -> None:
        """Read the present factors."""
        dictionary, delivery = self._dictionary, self._delivery
        resolution, delivered = dictionary.number(_RESOLUTION_INDEX, 1), _encoder_counts(dictionary.delivered)
        self.turn = delivery.turn or DEFAULT_COUNTS_PER_TURN
        if resolution:
            self.turn = _quotient(dictionary.number, _RESOLUTION_INDEX) / delivered
        self.knows_turn = bool(resolution) or delivery.turn is not None
        self.magnitude = magnitude = _encoder_counts(dictionary.number) / delivered
        shaft = self.turn * (_quotient(dictionary.number, _GEAR_INDEX) if dictionary.number(_FEED_INDEX, 1) else 1.0)
        turn = shaft / magnitude if self.knows_turn else None
        metre = None if delivery.metre is None else delivery.metre / magnitude
        speed = rate_unit(dictionary.number(VELOCITY_UNIT_INDEX), turn=turn, metre=metre)
        acceleration = rate_unit(dictionary.number(ACCELERATION_UNIT_INDEX), turn=turn, metre=metre)
        self.knows_speed = speed is not None
        self.speed = magnitude * (speed or 1.0)
        self.acceleration = magnitude * (acceleration or 1.0)
        turned = dictionary.number(0x607E) ^ dictionary.delivered(0x607E)
        self.scale = -magnitude if turned >> _POSITION_POLARITY_BIT & 1 else magnitude
        self.speed_scale = -self.speed if turned >> _VELOCITY_POLARITY_BIT & 1 else self.speed

    def position(self, counts: float) -> float:
        """Convert motor counts to position units."""
        return (counts - self.origin) / self.scale

    def counts(self, position: float) -> float:
        """Convert position units to motor counts."""
        return position * self.scale + self.origin


def _encoder_counts(number: _Number) -> float:
    """Lines of the encoder in one position unit; without 6092h the unit is a line."""
    if not number(_FEED_INDEX, 1):
        return 1.0
    return _quotient(number, _RESOLUTION_INDEX) * _quotient(number, _GEAR_INDEX) / _quotient(number, _FEED_INDEX)


def _quotient(number: _Number, index: int) -> float:
    return (number(index, 1) or 1) / (number(index, 2) or 1)
