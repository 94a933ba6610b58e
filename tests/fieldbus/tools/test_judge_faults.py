"""Faults thrown at served drives while a master works: a stubborn one is found, a careful one is not."""

from __future__ import annotations

import math
import struct

import pytest

from canprobe.fieldbus import Description, LockstepBus, VirtualClock, load_eds, make_eds_node
from canprobe.fieldbus.tools.faults import FaultyNode, FaultyNodes
from canprobe.fieldbus.tools.judge import BusFrame, Judge
from canprobe.fieldbus.tools.judge.bench import first_answers
from canprobe.fieldbus.tools.judge.injections import STANDARD_FAULTS, Injections

NODES = (1, 2)
MS, S = 1_000_000, 1_000_000_000
START = 20_000


class SineMaster:
    """Moves two drives to and fro on a lockstep bus; written with raw frames. A careful one stops at a bad sign."""

    def __init__(self, faults, *, careful):
        self.clock = VirtualClock()
        bus = LockstepBus(self.clock)
        self.frames, self.careful, self.stopped = [], careful, False
        bus.recorder = lambda can_id, data, t_ns: self.frames.append(BusFrame(t_ns, can_id, data))
        faulty = [FaultyNode(make_eds_node(load_eds("puma260_joint", n), n, position=START)) for n in NODES]
        self.port = bus.port()
        for node in faulty:
            bus.attach(node)
        self.injections = Injections(FaultyNodes(faulty), faults, 0)
        self.beats, self.beat_ns = dict.fromkeys(NODES, 0), 0

    def write(self, node, index, subindex, value, size):
        self.port.send_batch([(0x600 + node, struct.pack("<BHBi", 0x23 | 4 - size << 2, index, subindex, value))])
        self.port.drain()

    def run(self, seconds):
        for node in NODES:
            objects = ((0x1017, 0, 100, 2), (0x1016, 1, 0x7F00FA, 4), (0x60C2, 1, 10, 1), (0x60C2, 2, -3, 1))
            for one in (*objects, (0x1006, 0, 10_000, 4), (0x6060, 0, 8, 1)):
                self.write(node, *one)
            for index in (0x6061, 0x6064):
                self.port.send_batch([(0x600 + node, struct.pack("<BHBi", 0x40, index, 0, 0))])
        self.port.send_batch([(0, b"\x01\x00")])
        for cycle in range(round(seconds * 100)):
            word = (0, 6, 7, 15)[min(cycle // 5, 3)]
            way = round(1000 * math.sin(cycle / 30)) if cycle > 40 else 0
            self.cycle(cycle, word, way)
            if self.stopped:
                break
        return self

    def cycle(self, cycle, word, way):
        self.clock.sleep_until_ns((cycle + 30) * 10 * MS)
        now = self.clock.now_ns()
        self.injections.look(now)
        if now - self.beat_ns >= 100 * MS:
            self.beat_ns = now
            self.port.send_batch([(0x77F, b"\x05")])
        self.port.send_batch([(0x80, b"")])
        self.clock.sleep_until_ns(now + MS)
        self.hear(now)
        word = 2 if self.stopped else word
        self.port.send_batch([(0x200 + node, struct.pack("<Hi", word, START + way)) for node in NODES])

    def hear(self, now):
        for can_id, data, t_ns in self.port.drain():
            node, service = can_id & 0x7F, can_id & 0x780
            if service == 0x700:
                self.beats[node] = t_ns
            bad = (can_id == 0x700 + node and data == b"\0") or (service == 0x80 and any(data[:2]))
            bad = bad or (service == 0x180 and data[0] & 0x4F in (8, 15))
            self.stopped = self.stopped or (self.careful and bad and now > S)
        if self.careful and now > S and now - min(self.beats.values()) > 250 * MS:
            self.stopped = True

    def judged(self):
        nodes = {node: Description(load_eds("puma260_joint", node)) for node in NODES}
        thrown = self.injections.thrown()
        spans = [(one.begin_ns, one.end_ns) for one in thrown]
        judge = Judge(nodes, served=True, charges_ns=spans).hear(self.frames)
        return {number for number, case in judge.cases.items() if case.count}, first_answers(self.frames, thrown, nodes)


def test_a_stubborn_master_is_found_in_each_fault_of_the_sequence():
    master = SineMaster(None, careful=False).run(35)
    assert [one.text.split(": ")[1].split()[0] for one in master.injections.thrown()] == [
        text.split()[0] for text in STANDARD_FAULTS
    ]
    found, answers = master.judged()
    assert found >= {15, 19, 21, 46}, "targets after a fault, heartbeat, boot-up, mute axis"
    assert answers == [None] * len(STANDARD_FAULTS)


def test_a_careful_master_answers_in_time_and_nothing_is_found():
    for name, within_ms in (("heartbeat-off", 370), ("mute", 370), ("drive-fault", 30), ("reboot", 300), ("emcy", 30)):
        master = SineMaster([f"node 2: {name} at 3 s for 1 s"], careful=True).run(6)
        found, (answer,) = master.judged()
        assert found == set(), name
        assert master.stopped and answer is not None
        assert answer.t_ns - 3 * S <= within_ms * MS, name


@pytest.mark.parametrize(
    ("fault", "rules"),
    [
        ("mute", {20}),
        ("deaf", {20}),
        ("mute at 2 s for 2 s", {19, 46}),
        ("heartbeat-off at 2 s for 2 s", {19}),
        ("reboot at 2 s", {21}),
        ("nmt command=2 at 2 s for 1 s", {42}),
        ("drive-fault at 2 s", {15}),
        ("emcy at 2 s for 1 s", {15}),
        ("sdo-abort index=0x60C2", {26}),
        ("mode-refused", {26}),
    ],
)
def test_which_rules_a_fault_provokes(fault, rules):
    """The table of docs/judge.md."""
    found, _ = SineMaster([f"node 2: {fault}"], careful=False).run(5).judged()
    assert found == rules
