"""A node whose faults happen: it stands between the node and a lockstep bus, and is attached in the node's place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from random import Random

from canprobe.errors import ProtocolError
from canprobe.fieldbus.node.fault import Fault, FaultKind, flip_bit
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.node.wrapped import WrappedNode
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, Frame
from canprobe.fieldbus.protocol.tactile import TactileHeader, crc16_ccitt

_GARBAGE_ID = 0x050
_TPDO1 = 0x180
_DARK_KINDS = (FaultKind.REBOOT, FaultKind.FREEZE)


class FaultyNode(WrappedNode):
    """One node and its faults; without faults it behaves as the node itself.

    Args:
        node: the node.
        faults: faults; those of other nodes are left out.
        tactile_ids: COB-IDs of a tactile frame, header first, for wrong data with the right CRC.

    Attributes:
        hits: number of frames that were changed, lost, moved or made up, and of reboots.
    """

    def __init__(self, node: SlaveNode, faults: Iterable[Fault] = (), tactile_ids: Sequence[int] = ()) -> None:
        super().__init__(node)
        self.hits = 0
        self._faults: list[tuple[Fault, Random]] = []
        self._tactile_ids = tuple(tactile_ids)
        self._later: list[tuple[int, int, bool, Frame]] = []
        self._count = 0
        self._swapped: list[Frame] = []
        self._babble_ns: dict[Fault, int] = {}
        self._boots: list[int] = []
        self._thaws: list[int] = []
        for fault in faults:
            if fault.node_id == node.node_id:
                self.add(fault)

    def add(self, fault: Fault) -> None:
        """Add a fault; it happens from its start on, or from now on."""
        self._faults.append((fault, Random(fault.seed)))
        if fault.kind is FaultKind.BABBLE:
            self._babble_ns[fault] = fault.start_ns
        if fault.kind is FaultKind.REBOOT:
            self._boots = sorted((*self._boots, fault.start_ns, fault.end_ns))
        if fault.kind in _DARK_KINDS:
            self._thaws = sorted((*self._thaws, fault.end_ns))

    @property
    def next_deadline_ns(self) -> int | None:
        """The next deadline of the node, while its time goes on, and of the faults."""
        due = [self._later[0][0]] if self._later else []
        due += [t for f, t in self._babble_ns.items() if t < f.end_ns]
        due += self._boots[:1] + self._thaws[:1]
        own = self.node.next_deadline_ns
        if own is not None:
            due.append(max((own, *(f.end_ns for f, _ in self._faults if f.kind in _DARK_KINDS and f.holds(own)))))
        return min(due, default=None)

    def start(self, t_ns: int) -> Sequence[Frame]:
        """Power on."""
        return self._sent(self.node.start(t_ns), t_ns)

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        """Take a frame from the bus, which may not reach the node."""
        if self._is_dark(t_ns):
            self.hits += 1
            return ()
        out: list[Frame] = []
        for frame in self._through([(can_id, data)], t_ns, incoming=True):
            out += self.node.receive(*frame, t_ns)
        return self._sent(out, t_ns)

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Do what is due in the node and in its faults."""
        ready = self._reboot(t_ns)
        while self._thaws and self._thaws[0] <= t_ns:
            self._thaws.pop(0)
        answers: list[Frame] = []
        while self._later and self._later[0][0] <= t_ns:
            _, _, incoming, frame = heappop(self._later)
            if not incoming:
                ready.append(frame)
            elif not self._is_dark(t_ns):
                answers += self.node.receive(*frame, t_ns)
        own = self.node.next_deadline_ns
        if own is not None and own <= t_ns and not self._is_dark(t_ns):
            answers += self.node.advance(t_ns)
        return [*ready, *self._sent(answers, t_ns), *self._babble(t_ns)]

    def _is_dark(self, t_ns: int) -> bool:
        return any(f.kind in _DARK_KINDS and f.holds(t_ns) for f, _ in self._faults)

    def _reboot(self, t_ns: int) -> list[Frame]:
        """Let the power fail: the node starts anew, and is silent until the power is back."""
        out: list[Frame] = []
        while self._boots and self._boots[0] <= t_ns:
            self._boots.pop(0)
            self.hits += 1
            out = list(self.node.start(t_ns))
        return [] if self._is_dark(t_ns) else out

    def _babble(self, t_ns: int) -> list[Frame]:
        out = []
        for fault, rng in self._faults:
            while fault.kind is FaultKind.BABBLE and self._babble_ns[fault] <= t_ns < fault.end_ns:
                self._babble_ns[fault] += max(1, fault.amount_ns)
                self.hits += 1
                out.append(_nonsense(self.node.node_id, fault.seed, rng))
        return out

    def _sent(self, frames: Sequence[Frame], t_ns: int) -> Sequence[Frame]:
        """Those of the node's frames that reach the bus now."""
        if not frames and not self._swapped:
            return frames
        if self._is_dark(t_ns):
            self.hits += len(frames)
            return ()
        return self._through(self._with_wrong_data(list(frames), t_ns), t_ns, incoming=False)

    def _through(self, frames: list[Frame], t_ns: int, *, incoming: bool) -> list[Frame]:
        for fault, rng in self._faults:
            if fault.incoming is incoming and fault.holds(t_ns):
                frames = [out for frame in frames for out in self._hit(fault, rng, frame, t_ns)]
        if self._swapped and frames and not incoming:
            frames = [*frames, *self._swapped]
            self._swapped = []
        return frames

    def _hit(self, fault: Fault, rng: Random, frame: Frame, t_ns: int) -> list[Frame]:
        if rng.random() >= fault.share:
            return [frame]
        match fault.kind:
            case FaultKind.DROP | FaultKind.MUTE | FaultKind.DEAF:
                out: list[Frame] = []
            case FaultKind.CORRUPT:
                out = [(frame[0], flip_bit(frame[1], rng))]
            case FaultKind.DUPLICATE:
                out = [frame, frame]
            case FaultKind.DELAY:
                self._count += 1
                heappush(self._later, (t_ns + max(1, fault.amount_ns), self._count, fault.incoming, frame))
                out = []
            case FaultKind.REORDER if not fault.incoming:
                self._swapped.append(frame)
                out = []
            case _:
                return [frame]
        self.hits += 1
        return out

    def _with_wrong_data(self, frames: list[Frame], t_ns: int) -> list[Frame]:
        for fault, rng in self._faults:
            if fault.kind is FaultKind.WRONG_DATA and fault.holds(t_ns) and rng.random() < fault.share:
                if self._tactile_ids:
                    frames = self._wrong_header(frames, fault.seed, rng)
                else:
                    frames = [self._wrong_position(frame, rng) for frame in frames]
        return frames

    def _wrong_position(self, frame: Frame, rng: Random) -> Frame:
        """The TPDO of the drive with another position in bytes 2 to 5."""
        can_id, data = frame
        if can_id != _TPDO1 + self.node.node_id or len(data) != 8:
            return frame
        self.hits += 1
        position = int.from_bytes(data[2:6], "little", signed=True) + rng.choice((-1, 1)) * 2 ** rng.randrange(20)
        return can_id, data[:2] + position.to_bytes(4, "little", signed=True) + data[6:]

    def _wrong_header(self, frames: list[Frame], seed: int, rng: Random) -> list[Frame]:
        """A tactile frame with another SYNC counter (even seeds) or another age, and the right CRC."""
        parts = dict(frames)
        if not all(can_id in parts for can_id in self._tactile_ids):
            return frames
        try:
            header = TactileHeader.unpack(parts[self._tactile_ids[0]])
        except ProtocolError:
            return frames
        self.hits += 1
        if seed % 2 == 0:
            header = replace(header, sync_counter=rng.randrange(1, 241))
        else:
            header = replace(header, sample_age_us=rng.randrange(0x10000))
        body = b"".join(parts[can_id] for can_id in self._tactile_ids[1:])
        first = replace(header, crc=0).pack()
        packed = replace(header, crc=crc16_ccitt(body, crc16_ccitt(first[:6]))).pack()
        return [(can_id, packed if can_id == self._tactile_ids[0] else data) for can_id, data in frames]


def _nonsense(node_id: int, seed: int, rng: Random) -> Frame:
    """A frame of a babbling node; each fault has its own sort of frames."""
    data = rng.randbytes(8)
    sorts: tuple[Frame, ...] = (
        (_GARBAGE_ID, data),
        (_TPDO1 + node_id, data),
        (HEARTBEAT_BASE + node_id, b"\x05"),
        (EMCY_BASE + node_id, Emcy(0x8140, 0x11, data[:5]).pack()),
    )
    return sorts[seed % len(sorts)]
