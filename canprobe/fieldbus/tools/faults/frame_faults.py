"""Faults of the link: frames that are lost, late, twice, changed or made up, and nodes that lose their power."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from random import Random

from canprobe.errors import ProtocolError
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.tactile import TactileHeader, crc16_ccitt
from canprobe.fieldbus.tools.faults.fault import Effect

BUS_OFF_RECOVERED_CODE = 0x8140
HEADER_INDEX, POSITION_INDEX = 0x2120, 0x6064
_GARBAGE_ID = 0x050
_TPDO1 = 0x180
_PDO_IDS = range(0x181, 0x580)
"""Identifiers that PDOs may have, and nothing else has by default."""


def service_of(can_id: int, data: bytes, node_id: int) -> str:
    """The service that a frame from or to a node belongs to, in the words of `kinds.toml`; empty for any other."""
    whole = len(data) == frames.CLASSIC_BYTES
    services = {
        frames.SYNC_ID: "SYNC",
        frames.HEARTBEAT_BASE + node_id: "boot-up" if data == b"\0" else "heartbeat",
        frames.SDO_RX_BASE + node_id: "SDO request" if whole else "",
        frames.SDO_TX_BASE + node_id: "SDO answer" if whole else "",
    }
    return services.get(can_id, "PDO" if can_id in _PDO_IDS else "")


class FrameFault(Effect):
    """Base class of the faults that change the frames of a service one by one. Here they are lost."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        hit = self.frames in ("", service_of(*frame, self.node.node_id))
        return self.changed(frame, t_ns) if hit else None

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """What goes on in the place of a frame; None: the frame itself, which the fault does not hit."""
        return ()


class Drop(FrameFault):
    """Frames are lost."""

    name = "drop"


class Delay(FrameFault):
    """Frames come later."""

    name = "delay"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        self.host.later(frame, t_ns + max(1, round(self.delay_ms() * 1e6)), incoming=self.fault.hears)
        return ()

    def delay_ms(self) -> float:
        """Delay of the next frame, ms."""
        return self.fault.value("ms")


class Duplicate(FrameFault):
    """Frames come twice, or more often."""

    name = "duplicate"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        return [frame] * int(self.fault.value("n"))


class Corrupt(FrameFault):
    """A bit of each frame is another, or its end is missing, as the CRC of the wire lets it pass once in a lifetime."""

    name = "corrupt"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        return ((frame[0], _flip_bit(frame[1], self.rng)),)


class Reorder(FrameFault):
    """A frame comes behind the next ones."""

    name = "reorder"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        self.host.swapped[self.fault.hears].append(frame)
        return ()


class Reboot(Effect):
    """The power fails for the duration; the node boots when it is back."""

    name = "reboot"
    dark = True

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.node.start(t_ns)
        return ()

    def end(self, t_ns: int) -> Sequence[Frame]:
        self.host.hits += 1
        return self.node.start(t_ns)


class Freeze(Effect):
    """The node stands still: it neither hears nor sends, and goes on where it was."""

    name = "freeze"
    dark = True


class Babble(Effect):
    """The node sends frames that nobody asked for; each seed has its own sort."""

    name = "babble"

    def begin(self, t_ns: int) -> None:
        self.due_ns = t_ns

    def advance(self, t_ns: int) -> Sequence[Frame]:
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
            (frames.HEARTBEAT_BASE + node_id, b"\x05"),
            (frames.EMCY_BASE + node_id, Emcy(BUS_OFF_RECOVERED_CODE, 0x11, data[:5]).pack()),
        )
        return sorts[self.fault.seed % len(sorts)]


