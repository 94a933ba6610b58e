"""What a bit rate costs in lockstep: the timed bus against the untimed one, in turn in one run. Use --benchmark-only.

Goal: at most twice the cost of a lockstep cycle with the seven emulated nodes of the cell. The bare bus, whose nodes
only send what they are told, is measured too.
"""

from __future__ import annotations

import gc
from statistics import median
from time import process_time

import numpy as np
import pytest
from timed_buses import Scripted

from canprobe.bus.lockstep import LockstepBus
from canprobe.bus.port import VirtualClock
from canprobe.bus.timed import TimedBus
from canprobe.eds.packaged import load_eds
from canprobe.emulator.array import make_tactile_node
from canprobe.emulator.drive.drive import make_drive_node

CYCLE_NS = 2_500_000
ROUNDS, TURNS = 11, 300


class Still:
    """A plant without physics, whose drives and taxels move all the same, so that no frame is like the last one."""

    image = np.full((16, 16), 7, np.uint8)

    def __init__(self):
        self._counts = 0

    def advance(self, t_ns):
        self._counts += 37

    def motor_counts(self, axis):
        return self._counts * (axis + 1)

    def torque_permille(self, axis):
        return self._counts % 50

    def set_ramp(self, axis, start_counts, end_counts, t0_ns, t1_ns):
        pass

    def sample_image(self, t_ns):
        return (self.image + self._counts % 97).astype(np.uint8)


class Cell:
    """Six drives and a sensor on a bus, and a master that does what the cycle does."""

    def __init__(self, bus):
        self.bus, self.count = bus, 0
        plant = Still()
        nodes = [make_drive_node(load_eds("puma260_joint", i), i, i - 1, plant) for i in range(1, 7)]
        for node in (*nodes, make_tactile_node(load_eds("tactile_array", 16), 16, plant)):
            bus.attach(node)
        self.port = bus.port()
        for node_id in (1, 2, 3, 4, 5, 6, 16):
            for text in ("2f191000f0000000", "23061000c4090000", "2f60600008000000"):
                self.port.send_batch([(0x600 + node_id, bytes.fromhex(text))])
                bus.clock.sleep_until_ns(bus.clock.now_ns() + CYCLE_NS)
        self.port.send_batch([(0, b"\x01\x00")])
        bus.clock.sleep_until_ns(bus.clock.now_ns() + CYCLE_NS)
        self.port.drain()
        self.start_ns = bus.clock.now_ns()
        for word in (6, 7, 15, 15):
            self.cycle(word)

    def cycle(self, word=0x0F):
        port, clock = self.port, self.bus.clock
        begin = self.start_ns + self.count * CYCLE_NS
        port.send_batch([(0x80, bytes((self.count % 240 + 1,)))])
        self.count += 1
        clock.sleep_until_ns(begin + 1_145_000)
        got = len(port.drain())
        data = word.to_bytes(2, "little") + (self.count * 41).to_bytes(4, "little")
        port.send_batch([(0x200 + i, data) for i in range(1, 7)])
        clock.sleep_until_ns(begin + CYCLE_NS)
        return got + len(port.drain())


class Bare:
    """The same frames from nodes that only hold them ready."""

    def __init__(self, bus):
        self.bus, self.count = bus, 0
        self.nodes = [Scripted(answers={0x80: [(0x180 + i, bytes(range(i, i + 8)))]}) for i in range(1, 7)]
        self.nodes.append(Scripted(answers={0x80: [(0x511 + i, bytes(range(i, i + 8))) for i in range(9)]}))
        for node in self.nodes:
            bus.attach(node)
        self.port = bus.port()

    def cycle(self):
        port, clock = self.port, self.bus.clock
        port.send_batch([(0x80, b"\1")])
        clock.sleep_until_ns(self.count * CYCLE_NS + 1_145_000)
        got = len(port.drain())
        port.send_batch([(0x200 + i, b"\x0f\x00\x10\x27\x00\x00") for i in range(1, 7)])
        self.count += 1
        clock.sleep_until_ns(self.count * CYCLE_NS)
        got += len(port.drain())
        for node in self.nodes:
            node.heard.clear()
        return got


def in_turn(timed, untimed):
    """Median µs of CPU time a cycle of each, taken in turn so that the machine's moods hit both."""
    times = {True: [], False: []}
    gc.disable()
    try:
        for _ in range(ROUNDS):
            for which, cell in ((True, timed), (False, untimed)):
                start = process_time()
                for _ in range(TURNS):
                    cell.cycle()
                times[which].append((process_time() - start) / TURNS * 1e6)
    finally:
        gc.enable()
    return median(times[True]), median(times[False])


@pytest.mark.parametrize("what, most", [(Cell, 2.0), (Bare, None)])
def test_bench_timed_against_untimed(benchmark, what, most):
    timed, untimed = what(TimedBus(VirtualClock())), what(LockstepBus(VirtualClock()))
    frames = [[cell.cycle() for _ in range(4)] for cell in (timed, untimed)]
    assert sum(frames[0]) == sum(frames[1]) >= 24, "both carry the same"
    timed_us, untimed_us = benchmark.pedantic(in_turn, (timed, untimed), rounds=1)
    benchmark.extra_info |= {"timed_us": timed_us, "untimed_us": untimed_us, "ratio": timed_us / untimed_us}
    print(f"\n{what.__name__}: {timed_us:.0f} µs a cycle, untimed {untimed_us:.0f}: {timed_us / untimed_us:.2f}")
    assert most is None or timed_us <= most * untimed_us
