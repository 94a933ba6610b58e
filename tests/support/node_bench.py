"""A tiny node from its own EDS text, motors of numbers, and frames spelled in hex."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.objectdictionary.eds import import_eds
from sdo_words import SdoWords

from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.drive.profile import MotorDynamics
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode

U8, U16, U32, U64, I16, I32, STRING, DOMAIN, REAL32 = 0x5, 0x6, 0x7, 0x1B, 0x3, 0x4, 0x9, 0xF, 0x8
NODE_ID = 5
OFF = 0x80000000

Row = tuple[int, int | None, int, str, str, int, str, str]
# index, sub (None: plain variable), data type, access, default, mappable, low, high
_ROWS: list[Row] = [
    (0x1000, None, U32, "ro", "0x12345678", 0, "", ""),
    (0x1001, None, U8, "ro", "0", 1, "", ""),
    *[(0x1003, sub, U32 if sub else U8, "ro" if sub else "rw", "0", 0, "", "") for sub in range(4)],
    (0x1005, None, U32, "rw", "0x80", 0, "", ""),
    (0x1006, None, U32, "rw", "0", 0, "", ""),
    (0x1007, None, U32, "rw", "0", 0, "", ""),
    (0x100C, None, U16, "rw", "0", 0, "", ""),
    (0x100D, None, U8, "rw", "0", 0, "", ""),
    (0x1008, None, STRING, "const", "a name longer than seven", 0, "", ""),
    *[(0x1010, sub, U32 if sub else U8, "rw" if sub else "ro", "1" if sub else "3", 0, "", "") for sub in range(4)],
    *[(0x1011, sub, U32 if sub else U8, "rw" if sub else "ro", "1" if sub else "3", 0, "", "") for sub in range(4)],
    (0x1014, None, U32, "rw", "$NODEID+0x80", 0, "", ""),
    (0x1015, None, U16, "rw", "0", 0, "", ""),
    *[(0x1016, sub, U32 if sub else U8, "rw" if sub else "ro", "0" if sub else "2", 0, "", "") for sub in range(3)],
    (0x1017, None, U16, "rw", "0", 0, "", ""),
    (0x1019, None, U8, "rw", "0", 0, "", ""),
    *[(0x1029, sub, U8, "rw" if sub else "ro", "0" if sub else "1", 0, "", "") for sub in range(2)],
    *[(0x1201, sub, U32 if sub else U8, "rw" if sub else "ro", f"{OFF if sub else 2}", 0, "", "") for sub in range(3)],
    (0x2000, None, U8, "rw", "50", 0, "10", "100"),
    (0x2001, None, U32, "rw", "0x01020304", 1, "", ""),
    (0x2002, None, I16, "rw", "-2", 1, "-100", "100"),
    (0x2003, None, U8, "wo", "0", 0, "", ""),
    (0x2004, None, DOMAIN, "rw", "", 0, "", ""),
    (0x2005, None, U64, "ro", "0x1122334455667788", 1, "", ""),
    (0x2006, None, REAL32, "rw", "1.5", 0, "", ""),
    (0x2007, None, U8, "rw", "7", 1, "", ""),
    (0x2008, None, U32, "rwr", "8", 1, "", ""),
    (0x2009, None, I32, "rww", "9", 1, "", ""),
    (0x2010, 0, U8, "ro", "2", 0, "", ""),
    (0x2010, 1, U32, "rw", "1", 1, "", ""),
    (0x2010, 2, U32, "rw", "2", 1, "", ""),
]


def _pdo_rows() -> list[Row]:
    rows: list[Row] = []
    cob_ids = {0x1400: "$NODEID+0x200", 0x1401: "$NODEID+0x80000300", 0x1800: "$NODEID+0x180", 0x1801: "0x80000285"}
    mapped = {0x1600: ["0x20010020", "0x20020010"], 0x1A00: ["0x20010020", "0x20020010"], 0x1A01: ["0x20050040"]}
    for index, cob_id in cob_ids.items():
        subs = {0: "6", 1: cob_id, 2: "1", 3: "0", 5: "0", 6: "0"}
        types = {0: U8, 1: U32, 2: U8, 3: U16, 5: U16, 6: U8}
        if index < 0x1800:
            del subs[6]
        rows += [(index, sub, types[sub], "rw" if sub else "ro", text, 0, "", "") for sub, text in subs.items()]
        words = mapped.get(index + 0x200, [])
        rows.append((index + 0x200, 0, U8, "rw", str(len(words)), 0, "", ""))
        for sub in range(1, 5):
            word = words[sub - 1] if sub <= len(words) else "0"
            rows.append((index + 0x200, sub, U32, "rw", word, 0, "", ""))
    return rows


def _section(row: Row) -> str:
    index, sub, data_type, access, default, pdo, low, high = row
    name = f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"
    lines = [f"[{name}]", f"ParameterName=object {name}", "ObjectType=0x7", f"DataType=0x{data_type:04X}"]
    lines += [f"AccessType={access}", f"PDOMapping={pdo}"]
    lines += [
        f"{key}={text}" for key, text in (("DefaultValue", default), ("LowLimit", low), ("HighLimit", high)) if text
    ]
    return "\n".join(lines) + "\n"


def _eds_text() -> str:
    parts = ["[DeviceInfo]\nVendorName=test\n", "[DummyUsage]\nDummy0004=1\nDummy0005=1\n"]
    parts[1] += "".join(f"Dummy000{i}=0\n" for i in (1, 2, 3, 6, 7))
    seen: set[int] = set()
    for row in sorted(_ROWS + _pdo_rows(), key=lambda row: (row[0], row[1] or 0)):
        if row[1] is not None and row[0] not in seen:
            parts.append(f"[{row[0]:04X}]\nParameterName=record {row[0]:04X}\nObjectType=0x9\nSubNumber=2\n")
        seen.add(row[0])
        parts.append(_section(row))
    return "\n".join(parts)


def make_tiny_od() -> ObjectDictionary:
    return import_eds(io.StringIO(_eds_text()), NODE_ID)


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
        for word in (0x06, 0x07, 0x0F):
            self.word(word)
        assert self.drive.read(0x6041) & 0x6F == 0x27
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
