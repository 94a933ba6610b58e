"""Segmented SDO transfers, the server's side: one object per transfer in progress.

A transfer gets the client's frames and gives the answers; it raises SdoAbort when the client breaks the protocol.
Source: CiA 301, "SDO download segment", "SDO upload segment".
"""

from __future__ import annotations

from typing import Protocol

from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.entries import Entry
from canprobe.emulator.sdo_states import SdoState

MAX_BYTES = 1 << 20
_TOGGLE = 0x10


class Transfer(Protocol):
    """A transfer in progress.

    Attributes:
        state: where the transfer is; IDLE when the last answer has been given.
    """

    state: SdoState

    def receive(self, data: bytes) -> list[bytes]:
        """Answer one client frame, which `SDO_TRANSITIONS` allows in this state. Raises SdoAbort."""


def check_size(entry: Entry, size: int) -> None:
    """Raises SdoAbort when `size` bytes cannot be a value of the entry."""
    if entry.bits and size * 8 != entry.bits:
        raise SdoAbort(Abort.TOO_LONG if size * 8 > entry.bits else Abort.TOO_SHORT)
    if size > MAX_BYTES:
        raise SdoAbort(Abort.MEMORY)


class Reception:
    """Bytes that arrive piece by piece, against the announced size and the entry."""

    def __init__(self, entry: Entry, announced: int | None) -> None:
        if announced is not None:
            check_size(entry, announced)
        self._announced = announced
        self._most = announced if announced is not None else (entry.bits // 8 or MAX_BYTES)
        self.data = bytearray()

    def add(self, piece: bytes, slack: int = 0) -> None:
        """Append. Raises SdoAbort when more than announced has come (`slack` bytes of it may be filling)."""
        self.data += piece
        if len(self.data) - slack > self._most:
            raise SdoAbort(Abort.TOO_LONG)

    def complete(self, unused: int = 0) -> bytes:
        """All bytes but the last `unused`. Raises SdoAbort when they are not as many as announced."""
        data = bytes(self.data[: len(self.data) - unused])
        if self._announced is not None and len(data) != self._announced:
            raise SdoAbort(Abort.TOO_SHORT if len(data) < self._announced else Abort.TOO_LONG)
        return data


class SegmentedDownload:
    """Client → server, 7 bytes a segment; `write` stores the value when the last one is there."""

    def __init__(self, entry: Entry, announced: int | None, write: Writer) -> None:
        self._reception = Reception(entry, announced)
        self._write = write
        self._toggle = 0
        self.state = SdoState.DOWNLOAD

    def receive(self, data: bytes) -> list[bytes]:
        """One segment."""
        command = data[0]
        if command & _TOGGLE != self._toggle:
            raise SdoAbort(Abort.TOGGLE)
        self._reception.add(data[1 : 8 - (command >> 1 & 7)])
        if command & 1:
            self._write(self._reception.complete())
            self.state = SdoState.IDLE
        answer = bytes((0x20 | self._toggle, 0, 0, 0, 0, 0, 0, 0))
        self._toggle ^= _TOGGLE
        return [answer]


class SegmentedUpload:
    """Server → client, 7 bytes a segment."""

    def __init__(self, value: bytes) -> None:
        self._rest = value
        self._toggle = 0
        self.state = SdoState.UPLOAD

    def receive(self, data: bytes) -> list[bytes]:
        """One request for a segment."""
        if data[0] & _TOGGLE != self._toggle:
            raise SdoAbort(Abort.TOGGLE)
        piece, self._rest = self._rest[:7], self._rest[7:]
        last = not self._rest
        if last:
            self.state = SdoState.IDLE
        command = self._toggle | (7 - len(piece)) << 1 | last
        self._toggle ^= _TOGGLE
        return [bytes((command,)) + piece.ljust(7, b"\0")]


class Writer(Protocol):
    """Stores a complete value. Raises SdoAbort."""

    def __call__(self, data: bytes) -> None:
        """Store."""
