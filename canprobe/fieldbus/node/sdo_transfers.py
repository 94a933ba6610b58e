"""SDO transfers of several frames: segmented and block, download and upload. Each is an object with its state.

`step` takes a frame that the table of `sdo_states` allows in the state of the transfer. It returns the answers, or
raises `SdoAbort` when the client breaks the protocol. A transfer whose state is IDLE is over.

Source: CiA 301, "SDO download", "SDO upload", "SDO block download", "SDO block upload"; the CRC is CRC-16/XMODEM
(polynomial 1021h, start 0).
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from binascii import crc_hqx
from collections.abc import Callable

from canprobe.fieldbus.node.dictionary import Entry
from canprobe.fieldbus.node.sdo_states import SdoState
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

MAX_VALUE_BYTES = 1 << 20
"""Longest value that a node takes; a longer one is refused with 05040005h."""
MAX_BLOCK_SEGMENTS = 127
_SEGMENT_BYTES = 7
_TOGGLE_FLAG = 0x10


class Transfer(ABC):
    """One transfer under way.

    Attributes:
        state: state, which says for what frame of the client it waits; IDLE when it is over.
    """

    state: SdoState

    @abstractmethod
    def step(self, data: bytes) -> list[bytes]:
        """Take the client's next frame and return the answers. Raises SdoAbort."""


def check_block_size(size: int) -> int:
    """Return the number of segments in a block. Raises SdoAbort where it is not 1 to 127."""
    if not 1 <= size <= MAX_BLOCK_SEGMENTS:
        raise SdoAbort(Abort.BLOCK_SIZE)
    return size


def _check_toggle(command: int, toggle: int) -> None:
    if command & _TOGGLE_FLAG != toggle:
        raise SdoAbort(Abort.TOGGLE)


class _Download(Transfer):
    """A value that comes in.

    Args:
        entry: entry that gets the value.
        announced: size that the client announced, bytes; None: it announced none.
        store: function that stores the whole value; it may raise SdoAbort.
    """

    def __init__(self, entry: Entry, announced: int | None, store: Callable[[bytes], None]) -> None:
        self._announced, self._store = announced, store
        self._most = entry.bits // 8 or MAX_VALUE_BYTES
        if announced is not None:
            entry.check_size(announced)
            if announced > MAX_VALUE_BYTES:
                raise SdoAbort(Abort.MEMORY)
            self._most = announced
        self._data = bytearray()

    def _take(self, piece: bytes, slack: int = 0) -> None:
        """Append received bytes, of which `slack` may be filling."""
        self._data += piece
        if len(self._data) - slack > self._most:
            raise SdoAbort(Abort.TOO_LONG)

    def _received(self, unused: int = 0) -> bytes:
        """The bytes that were received, without the last `unused` ones."""
        value = bytes(self._data[: len(self._data) - unused])
        if self._announced is not None and len(value) != self._announced:
            raise SdoAbort(Abort.TOO_SHORT if len(value) < self._announced else Abort.TOO_LONG)
        return value


class SegmentedDownload(_Download):
    """A value that comes in up to seven bytes a frame, each frame with its answer."""

    state = SdoState.DOWNLOAD
    _toggle = 0

    def step(self, data: bytes) -> list[bytes]:
        """Take a segment; the last one stores the value."""
        toggle = self._toggle
        _check_toggle(data[0], toggle)
        self._toggle ^= _TOGGLE_FLAG
        self._take(data[1 : 8 - (data[0] >> 1 & 7)])
        if data[0] & 1:
            self._store(self._received())
            self.state = SdoState.IDLE
        return [bytes((0x20 | toggle, 0, 0, 0, 0, 0, 0, 0))]


