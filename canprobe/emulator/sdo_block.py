"""SDO block transfers, the server's side.

Source: CiA 301, "SDO block download", "SDO block upload"; CRC is CRC-16/XMODEM (polynomial 1021h, start 0).
"""

from __future__ import annotations

import struct
from binascii import crc_hqx

from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.entries import Entry
from canprobe.emulator.sdo_states import SdoState
from canprobe.emulator.sdo_transfers import Reception, Writer

BLOCK_SIZE = 127


def _check_block_size(size: int) -> int:
    if not 1 <= size <= BLOCK_SIZE:
        raise SdoAbort(Abort.BLOCK_SIZE)
    return size


class BlockDownload:
    """Client → server in blocks of up to 127 numbered segments; a lost segment is asked for again."""

    def __init__(self, entry: Entry, announced: int | None, with_crc: bool, write: Writer) -> None:
        self._reception = Reception(entry, announced)
        self._with_crc = with_crc
        self._write = write
        self._sequence = 0
        self.state = SdoState.BLOCK_DOWNLOAD

    def receive(self, data: bytes) -> list[bytes]:
        """One segment, or after the last one the end of the transfer."""
        return self._segment(data) if self.state is SdoState.BLOCK_DOWNLOAD else self._end(data)

    def _segment(self, data: bytes) -> list[bytes]:
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if number == 0:
            raise SdoAbort(Abort.SEQUENCE)
        accepted = number == self._sequence + 1
        if accepted:
            self._sequence = number
            self._reception.add(data[1:8], slack=6)
        if not last and number < BLOCK_SIZE:
            return []
        if last and accepted:
            self.state = SdoState.BLOCK_DOWNLOAD_END
        acknowledged, self._sequence = self._sequence, 0
        return [bytes((0xA2, acknowledged, BLOCK_SIZE, 0, 0, 0, 0, 0))]

    def _end(self, data: bytes) -> list[bytes]:
        value = self._reception.complete(unused=data[0] >> 2 & 7)
        if self._with_crc and crc_hqx(value, 0) != data[1] | data[2] << 8:
            raise SdoAbort(Abort.CRC)
        self._write(value)
        self.state = SdoState.IDLE
        return [b"\xa1".ljust(8, b"\0")]


class BlockUpload:
    """Server → client in blocks as long as the client asks for."""

    def __init__(self, value: bytes, block_size: int, with_crc: bool) -> None:
        self._value = value
        self._block_size = _check_block_size(block_size)
        self._crc = crc_hqx(value, 0) if with_crc else 0
        self._position = 0
        self._sent = 0
        self.state = SdoState.BLOCK_UPLOAD_START

    def receive(self, data: bytes) -> list[bytes]:
        """Start (A3h), acknowledge (A2h) or end (A1h) from the client, as the state wants it."""
        if self.state is SdoState.BLOCK_UPLOAD:
            return self._acknowledged(data[1], data[2])
        if self.state is SdoState.BLOCK_UPLOAD_START:
            self.state = SdoState.BLOCK_UPLOAD
            return self._block()
        self.state = SdoState.IDLE
        return []

    def _block(self) -> list[bytes]:
        frames: list[bytes] = []
        position, end = self._position, len(self._value)
        while len(frames) < self._block_size and (position < end or not frames):
            piece = self._value[position : position + 7]
            position += 7
            last = 0x80 if position >= end else 0
            frames.append(bytes((last | len(frames) + 1,)) + piece.ljust(7, b"\0"))
        self._sent = len(frames)
        return frames

    def _acknowledged(self, sequence: int, block_size: int) -> list[bytes]:
        if sequence > self._sent:
            raise SdoAbort(Abort.SEQUENCE)
        self._block_size = _check_block_size(block_size)
        self._position += sequence * 7
        if sequence < self._sent or self._position < len(self._value):
            return self._block()
        self.state = SdoState.BLOCK_UPLOAD_END
        unused = self._position - len(self._value)
        return [struct.pack("<BH5x", 0xC1 | unused << 2, self._crc)]