class WrongData(Effect):
    """A drive reports another position, an array another SYNC counter (even seeds) or age, with the right CRC."""

    name = "wrong-data"

    def batch(self, sent: list[Frame], t_ns: int) -> list[Frame]:
        if self.rng.random() >= self.fault.share:
            return sent
        ids = tactile_ids(self.node)
        return self._wrong_header(sent, ids) if ids else [self._wrong_position(frame) for frame in sent]

    def _wrong_position(self, frame: Frame) -> Frame:
        can_id, data = frame
        layout = self.node.pdos.layouts.get(can_id)
        places = [] if layout is None else [signal.index for signal in layout.signals]
        if layout is None or POSITION_INDEX not in places or len(data) != layout.length:
            return frame
        self.host.hits += 1
        values = list(layout.unpack(data))
        values[places.index(POSITION_INDEX)] += self.rng.choice((-1, 1)) * 2 ** self.rng.randrange(20)
        return can_id, layout.pack(*values)

    def _wrong_header(self, sent: list[Frame], ids: tuple[int, ...]) -> list[Frame]:
        parts = dict(sent)
        if not all(can_id in parts for can_id in ids):
            return sent
        try:
            header = TactileHeader.unpack(parts[ids[0]])
        except ProtocolError:
            return sent
        self.host.hits += 1
        if self.fault.seed % 2 == 0:
            header = replace(header, sync_counter=self.rng.randrange(1, 241))
        else:
            header = replace(header, sample_age_us=self.rng.randrange(0x10000))
        body = b"".join(parts[can_id] for can_id in ids[1:])
        packed = replace(header, crc=crc16_ccitt(body, crc16_ccitt(header.start()))).pack()
        return [(can_id, packed if can_id == ids[0] else data) for can_id, data in sent]


class Short(FrameFault):
    """PDOs have a byte too few."""

    name = "short"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        return ((frame[0], frame[1][:-1]),) if frame[1] else None


class Long(FrameFault):
    """PDOs have a byte too many, where a classical frame has room for it."""

    name = "long"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        return ((frame[0], frame[1] + b"\0"),) if len(frame[1]) < frames.CLASSIC_BYTES else None


class WrongId(FrameFault):
    """PDOs come under another identifier."""

    name = "wrong-id"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        return ((frame[0] + int(self.fault.value("offset")), frame[1]),)


class OddFrames(Babble):
    """Remote requests for PDOs that allow none, and 29-bit frames with the bits of an RPDO."""

    name = "odd-frames"

    def made(self) -> Frame:
        if self.rng.random() < 0.5:
            return frames.RTR_FLAG | _TPDO1 + 0x40 + self.node.node_id, b""
        return frames.EFF_FLAG | _TPDO1 + 0x80 + self.node.node_id, self.rng.randbytes(8)


class SyncJitter(Delay):
    """SYNC reaches the node later, each time by another time."""

    name = "sync-jitter"

    def delay_ms(self) -> float:
        return 1e-3 * self.rng.uniform(0.0, self.fault.value("us"))


class SyncDouble(FrameFault):
    """SYNC reaches the node twice."""

    name = "sync-double"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        return (frame, frame)


class BusOff(Effect):
    """The controller is off the bus; the node itself goes on, and reports its return by EMCY 8140h."""

    name = "bus-off"

    def batch(self, sent: list[Frame], t_ns: int) -> list[Frame]:
        self.host.hits += len(sent)
        return []

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        return ()

    def end(self, t_ns: int) -> Sequence[Frame]:
        self.node.core.now_ns = t_ns
        self.node.emcy.report(BUS_OFF_RECOVERED_CODE)
        self.node.emcy.clear(BUS_OFF_RECOVERED_CODE)
        return self.node.advance(t_ns)


def tactile_ids(node: SlaveNode) -> tuple[int, ...]:
    """Identifiers of the PDOs of a tactile frame, header first; empty for a node that is no tactile array."""
    mapped = node.pdos.layouts if node.dictionary.has_index(HEADER_INDEX) else {}
    headers = [can_id for can_id, layout in mapped.items() if layout.entries[0].index == HEADER_INDEX]
    return (*headers, *(can_id for can_id in mapped if can_id not in headers)) if headers else ()


def _flip_bit(data: bytes, rng: Random) -> bytes:
    if not data:
        return data
    if rng.random() < 0.2:
        return data[: rng.randrange(len(data))]
    place, bit = rng.randrange(len(data)), 1 << rng.randrange(8)
    return data[:place] + bytes((data[place] ^ bit,)) + data[place + 1 :]
