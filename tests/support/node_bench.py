"""A tiny node from its own EDS text, motors of numbers, and frames spelled in hex."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.objectdictionary.eds import import_eds
from makes import Entry, Make, Place, communication, eds_text, pdo, word
from sdo_words import SdoWords

from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.drive.profile import MotorDynamics
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode

NODE_ID = 5
OFF = 0x80000000


def tiny() -> dict[Place, Entry]:
    """Objects of the tiny node: one of each data type, access and limit, and two PDOs each way, the second ones off."""
    objects = communication("0x12345678", "a name longer than seven", errors=3, consumers=2) | {
        (0x1007, 0): Entry("Synchronous window", "U32", "rw"),
        (0x100C, 0): Entry("Guard time", "U16", "rw"),
        (0x100D, 0): Entry("Life time factor", "U8", "rw"),
        **{(index, sub): Entry("Group", "U32", "rw", 1) for index in (0x1010, 0x1011) for sub in (1, 2, 3)},
        **{(index, 0): Entry("Highest sub-index", "U8", "ro", 3) for index in (0x1010, 0x1011)},
        (0x1029, 0): Entry("Highest sub-index", "U8", "ro", 1),
        (0x1029, 1): Entry("Communication error", "U8", "rw"),
        (0x1201, 0): Entry("Highest sub-index", "U8", "ro", 2),
        **{(0x1201, sub): Entry("COB-ID", "U32", "rw", OFF) for sub in (1, 2)},
        (0x2000, 0): Entry("Limited", "U8", "rw", 50, low=10, high=100),
        (0x2001, 0): Entry("Number", "U32", "rw", "0x01020304", mappable=True),
        (0x2002, 0): Entry("Signed and limited", "I16", "rw", -2, low=-100, high=100, mappable=True),
        (0x2003, 0): Entry("Command", "U8", "wo"),
        (0x2004, 0): Entry("Domain", "DOMAIN", "rw", ""),
        (0x2005, 0): Entry("Long", "U64", "ro", "0x1122334455667788", mappable=True),
        (0x2006, 0): Entry("Real", "R32", "rw", "1.5"),
        (0x2007, 0): Entry("Byte", "U8", "rw", 7, mappable=True),
        (0x2008, 0): Entry("Sent", "U32", "rwr", 8, mappable=True),
        (0x2009, 0): Entry("Received", "I32", "rww", 9, mappable=True),
        (0x2010, 0): Entry("Highest sub-index", "U8", "ro", 2),
        **{(0x2010, sub): Entry("Part", "U32", "rw", sub, mappable=True) for sub in (1, 2)},
    }
    mapped = (word(0x2001, 0, 32), word(0x2002, 0, 16))
    objects |= pdo("rpdo", 1, mapped, places=4) | pdo("rpdo", 2, places=4, cob_id="$NODEID+0x80000300")
    objects |= pdo("tpdo", 1, mapped, places=4)
    objects |= pdo("tpdo", 2, (word(0x2005, 0, 64),), places=4, cob_id="0x80000285")
    return objects | {(index, 6): Entry("SYNC start value", "U8", "rw") for index in (0x1800, 0x1801)}


def make_tiny_od() -> ObjectDictionary:
    return import_eds(io.StringIO(eds_text(Make("tiny", 0, objects=tiny(), dummies=(4, 5)))), NODE_ID)


@dataclass
class Bench(SdoWords):
    """One node, and the words to talk to it."""

    node: SlaveNode
    t_ns: int = 0

    def send(self, can_id: int, text: str, t_ns: int | None = None) -> list[tuple[int, str]]:
        """Send hex, get [(can_id, hex)]."""
        self.t_ns = self.t_ns if t_ns is None else t_ns
        return spell(self.node.receive(can_id, bytes.fromhex(text), self.t_ns))

    def advance(self, t_ns: int) -> list[tuple[int, str]]:
        self.t_ns = t_ns
        return spell(self.node.advance(t_ns))

    def ask(self, text: str) -> str:
        """One SDO request, the one answer to it."""
        answers = [
            data for can_id, data in self.send(0x600 + self.node.node_id, text) if can_id == 0x580 + self.node.node_id
        ]
        assert len(answers) == 1, answers
        return answers[0]

    def nmt(self, command: int, t_ns: int | None = None) -> list[tuple[int, str]]:
        return self.send(0, bytes((command, self.node.node_id)).hex(), t_ns)


def spell(frames: list[tuple[int, bytes]]) -> list[tuple[int, str]]:
    return [(can_id, data.hex()) for can_id, data in frames]


@dataclass
class FakePlant:
    """Motors that are where their reference is."""

    counts: list[float] = field(default_factory=lambda: [0.0] * 6)
    ramps: list[tuple[int, float, float, int, int]] = field(default_factory=list)
    loops: list[tuple[int, int, float, float]] = field(default_factory=list)
    t_ns: int = 0
    stuck: bool = False
    torque: int = 0
    switches: tuple[float, float] = (-math.inf, math.inf)
    dynamics: MotorDynamics = field(default_factory=lambda: MotorDynamics(gain=100.0, coulomb=50.0, damping=4.0))

    def begin(self, t_ns: int) -> None:
        pass

    def advance(self, t_ns: int) -> None:
        self.t_ns = max(t_ns, self.t_ns)
        for axis, start, end, t0, t1 in self.ramps:
            if not self.stuck and t0 <= self.t_ns:
                share = min(1.0, (self.t_ns - t0) / (t1 - t0))
                self.counts[axis] = start + (end - start) * share
        self.ramps = [ramp for ramp in self.ramps if ramp[4] > self.t_ns] or self.ramps[-1:]

    def motor_counts(self, axis: int) -> float:
        return self.counts[axis]

    def torque_permille(self, axis: int) -> int:
        return self.torque

    def limit_switches(self, axis: int) -> tuple[float, float]:
        return self.switches

    def motor_dynamics(self, axis: int) -> MotorDynamics:
        return self.dynamics

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        self.loops.append((axis, limit_permille, speed, torque_permille))

    def set_ramp(self, axis: int, start: float, end: float, t0_ns: int, t1_ns: int) -> None:
        assert t1_ns > t0_ns
        self.ramps = [ramp for ramp in self.ramps if ramp[0] != axis] + [(axis, start, end, t0_ns, t1_ns)]


@pytest.fixture(scope="session")
def tiny_od() -> ObjectDictionary:
    """The tiny node's dictionary, parsed once; nodes keep their values elsewhere."""
    return make_tiny_od()


