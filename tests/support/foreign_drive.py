"""CiA 402 drives written by hand on a raw CAN socket: they share no code with canprobe, neither emulator nor protocol.

    python foreign_drive.py vcan0 EDS MODE NODE_ID=POSITION ...

One process serves several drives, each with the values of its EDS (read by canopen-python) and a motor that is at its
target one SYNC after the target. It knows expedited and segmented SDO, NMT, heartbeat, synchronous PDOs and one mode of
operation, 8 or 7. On SIGTERM it prints a line of JSON for each drive: what it was commanded and where it went.
"""

from __future__ import annotations

import json
import select
import signal
import socket
import struct
import sys
import time
from typing import Any

import canopen

FRAME = struct.Struct("=IB3x8s")
SIZES = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4, 0x15: 8, 0x1B: 8}
SIGNED = {0x02, 0x03, 0x04, 0x15}
BOOTING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
OFF, READY, ON, ENABLED, QUICK_STOP = 0x40, 0x21, 0x23, 0x27, 0x07
NO_OBJECT, NO_SUBINDEX, READ_ONLY, VALUE, COMMAND = 0x06020000, 0x06090011, 0x06010002, 0x06090030, 0x05040001


class Refused(Exception):  # noqa: N818 - what SDO does
    def __init__(self, code: int) -> None:
        super().__init__(f"{code:08x}")
        self.code = code


