"""60A9h and 60AAh against values by hand."""

import math

import pytest

from canprobe.fieldbus.protocol.si_unit import rate_unit


@pytest.mark.parametrize(
    ("word", "units"),
    [
        (0x00000000, 1.0),
        (0x00B50300, 1.0),  # increments a second
        (0x00B44700, 4096 / 60),  # turns a minute
        (0xFDB44700, 4096 / 60_000),  # thousandths of them
        (0x00B40300, 4096.0),  # turns a second
        (0x00410300, 4096 / 360),  # degrees a second
        (0x00100300, 4096 / (2 * math.pi)),  # radians a second
        (0xFD010300, 2.0),  # mm a second
        (0x00C00300, 4096 / 60),  # turns a minute, a second
        (0x00B45700, 4096.0),  # turns a second squared
    ],
)
def test_a_unit_in_position_units(word, units):
    assert rate_unit(word, turn=4096.0, metre=2000.0) == pytest.approx(units, rel=1e-12)


@pytest.mark.parametrize("word", [0x00B44700, 0x00010300, 0x00FF0300, 0x00B5FF00])
def test_a_unit_that_cannot_be_expressed(word):
    assert rate_unit(word, turn=None, metre=None) is None
