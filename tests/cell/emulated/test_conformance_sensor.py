"""Points 61–65: the tactile node, by raw frames. Source: `tactile_array.eds`, `protocol.tactile`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conformance_bench import Bench, connect  # noqa: F401

from canprobe.cell.emulated.array import TactileApplication
from canprobe.cell.master.tactile_frame import decode
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.tactile import FrameAssembler, TactileMode

OFF = 0x80000000
SAVE, TARE = 0x65766173, 0x65726174
CONTENT = {
    TactileMode.WINDOW: [0x21100040 | sub << 8 for sub in range(1, 9)],
    TactileMode.IMAGE: [0x21000040 | sub << 8 for sub in range(1, 33)],
}


@pytest.fixture
def sensor(connect: Any, plant: Any) -> Bench:
    """The tactile node 16, booted; a tare takes two images."""
    return connect(SlaveNode(load_eds("tactile_array", 16), 16, TactileApplication(plant, tare_images=2))).boot()


class Reader:
    """Configures the node's PDOs, sends SYNC, puts frames together."""

    def __init__(self, sensor, mode):
        self.sensor, self.counter = sensor, 0
        words = [0x21200040, *CONTENT[mode]]
        sensor.set((0x1019, 0, 240, 1), (0x2000, 0, int(mode), 1), (0x2001, 0, 0, 1))
        for number in range(33):
            sensor.set((0x1800 + number, 1, OFF | 0x511 + number, 4))
        for number, word in enumerate(words):
            sensor.configure(0x1800 + number, cob_id=0x511 + number, words=[word], type=2)
        self.count = len(words)
        self.assembler = FrameAssembler(list(range(0x511, 0x511 + self.count)), mode, 10**12)
        sensor.nmt(0x01)
        sensor.read(0x1000)

    def sync(self):
        self.counter = self.counter % 240 + 1
        self.sensor.silence(2)
        self.sensor.send(0x80, f"{self.counter:02x}")

    def raw(self):
        """The frames of the next trigger, every second SYNC."""
        self.sync()
        self.sensor.read(0x1000)  # nothing came before this answer
        self.sync()
        return [self.sensor.next() for _ in range(self.count)]

    def push(self, raw):
        messages = [self.assembler.push(can_id, bytes.fromhex(text), t_ns) for can_id, text, t_ns in raw]
        return [message and decode(message, (16, 16)) for message in messages]

    def frame(self):
        done = self.push(self.raw())
        assert done[:-1] == [None] * (self.count - 1)
        assert done[-1] is not None
        return done[-1]


def spot(row, column, value=100):
    image = np.zeros((16, 16), np.uint8)
    image[row, column] = value
    return image


@pytest.mark.parametrize("mode", list(CONTENT))
def test_sensor_61_whole_frame_a_trigger_sampled_at_one_instant(sensor, plant, mode):
    plant.image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    reader = Reader(sensor, mode)
    before = len(plant.sampled)
    raw = reader.raw()
    assert [frame.can_id for frame in raw] == list(range(0x511, 0x511 + reader.count))
    assert len(plant.sampled) - before == 1
    reader.frame()
    taxels = reader.frame().taxels
    shown = taxels if mode is TactileMode.IMAGE else taxels[taxels > 0]
    assert np.isin(shown, plant.image).all() and shown.size in (64, 256)
    if mode is TactileMode.IMAGE:
        assert np.array_equal(taxels, plant.image)


def test_sensor_62_counter_and_a_torn_frame(sensor, plant):
    reader = Reader(sensor, TactileMode.WINDOW)
    frames = [reader.frame() for _ in range(3)]
    assert [frame.header.frame_counter for frame in frames] == [0, 1, 2]
    assert [frame.header.sync_counter for frame in frames] == [2, 4, 6]
    raw = reader.raw()
    assert reader.push(raw[:-1]) == [None] * 8  # the last one is lost
    assert (reader.frame().header.frame_counter, reader.assembler.torn) == (4, 1)


@pytest.mark.parametrize("stored", [True, False])
def test_sensor_64_tare_and_gain_over_sdo_and_stored(sensor, plant, stored):
    assert sensor.write(0x2003, 0, 1, 4) == 0x08000020
    plant.image = spot(3, 3, 30)
    reader = Reader(sensor, TactileMode.IMAGE)
    sensor.set((0x2002, 0, 2000, 2), (0x2003, 0, TARE, 4))
    for _ in range(3):
        reader.frame()
    plant.image = spot(3, 3, 50)
    reader.frame()
    assert reader.frame().taxels[3, 3] == 40  # (50 - 30) * 2
    if stored:
        sensor.set((0x1010, 1, SAVE, 4))
    sensor.nmt(0x81)
    sensor.expect((0x710, "00"))
    assert sensor.read(0x2002) == (2000 if stored else 1000)
    again = Reader(sensor, TactileMode.IMAGE)
    again.frame()
    assert again.frame().taxels[3, 3] == (40 if stored else 50)


@pytest.mark.parametrize(("value", "flag"), [(254, 0), (255, 1)])
def test_sensor_65_overload(sensor, plant, value, flag):
    plant.image = spot(8, 8, value)
    reader = Reader(sensor, TactileMode.IMAGE)
    reader.frame()
    assert reader.frame().header.overload == bool(flag)
    assert sensor.read(0x2005) == flag