class Drive:
    """One drive: its objects, its state by hand, and a motor that is where it was told to be."""

    def __init__(self, bus: Bus, eds: str, node_id: int, mode: int, position: int) -> None:
        self.bus, self.node_id, self.mode, self.position = bus, node_id, mode, position
        self.types: dict[tuple[int, int], Any] = {}
        for item in canopen.import_od(eds, node_id).indices.values():
            members = [item] if isinstance(item, canopen.objectdictionary.ODVariable) else item.subindices.values()
            self.types.update({(member.index, member.subindex): member for member in members})
        self.lowest = self.highest = position
        self.words: list[int] = []
        self.reset()

    def reset(self) -> None:
        self.values: dict[tuple[int, int], Any] = {
            place: variable.default or 0 for place, variable in self.types.items()
        }
        self.state, self.count = OFF, 0
        self.target: int | None = None
        self.waiting: list[tuple[int, bytes]] = []
        self.segments = b""
        self.toggle = 0
        self.nmt = PRE_OPERATIONAL
        self.next_heartbeat = 0.0
        self.show()
        self.bus.send(0x700 + self.node_id, bytes((BOOTING,)))

    # -------------------------------------------------------------- objects

    def get(self, index: int, sub: int = 0) -> int:
        return int(self.values.get((index, sub), 0))

    def pack(self, place: tuple[int, int]) -> bytes:
        variable, value = self.types[place], self.values[place]
        if variable.data_type not in SIZES:
            return value if isinstance(value, bytes) else str(value or "").encode()
        size = SIZES[variable.data_type]
        return (int(value) & (1 << 8 * size) - 1).to_bytes(size, "little")

    def store(self, place: tuple[int, int], data: bytes) -> None:
        signed = self.types[place].data_type in SIGNED
        value = int.from_bytes(data[: SIZES[self.types[place].data_type]], "little", signed=signed)
        if place == (0x6060, 0) and value not in (0, self.mode):
            raise Refused(VALUE)
        self.values[place] = value
        if place == (0x6060, 0):
            self.values[0x6061, 0] = value
        if place == (0x6040, 0):
            self.obey(value)
        if place == self.target_place:
            self.target = value
        if place == (0x1017, 0):
            self.next_heartbeat = time.monotonic()

    @property
    def target_place(self) -> tuple[int, int]:
        return (0x607A, 0) if self.mode == 8 else (0x60C1, 1)

    # -------------------------------------------------------------- the drive

    def obey(self, word: int) -> None:
        if not self.words or self.words[-1] != word:
            self.words.append(word)
        low = word & 0x0F
        if not low & 0x02:
            self.state = OFF
        elif not low & 0x04:
            self.state = {ENABLED: QUICK_STOP}.get(self.state, OFF)
        elif low & 0x07 == 0x06:
            self.state = READY if self.state in (OFF, READY, ON, ENABLED) else self.state
        elif low == 0x07:
            self.state = ON if self.state in (READY, ON, ENABLED) else self.state
        elif self.state in (READY, ON):
            self.state, self.target = ENABLED, None
        self.show()

    @property
    def follows(self) -> bool:
        wanted = self.mode == 8 or bool(self.get(0x6040) & 0x10)
        return self.state == ENABLED and wanted and not self.get(0x6040) & 0x100

    def show(self) -> None:
        word = self.state | 0x10 | (0x200 if self.nmt == OPERATIONAL else 0) | (0x1000 if self.follows else 0)
        self.values[0x6041, 0] = word
        self.values[0x6064, 0] = self.position

    def on_sync(self) -> None:
        if self.nmt != OPERATIONAL:
            return
        if self.follows and self.target is not None:
            self.position = self.target
            self.lowest, self.highest = min(self.lowest, self.position), max(self.highest, self.position)
        for number, data in self.waiting:
            self.take(number, data)
        self.waiting.clear()
        self.count += 1
        self.show()
        for number in range(8):
            cob_id, kind = self.get(0x1800 + number, 1), self.get(0x1800 + number, 2)
            mapped = self.get(0x1A00 + number)
            used = (0x1800 + number, 1) in self.types and not cob_id >> 31 and mapped and 1 <= kind <= 240
            if used and self.count % kind == 0:
                words = [self.get(0x1A00 + number, sub) for sub in range(1, mapped + 1)]
                data = b"".join(self.pack((word >> 16, word >> 8 & 0xFF)) for word in words)
                self.bus.send(cob_id & 0x7FF, data)

    def take(self, number: int, data: bytes) -> None:
        for sub in range(1, self.get(0x1600 + number) + 1):
            word = self.get(0x1600 + number, sub)
            piece, data = data[: (word & 0xFF) // 8], data[(word & 0xFF) // 8 :]
            if word >> 16 > 0x0007:
                self.store((word >> 16, word >> 8 & 0xFF), piece)

    # -------------------------------------------------------------- the node

    def on_frame(self, can_id: int, data: bytes) -> None:
        if can_id == 0x000 and len(data) == 2 and data[1] in (0, self.node_id):
            states = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
            if data[0] in (0x81, 0x82):
                self.reset()
            elif data[0] in states:
                self.nmt = states[data[0]]
                self.show()
        elif can_id == 0x600 + self.node_id and len(data) == 8 and self.nmt != STOPPED:
            try:
                answer = self.serve(data)
            except Refused as refused:
                answer = b"\x80" + data[1:4] + refused.code.to_bytes(4, "little")
            if answer:
                self.bus.send(0x580 + self.node_id, answer)
        elif self.nmt == OPERATIONAL:
            for number in range(8):
                cob_id = self.get(0x1400 + number, 1)
                if (0x1400 + number, 1) in self.types and not cob_id >> 31 and cob_id & 0x7FF == can_id:
                    if self.get(0x1400 + number, 2) <= 240:
                        self.waiting.append((number, data))
                    else:
                        self.take(number, data)

    def serve(self, data: bytes) -> bytes:
        command, index, sub = struct.unpack_from("<BHB", data)
        if command == 0x80:
            return b""
        if command >> 5 == 3:  # the next segment of an upload
            piece, self.segments = self.segments[:7], self.segments[7:]
            head = command & 0x10 | (7 - len(piece)) << 1 | (not self.segments)
            return bytes((head,)) + piece.ljust(7, b"\0")
        variable = self.types.get((index, sub))
        if variable is None:
            raise Refused(NO_SUBINDEX if any(index == other for other, _ in self.types) else NO_OBJECT)
        if command >> 5 == 2:
            value = self.pack((index, sub))
            if len(value) <= 4:
                return struct.pack("<BHB4s", 0x43 | 4 - len(value) << 2, index, sub, value)
            self.segments = value
            return struct.pack("<BHBI", 0x41, index, sub, len(value))
        if command >> 5 != 1 or not command & 2:
            raise Refused(COMMAND)
        if "w" not in variable.access_type:
            raise Refused(READ_ONLY)
        self.store((index, sub), data[4:])
        return struct.pack("<BHB4x", 0x60, index, sub)

    def beat(self, now: float) -> None:
        period = self.get(0x1017) / 1000.0
        if period and now >= self.next_heartbeat:
            self.next_heartbeat = max(self.next_heartbeat + period, now)
            self.bus.send(0x700 + self.node_id, bytes((self.nmt,)))


class Bus:
    """A raw CAN socket."""

    def __init__(self, channel: str) -> None:
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.bind((channel,))

    def send(self, can_id: int, data: bytes) -> None:
        self.socket.send(FRAME.pack(can_id, len(data), data.ljust(8, b"\0")))

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        if not select.select([self.socket], [], [], timeout_s)[0]:
            return None
        can_id, length, data = FRAME.unpack(self.socket.recv(FRAME.size))
        return can_id, data[:length]


def main(channel: str, eds: str, mode: str, *nodes: str) -> None:
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: ended.append(number))
    bus = Bus(channel)
    starts = [tuple(map(int, node.split("="))) for node in nodes]
    drives = [Drive(bus, eds, node_id, int(mode), position) for node_id, position in starts]
    print("serving", flush=True)
    while not ended:
        frame = bus.receive(0.01)
        for drive in drives:
            if frame is not None and frame[0] == drive.get(0x1005) & 0x7FF:
                drive.on_sync()
            elif frame is not None:
                drive.on_frame(*frame)
            drive.beat(time.monotonic())
    for drive in drives:
        seen = {name: getattr(drive, name) for name in ("node_id", "nmt", "state", "lowest", "highest", "words")}
        print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
