"""Object 2008h of the tactile node: which windows it takes, when, and what it then sends."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.eds import load_eds
from canprobe.emulator.node import SlaveNode
from canprobe.emulator.tactile import TactileApplication
from canprobe.protocol.tactile import WINDOWS, FrameAssembler, TactileMode, window_words

CYCLE = 2_500_000
SIZE = 0x2008
OFF = 0x80000000


@pytest.fixture
def sensor(bench, plant):
    node = SlaveNode(load_eds("tactile_array", 16), 16, TactileApplication(plant, 0))
    node.start(0)
    found = type(bench)(node)
    for order in ((0x1019, 0, 240, 1), (0x2001, 0, 0, 1)):
        assert found.write(*order) == 0
    return found


def map_window(sensor, words):
    """Header and window PDOs on every SYNC."""
    for number in range(33):
        assert sensor.write(0x1800 + number, 1, OFF | 0x511 + number, 4) == 0
    for number, word in enumerate([0x21200040, *(0x21100040 | sub << 8 for sub in range(1, words + 1))]):
        index = 0x1800 + number
        orders = [(index + 0x200, 0, 0, 1), (index + 0x200, 1, word, 4), (index + 0x200, 0, 1, 1), (index, 2, 1, 1)]
        for order in (*orders, (index, 1, 0x511 + number, 4)):
            assert sensor.write(*order) == 0, order


@pytest.mark.parametrize("value, abort", [(3, 0x06090032), (13, 0x06090031), (5, 0x06090030), (11, 0x06090030)])
def test_sizes_that_it_does_not_have(sensor, value, abort):
    assert sensor.write(SIZE, 0, value, 1) == abort
    assert sensor.node.dictionary.number(SIZE) == 8


@pytest.mark.parametrize("value", WINDOWS)
def test_sizes_that_it_has_until_it_is_operational(sensor, value):
    assert sensor.write(SIZE, 0, value, 1) == 0
    sensor.nmt(0x01)
    assert sensor.write(SIZE, 0, value, 1) == 0, "the same value changes nothing"
    assert sensor.write(SIZE, 0, 4 if value != 4 else 6, 1) == 0x08000022
    sensor.nmt(0x80)
    assert sensor.write(SIZE, 0, 4 if value != 4 else 6, 1) == 0


@pytest.mark.parametrize("side", WINDOWS)
@pytest.mark.parametrize("spot", [(0, 15), (8, 3), (15, 0)])
def test_the_window_holds_the_contact_wherever_it_is(sensor, plant, side, spot):
    plant.image = np.zeros((16, 16), np.uint8)
    plant.image[spot] = 99
    assert sensor.write(SIZE, 0, side, 1) == 0
    map_window(sensor, window_words(side))
    sensor.nmt(0x01)
    assembler = FrameAssembler(range(0x511, 0x512 + window_words(side)), TactileMode.WINDOW, CYCLE, window=side)
    frames = sensor.send(0x80, "01", CYCLE)
    found = [assembler.push(can_id, bytes.fromhex(data), CYCLE) for can_id, data in frames]
    assert found[-1] is not None and found[-1].header.window == side
    assert np.array_equal(found[-1].taxels, plant.image)
    row, column, rows, columns = found[-1].window
    assert (rows, columns) == (side, side)
    ideal = [min(max(at - (side - 1) / 2, 0), 16 - side) for at in spot]
    assert abs(row - ideal[0]) <= 0.75 and abs(column - ideal[1]) <= 0.75