@pytest.fixture
def bench(tiny_od: ObjectDictionary) -> Bench:
    """The tiny node, booted, pre-operational at time 0."""
    made = Bench(SlaveNode(tiny_od, NODE_ID))
    assert spell(made.node.start(0)) == [(0x705, "00")]
    return made


@pytest.fixture
def make_bench(tiny_od: ObjectDictionary) -> Callable[..., Bench]:
    """Make tiny nodes with options of SlaveNode; not started."""
    return lambda **options: Bench(SlaveNode(tiny_od, NODE_ID, **options))


@pytest.fixture
def plant() -> FakePlant:
    """A plant of numbers."""
    return FakePlant()


@pytest.fixture
def drive(plant: FakePlant) -> Bench:
    """Drive node 1 on axis 0, pre-operational, mode CSP, SYNC with counter every 2.5 ms."""
    made = Bench(make_drive_node(load_eds("puma260_joint", 1), 1, 0, plant))
    made.node.start(0)
    for index, value, size in ((0x6060, 8, 1), (0x1019, 240, 1), (0x1006, 2500, 4)):
        assert made.write(index, 0, value, size) == 0
    return made


@dataclass
class Rig:
    """A drive at work: words over SDO, time in small steps, the plant's true motion."""

    drive: Bench
    plant: FakePlant
    trace: list[tuple[int, float]] = field(default_factory=list)

    def put(self, **objects: int) -> Rig:
        """Write plain objects, as `_6081=5000`, or sub-indices, as `_607D_1=-5`."""
        for name, value in objects.items():
            index, _, sub = name[1:].partition("_")
            entry = self.drive.node.dictionary.find(int(index, 16), int(sub or "0"))
            assert self.drive.write(int(index, 16), int(sub or "0"), value, entry.bits // 8) == 0, name
        return self

    def word(self, word: int) -> Rig:
        """A controlword, and all that it does at once."""
        self.put(_6040=word)
        self.drive.advance(self.drive.t_ns)
        return self

    def enable(self, mode: int) -> Rig:
        self.put(_6060=mode)
        for controlword in (0x06, 0x07, 0x0F):
            self.word(controlword)
        assert self.drive.read(0x6041) & 0x6F == 0x27
        return self

    def at_work(self, mode: int, *words: int) -> Rig:
        """Operational, RPDO1 = controlword, the mode's target and what else is mapped."""
        mapped = [(f"_1600_{sub}", mapping) for sub, mapping in enumerate(words, start=2)]
        for name, value in (("_1400_1", 0x80000201), ("_1600_0", 0), *mapped, ("_1600_0", 1 + len(words))):
            self.put(**{name: value})
        self.put(_1400_1=0x201).enable(mode).drive.nmt(0x01)
        return self

    def run(self, ms: float, step_us: int = 500) -> Rig:
        """Let time pass; `trace` gets (t_ns, counts)."""
        end_ns, self.trace = self.drive.t_ns + round(ms * 1e6), [(self.drive.t_ns, self.plant.counts[0])]
        while self.drive.t_ns < end_ns:
            self.drive.advance(self.drive.t_ns + step_us * 1000)
            self.trace.append((self.drive.t_ns, self.plant.counts[0]))
        return self

    def cycles(self, count: int, rpdo: str | None = None) -> list[tuple[int, str]]:
        """SYNC every 2.5 ms, then an RPDO1 in hex; the frames of the last cycle."""
        sent: list[tuple[int, str]] = []
        for _ in range(count):
            k = self.drive.t_ns // 2_500_000 + 1
            sent = self.drive.advance(k * 2_500_000) + self.drive.send(0x80, f"{(k - 1) % 240 + 1:02x}")
            self.trace.append((self.drive.t_ns, self.plant.counts[0]))
            if rpdo is not None:
                self.drive.send(0x201, rpdo, k * 2_500_000 + 300_000)
        return sent

    def signed(self, index: int, sub: int = 0) -> int:
        value, bits = self.drive.read(index, sub), self.drive.node.dictionary.find(index, sub).bits
        return value - (1 << bits) if value >> bits - 1 else value

    def bits(self, *numbers: int) -> tuple[int, ...]:
        """Bits of the statusword."""
        word = self.drive.read(0x6041)
        return tuple(word >> number & 1 for number in numbers)

    @property
    def counts(self) -> float:
        return self.plant.counts[0]


@pytest.fixture
def rig(drive: Bench, plant: FakePlant) -> Rig:
    """The drive of `drive`, with room for the following error."""
    return Rig(drive, plant)