class BlockDownload(_Download):
    """A value that comes in by blocks of numbered segments, each block with one answer.

    Args:
        entry, announced, store: entry, size and function, as for a segmented download.
        with_crc: whether the client sends a CRC at the end.
    """

    state = SdoState.BLOCK_DOWNLOAD

    def __init__(self, entry: Entry, announced: int | None, store: Callable[[bytes], None], with_crc: bool) -> None:
        super().__init__(entry, announced, store)
        self._with_crc = with_crc
        self._sequence = 0  # number of the last segment that was accepted

    def step(self, data: bytes) -> list[bytes]:
        """Take a segment, or the end of the transfer."""
        return self._segment(data) if self.state is SdoState.BLOCK_DOWNLOAD else self._end(data)

    def _segment(self, data: bytes) -> list[bytes]:
        """Take a numbered segment; those behind a lost one are dropped, and the client sends them again."""
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if number == 0:
            raise SdoAbort(Abort.SEQUENCE)
        accepted = number == self._sequence + 1
        if accepted:
            self._sequence = number
            self._take(data[1:8], slack=_SEGMENT_BYTES - 1)
        if not last and number < MAX_BLOCK_SEGMENTS:
            return []
        if last and accepted:
            self.state = SdoState.BLOCK_DOWNLOAD_END
        acknowledged, self._sequence = self._sequence, 0
        return [bytes((0xA2, acknowledged, MAX_BLOCK_SEGMENTS, 0, 0, 0, 0, 0))]

    def _end(self, data: bytes) -> list[bytes]:
        value = self._received(unused=data[0] >> 2 & 7)
        if self._with_crc and crc_hqx(value, 0) != data[1] | data[2] << 8:
            raise SdoAbort(Abort.CRC)
        self._store(value)
        self.state = SdoState.IDLE
        return [b"\xa1".ljust(8, b"\0")]


class SegmentedUpload(Transfer):
    """A value that goes out up to seven bytes a frame, each asked for."""

    state = SdoState.UPLOAD

    def __init__(self, value: bytes) -> None:
        self._value = value
        self._position = self._toggle = 0

    def step(self, data: bytes) -> list[bytes]:
        toggle = self._toggle
        _check_toggle(data[0], toggle)
        self._toggle ^= _TOGGLE_FLAG
        piece = self._value[self._position : self._position + _SEGMENT_BYTES]
        self._position += _SEGMENT_BYTES
        last = self._position >= len(self._value)
        if last:
            self.state = SdoState.IDLE
        return [bytes((toggle | (_SEGMENT_BYTES - len(piece)) << 1 | last,)) + piece.ljust(_SEGMENT_BYTES, b"\0")]


class BlockUpload(Transfer):
    """A value that goes out by blocks of numbered segments, each block acknowledged.

    Args:
        value: bytes of the value.
        block_size: most segments in a block.
        with_crc: whether the client wants a CRC at the end.
    """

    def __init__(self, value: bytes, block_size: int, with_crc: bool) -> None:
        self.state = SdoState.BLOCK_UPLOAD_START
        self._value, self._block_size, self._with_crc = value, block_size, with_crc
        self._position = 0  # of the first byte that is not acknowledged
        self._sent = 0  # segments of the last block

    def step(self, data: bytes) -> list[bytes]:
        """Begin to send, go on after an acknowledgement, or end."""
        if self.state is SdoState.BLOCK_UPLOAD:
            return self._acknowledged(data)
        if self.state is SdoState.BLOCK_UPLOAD_START:
            return self._block()
        self.state = SdoState.IDLE
        return []

    def _block(self) -> list[bytes]:
        """The segments of the next block; they are sent again from the first that the client did not get."""
        self.state = SdoState.BLOCK_UPLOAD
        frames: list[bytes] = []
        position, end = self._position, len(self._value)
        while len(frames) < self._block_size and (position < end or not frames):
            piece = self._value[position : position + _SEGMENT_BYTES]
            position += _SEGMENT_BYTES
            last = 0x80 if position >= end else 0
            frames.append(bytes((last | len(frames) + 1,)) + piece.ljust(_SEGMENT_BYTES, b"\0"))
        self._sent = len(frames)
        return frames

    def _acknowledged(self, data: bytes) -> list[bytes]:
        sequence, end = data[1], len(self._value)
        if sequence > self._sent:
            raise SdoAbort(Abort.SEQUENCE)
        self._block_size = check_block_size(data[2])
        self._position += sequence * _SEGMENT_BYTES
        if sequence < self._sent or self._position < end:
            return self._block()
        self.state = SdoState.BLOCK_UPLOAD_END
        crc = crc_hqx(self._value, 0) if self._with_crc else 0
        return [struct.pack("<BH5x", 0xC1 | self._position - end << 2, crc)]
