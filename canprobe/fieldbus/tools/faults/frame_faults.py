"""Faults of the link: frames that are lost, late, twice, changed or made up, and nodes that lose their power."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from random import Random

from canprobe.errors import ProtocolError
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import (
    CLASSIC_BYTES,
    EFF_FLAG,
    EMCY_BASE,
    HEARTBEAT_BASE,
    INVALID_FLAG,
    RTR_FLAG,
    SYNC_ID,
    Frame,
)
from canprobe.fieldbus.protocol.tactile import TactileHeader, crc16_ccitt
from canprobe.fieldbus.tools.faults.fault import Effect

BUS_OFF_RECOVERED_CODE = 0x8140
HEADER_INDEX, POSITION_INDEX = 0x2120, 0x6064
_GARBAGE_ID = 0x050
_TPDO1 = 0x180
_PDO_IDS = range(0x181, 0x580)
_TO_ALL_ID = 0x100


def is_pdo(can_id: int) -> bool:
    """Whether an identifier is one that PDOs may have, and nothing else has by default."""
    return can_id in _PDO_IDS and can_id != _TO_ALL_ID


class Drop(Effect):
    """Frames are lost."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        """Lose it."""
        return ()


class Delay(Effect):
    """Frames come later."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        """Let it wait."""
        delay_ns = max(1, round(self.fault.value("ms") * 1e6))
        self.host.later(frame, t_ns + delay_ns, incoming=self.fault.hears)
        return ()


class Duplicate(Effect):
    """Frames come twice, or more often."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        """Repeat it."""
        return [frame] * int(self.fault.value("n"))


class Corrupt(Effect):
    """A bit of each frame is another, or its end is missing, as the CRC of the wire lets it pass once in a lifetime."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        """Change it."""
        return ((frame[0], _flip_bit(frame[1], self.rng)),)


class Reorder(Effect):
    """A frame comes behind the next ones."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        """Keep it back."""
        self.host.swap(frame)
        return ()


class Short(Effect):
    """PDOs have a byte too few."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Cut it."""
        return ((frame[0], frame[1][:-1]),) if is_pdo(frame[0]) and frame[1] else None


class Long(Effect):
    """PDOs have a byte too many, where a classical frame has room for it."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Lengthen it."""
        return ((frame[0], frame[1] + b"\0"),) if is_pdo(frame[0]) and len(frame[1]) < CLASSIC_BYTES else None


class WrongId(Effect):
    """PDOs come under another identifier."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Rename it."""
        return ((frame[0] + int(self.fault.value("offset")), frame[1]),) if is_pdo(frame[0]) else None


class Freeze(Effect):
    """The node stands still: it neither hears nor sends, and goes on where it was."""

    dark = True


class Reboot(Freeze):
    """The power fails for the duration; the node boots when it is back."""

    def begin(self, t_ns: int) -> Sequence[Frame]:
        """Lose the power."""
        self.host.hits += 1
        self.node.start(t_ns)
        return ()

    def end(self, t_ns: int) -> Sequence[Frame]:
        """Boot."""
        self.host.hits += 1
        return self.node.start(t_ns)


class BusOff(Freeze):
    """The controller is off the bus; the node itself goes on, and reports its return."""

    dark = False

    def batch(self, frames: list[Frame], t_ns: int) -> list[Frame]:
        """Lose what the node sends."""
        self.host.hits += len(frames)
        return []

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        """Lose what it would hear."""
        return ()

    def end(self, t_ns: int) -> Sequence[Frame]:
        """Come back with EMCY 8140h."""
        self.node.core.now_ns = t_ns
        self.node.emcy.report(BUS_OFF_RECOVERED_CODE)
        self.node.emcy.clear(BUS_OFF_RECOVERED_CODE)
        return self.node.advance(t_ns)


class Babble(Effect):
    """The node sends frames that nobody asked for; each seed has its own sort."""

    def begin(self, t_ns: int) -> Sequence[Frame]:
        """Begin to talk."""
        self.due_ns = t_ns
        return ()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Say it again, as often as its time has come."""
        out = []
        while self.due_ns is not None and self.due_ns <= t_ns:
            self.due_ns += max(1, round(self.fault.value("gap_ms") * 1e6))
            self.host.hits += 1
            out.append(self.made())
        return out

    def made(self) -> Frame:
        """The next frame."""
        data = self.rng.randbytes(8)
        node_id = self.node.node_id
        sorts: tuple[Frame, ...] = (
            (_GARBAGE_ID, data),
            (_TPDO1 + node_id, data),
            (HEARTBEAT_BASE + node_id, b"\x05"),
            (EMCY_BASE + node_id, Emcy(0x8140, 0x11, data[:5]).pack()),
        )
        return sorts[self.fault.seed % len(sorts)]


class OddFrames(Babble):
    """Remote requests and frames of 29 bits under the identifiers of the node's TPDO and RPDO."""

    def made(self) -> Frame:
        """A remote request for a PDO that allows none, or a 29-bit frame with the bits of an RPDO."""
        if self.rng.random() < 0.5:
            return RTR_FLAG | _TPDO1 + 0x40 + self.node.node_id, b""
        return EFF_FLAG | _TPDO1 + 0x80 + self.node.node_id, self.rng.randbytes(8)


