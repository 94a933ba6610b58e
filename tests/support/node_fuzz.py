"""Random and mutated frames for one node, and what must hold after each of them."""

from __future__ import annotations

import random

from canprobe.fieldbus.node.sdo_server import SdoServer
from canprobe.fieldbus.node.sdo_states import SDO_TRANSITIONS, SdoState, request_of
from canprobe.fieldbus.node.sdo_transfers import MAX_VALUE_BYTES
from canprobe.fieldbus.protocol.frames import NmtState

INIT, PRE, OP, STOPPED = NmtState.INITIALISING, NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED
GOALS = {0x01: OP, 0x02: STOPPED, 0x80: PRE, 0x81: PRE, 0x82: PRE}  # a reset ends in pre-operational
IDENTITY = bytes.fromhex("4000100000000000")  # reads 1000h, which every node has
GUARD = 0x40000705
COMMANDS = (0x40, 0x2F, 0x2B, 0x23, 0x22, 0x21, 0x60, 0x70, 0x00, 0x11, 0x80, 0xA0, 0xA4, 0xC6, 0xC2, 0xA3, 0xA2, 0xC1)
SIGNATURES = (b"save", b"load", b"tare")
LIFE_GUARD = 0x8130


class Watched:
    """A node under fire, with what must hold after every frame."""

    def __init__(self, node):
        self.node, self.t_ns = node, 0
        self.state = PRE
        self.server = next(service for service in node._services if isinstance(service, SdoServer))
        assert node.start(0) == [(0x705, b"\0")]

    def feed(self, can_id, data, wait_ns=0):
        """Time passes, then a frame comes."""
        self.t_ns += wait_ns
        self._check_frames(self.node.advance(self.t_ns))
        self._check_loss()
        before = self.server.state
        served = self.state in (PRE, OP)
        answers = self.node.receive(can_id, data, self.t_ns)
        self._check_frames(answers)
        if can_id == 0 and len(data) == 2 and data[1] in (0, 5):
            self.state = GOALS.get(data[0], self.state)
            assert self.node.state is self.state
        elif can_id == 0x605 and len(data) == 8 and served:
            self._check_sdo(before, data[0], answers)
        self._check_loss()

    def _check_sdo(self, before, command, answers):
        """The state that follows is one of the table's, or idle after an abort; a request is answered at once."""
        request, after = request_of(before, command), self.server.state
        mine = [data for can_id, data in answers if can_id == 0x585]
        if not (mine and mine[-1][0] == 0x80):
            assert after in SDO_TRANSITIONS[before, request]
        else:
            assert after is SdoState.IDLE
        silent = request.name in ("ABORT", "BLOCK_SEGMENT", "END_BLOCK_UPLOAD")
        assert mine or silent, request

    def _check_frames(self, frames):
        for can_id, data in frames:
            assert 0 < can_id <= 0x7FF and len(data) <= 8
        due = self.node.next_deadline_ns
        assert due is None or due >= self.t_ns

    def _check_loss(self):
        """Without a command the state changes only by 1029h, when the connection is lost."""
        if self.node.state is not self.state:
            assert LIFE_GUARD in self.node.emcy.active
            goal = {0: PRE, 2: STOPPED}[self.node.dictionary.number(0x1029, 1)]
            assert self.node.state is goal
            assert goal is STOPPED or self.state is OP
            self.state = goal

    def size(self):
        """Everything that frames could make grow, in entries and bytes."""
        node = self.node
        kept = [*node.dictionary.values.values(), *node.store.saved.values()]
        texts = sum(len(value) for value in kept if isinstance(value, bytes))
        return len(kept), len(node.core.timers.armed), len(node.emcy._waiting), len(node.emcy._history), texts

    def check_end(self):
        """It still serves: reset, boot-up, an SDO answered at once."""
        entries, heap, waiting, history, texts = self.size()
        assert entries <= 2 * len(self.node.dictionary.entries)
        assert heap < 400 and waiting <= 16 and history <= 254
        strings = sum(not entry.bits for entry in self.node.dictionary.entries.values())
        assert texts <= 2 * strings * MAX_VALUE_BYTES
        self.feed(0, b"\x81\x05")
        answers = self.node.receive(0x605, IDENTITY, self.t_ns)
        assert [data[0] for can_id, data in answers if can_id == 0x585] == [0x43]


class Storm:
    """Random frames that look like CANopen, and mutations of those that came before."""

    def __init__(self, node, seed):
        self.rng = random.Random(seed)
        self.indices = sorted({key >> 8 for key in node.dictionary.entries})
        self.ids = [0x000, 0x080, *[0x605] * 7, 0x205, 0x305, 0x77F, GUARD, 0x40000185, 0x40000285, 0x340]
        self.past = [(0x605, IDENTITY)]

    def frame(self):
        rng = self.rng
        kind = rng.random()
        if kind < 0.25:
            return self.mutated()
        can_id = rng.choice(self.ids) if kind < 0.97 else rng.randrange(0x800)
        data = bytearray(rng.randbytes(rng.choice((0, 1, 2, 5, 6, 7, 8, 8, 8, 8))))
        if can_id == 0x605 and len(data) == 8 and rng.random() < 0.8:
            self.request(data)
        elif can_id == 0 and len(data) == 2:
            data[:] = bytes((rng.choice((1, 1, 1, 1, 2, 0x80, 0x81, 0x82, 7)), rng.choice((0, 5, 5, 6))))
        frame = can_id, bytes(data) if can_id < 0x800 else b""
        self.past[rng.randrange(64) :] = [frame]
        return frame

    def request(self, data):
        rng = self.rng
        data[0] = rng.choice(COMMANDS)
        data[1:3] = rng.choice(self.indices).to_bytes(2, "little")
        data[3] = rng.randrange(4)
        value = rng.random()
        if value < 0.3:
            data[4:] = rng.choice((0, 1, 2, 5, 7, 14, 100, 5000)).to_bytes(4, "little")
        elif value < 0.35:
            data[4:] = rng.choice(SIGNATURES)

    def mutated(self):
        rng = self.rng
        can_id, data = rng.choice(self.past)
        changed = bytearray(data)
        for _ in range(rng.randrange(3)):
            if changed:
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        if rng.random() < 0.1:
            changed = changed[: rng.randrange(9)]
        return can_id, bytes(changed)

    def wait_ns(self):
        return self.rng.choice((0, 1, 10**5, 10**6, 10**7, 10**8, 10**11 if self.rng.random() < 0.01 else 3))


def rage(watched, count, seed):
    storm = Storm(watched.node, seed)
    try:
        for _ in range(count):
            can_id, data = storm.frame()
            watched.feed(can_id, data, storm.wait_ns())
    except BaseException:
        print(f"seed {seed}, last frame {can_id:03X}#{data.hex()}")
        raise
    watched.check_end()
