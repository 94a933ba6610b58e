"""Units of velocities and accelerations as a drive states them in 60A9h and 60AAh.

A unit is `10^prefix · numerator / denominator`: bits 31–24, 23–16 and 15–8. 00B44700h is revolutions a minute. Without
the object, or with 0, a velocity is in position units a second and an acceleration in position units a second squared.

Source: CiA 402-2, objects 60A9h, 60AAh; CiA 303-2, notation of units and prefixes.
"""

from __future__ import annotations

import math

VELOCITY_UNIT_INDEX, ACCELERATION_UNIT_INDEX = 0x60A9, 0x60AA
_INCREMENT, _TURN, _TURN_A_MINUTE, _DEGREE, _RADIAN, _METRE = 0xB5, 0xB4, 0xC0, 0x41, 0x10, 0x01
_SECONDS_OF_UNIT = {0x03: 1.0, 0x47: 60.0, 0x57: 1.0}
"""Seconds in a second, a minute, a second squared, by the code of the denominator."""


def rate_unit(word: int, *, turn: float | None, metre: float | None) -> float | None:
    """Factor of a unit of velocity, position units/s, or of acceleration, position units/s².

    Args:
        word: value of 60A9h or 60AAh; 0 where the device has none.
        turn: number of position units in a turn of the drive's shaft; None: unknown.
        metre: number of position units in a metre; None: unknown.

    Returns:
        The factor; None where what is known does not give it.
    """
    if word == 0:
        return 1.0
    prefix, numerator, denominator = word >> 24, word >> 16 & 0xFF, word >> 8 & 0xFF
    lengths = {_INCREMENT: 1.0}
    if turn is not None:
        lengths |= {_TURN: turn, _TURN_A_MINUTE: turn / 60.0, _DEGREE: turn / 360.0, _RADIAN: turn / (2.0 * math.pi)}
    if metre is not None:
        lengths[_METRE] = metre
    length, seconds = lengths.get(numerator), _SECONDS_OF_UNIT.get(denominator)
    if length is None or seconds is None:
        return None
    return 10.0 ** (prefix - 256 if prefix > 127 else prefix) * length / seconds