class SyncJitter(Effect):
    """SYNC reaches the node later, each time by another time."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Let it wait."""
        if frame[0] != SYNC_ID:
            return None
        self.host.later(frame, t_ns + max(1, round(1e3 * self.rng.uniform(0.0, self.fault.value("us")))), incoming=True)
        return ()


class SyncLost(Effect):
    """SYNC does not reach the node."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Lose it."""
        return () if frame[0] == SYNC_ID else None


class SyncDouble(Effect):
    """SYNC reaches the node twice."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Repeat it."""
        return (frame, frame) if frame[0] == SYNC_ID else None


class WrongData(Effect):
    """A drive reports another position, an array another SYNC counter (even seeds) or age, with the right CRC."""

    def batch(self, frames: list[Frame], t_ns: int) -> list[Frame]:
        """Change what the node sends at one time."""
        if self.rng.random() >= self.fault.share:
            return frames
        ids = tactile_ids(self.node)
        return self._wrong_header(frames, ids) if ids else [self._wrong_position(frame) for frame in frames]

    def _wrong_position(self, frame: Frame) -> Frame:
        can_id, data = frame
        start = _position_in(self.node, can_id)
        if start is None or len(data) < start + 4:
            return frame
        self.host.hits += 1
        position = int.from_bytes(data[start : start + 4], "little", signed=True)
        position += self.rng.choice((-1, 1)) * 2 ** self.rng.randrange(20)
        return can_id, data[:start] + position.to_bytes(4, "little", signed=True) + data[start + 4 :]

    def _wrong_header(self, frames: list[Frame], ids: tuple[int, ...]) -> list[Frame]:
        parts = dict(frames)
        if not all(can_id in parts for can_id in ids):
            return frames
        try:
            header = TactileHeader.unpack(parts[ids[0]])
        except ProtocolError:
            return frames
        self.host.hits += 1
        if self.fault.seed % 2 == 0:
            header = replace(header, sync_counter=self.rng.randrange(1, 241))
        else:
            header = replace(header, sample_age_us=self.rng.randrange(0x10000))
        body = b"".join(parts[can_id] for can_id in ids[1:])
        first = replace(header, crc=0).pack()
        packed = replace(header, crc=crc16_ccitt(body, crc16_ccitt(first[:6]))).pack()
        return [(can_id, packed if can_id == ids[0] else data) for can_id, data in frames]


def tpdos(node: SlaveNode) -> dict[int, list[int]]:
    """Mapped entries, each index << 16 | subindex << 8 | bits, of the valid TPDOs of a node by identifier."""
    dictionary = node.dictionary
    found: dict[int, list[int]] = {}
    for index in dictionary.indices_in(range(0x1800, 0x1A00)):
        cob_id = dictionary.number(index, 1, INVALID_FLAG)
        if not cob_id & INVALID_FLAG:
            count = dictionary.number(index + 0x200)
            found[cob_id & 0x7FF] = [dictionary.number(index + 0x200, sub) for sub in range(1, count + 1)]
    return found


def tactile_ids(node: SlaveNode) -> tuple[int, ...]:
    """Identifiers of the PDOs of a tactile frame, header first; empty for a node that is no tactile array."""
    mapped = tpdos(node) if node.dictionary.has_index(HEADER_INDEX) else {}
    headers = [can_id for can_id, entries in mapped.items() if entries and entries[0] >> 16 == HEADER_INDEX]
    return (*headers, *(can_id for can_id in mapped if can_id not in headers)) if headers else ()


def _position_in(node: SlaveNode, can_id: int) -> int | None:
    """First byte of 6064h in a TPDO; None where it does not carry it."""
    bits = 0
    for entry in tpdos(node).get(can_id, ()):
        if entry >> 16 == POSITION_INDEX:
            return bits // 8
        bits += entry & 0xFF
    return None


def _flip_bit(data: bytes, rng: Random) -> bytes:
    if not data:
        return data
    if rng.random() < 0.2:
        return data[: rng.randrange(len(data))]
    place, bit = rng.randrange(len(data)), 1 << rng.randrange(8)
    return data[:place] + bytes((data[place] ^ bit,)) + data[place + 1 :]
