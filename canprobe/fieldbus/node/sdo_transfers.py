"""SDO transfers of several frames: segmented and block, download and upload. Each is a generator.

A transfer yields the state of its server, which says for what frame of the client it waits, with the answers to the
frame before; it gets a frame that the table of `sdo_states` allows in that state. When it is over it returns its last
answers. It raises `SdoAbort` where the client breaks the protocol.

Source: CiA 301, "SDO download", "SDO upload", "SDO block download", "SDO block upload"; the CRC is CRC-16/XMODEM
(polynomial 1021h, start 0).
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable, Generator

from canprobe.fieldbus.node.dictionary import Entry
from canprobe.fieldbus.node.sdo_states import SdoState
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort, segment_value

Transfer = Generator[tuple[SdoState, list[bytes]], bytes, list[bytes]]
MAX_VALUE_BYTES = 1 << 20
"""Longest value that a node takes; a longer one is refused with 05040005h."""
MAX_BLOCK_SEGMENTS = 127
_SEGMENT_BYTES = 7
_TOGGLE_FLAG = 0x10


class _ReceivedValue:
    """A value that comes in piece by piece.

    Args:
        entry: entry that gets the value.
        announced: size that the client announced, bytes; None: it announced none.
    """

    def __init__(self, entry: Entry, announced: int | None) -> None:
        self._announced, self._most = announced, entry.bits // 8 or MAX_VALUE_BYTES
        if announced is not None:
            entry.check_size(announced)
            if announced > MAX_VALUE_BYTES:
                raise SdoAbort(Abort.MEMORY)
            self._most = announced
        self._data = bytearray()

    def take(self, piece: bytes, slack: int = 0) -> None:
        """Append received bytes, of which `slack` may be filling."""
        self._data += piece
        if len(self._data) - slack > self._most:
            raise SdoAbort(Abort.TOO_LONG)

    def whole(self, unused: int = 0) -> bytes:
        """The bytes that were received, without the last `unused` ones."""
        value = bytes(self._data[: len(self._data) - unused])
        if self._announced is not None and len(value) != self._announced:
            raise SdoAbort(Abort.TOO_SHORT if len(value) < self._announced else Abort.TOO_LONG)
        return value


def segmented_download(answer: bytes, entry: Entry, announced: int | None, store: Callable[[bytes], None]) -> Transfer:
    """A value that comes in up to seven bytes a frame, each frame with its answer.

    Args:
        answer: answer to the request.
        entry: entry that gets the value.
        announced: size that the client announced, bytes; None: it announced none.
        store: function that stores the whole value; it may raise SdoAbort.
    """
    received, toggle, last = _ReceivedValue(entry, announced), 0, False
    while not last:
        data = yield SdoState.DOWNLOAD, [answer]
        _check_toggle(data[0], toggle)
        received.take(segment_value(data))
        answer = bytes((0x20 | toggle, 0, 0, 0, 0, 0, 0, 0))
        toggle, last = toggle ^ _TOGGLE_FLAG, bool(data[0] & 1)
    store(received.whole())
    return [answer]


def block_download(
    answer: bytes, entry: Entry, announced: int | None, store: Callable[[bytes], None], *, with_crc: bool
) -> Transfer:
    """A value that comes in by blocks of numbered segments, each block with one answer.

    Segments behind a lost one are dropped, and the client sends them again.

    Args:
        answer, entry, announced, store: as for a segmented download.
        with_crc: whether the client sends a CRC at the end.
    """
    received, answers, whole = _ReceivedValue(entry, announced), [answer], False
    accepted = 0  # number of the last segment of the block that was accepted
    while not whole:
        data = yield SdoState.BLOCK_DOWNLOAD, answers
        number, last, answers = data[0] & 0x7F, bool(data[0] & 0x80), []
        if number == 0:
            raise SdoAbort(Abort.SEQUENCE)
        follows = number == accepted + 1
        if follows:
            accepted = number
            # only the end says how many bytes of the last segment are filling
            received.take(data[1:8], slack=_SEGMENT_BYTES - 1)
        if last or number == MAX_BLOCK_SEGMENTS:
            answers = [bytes((0xA2, accepted, MAX_BLOCK_SEGMENTS, 0, 0, 0, 0, 0))]
            accepted, whole = 0, last and follows
    data = yield SdoState.BLOCK_DOWNLOAD_END, answers
    value = received.whole(unused=data[0] >> 2 & 7)
    if with_crc and crc_hqx(value, 0) != data[1] | data[2] << 8:
        raise SdoAbort(Abort.CRC)
    store(value)
    return [b"\xa1".ljust(8, b"\0")]


def segmented_upload(answer: bytes, value: bytes) -> Transfer:
    """A value that goes out up to seven bytes a frame, each asked for; `answer` is that to the request."""
    toggle = 0
    for position in range(0, len(value) or 1, _SEGMENT_BYTES):
        data = yield SdoState.UPLOAD, [answer]
        _check_toggle(data[0], toggle)
        piece, last = value[position : position + _SEGMENT_BYTES], position + _SEGMENT_BYTES >= len(value)
        answer = _segment(toggle | (_SEGMENT_BYTES - len(piece)) << 1 | last, piece)
        toggle ^= _TOGGLE_FLAG
    return [answer]


def block_upload(answer: bytes, value: bytes, block_size: int, *, with_crc: bool) -> Transfer:
    """A value that goes out by blocks of numbered segments, each block acknowledged.

    Segments that the client did not get are sent again in the next block.

    Args:
        answer: answer to the request.
        value: bytes of the value.
        block_size: most segments in a block.
        with_crc: whether the client wants a CRC at the end.
    """
    yield SdoState.BLOCK_UPLOAD_START, [answer]
    acknowledged, whole = 0, False  # number of bytes that the client has
    while not whole:
        segments: list[bytes] = []
        position = acknowledged
        while len(segments) < block_size and (position < len(value) or not segments):
            piece, position = value[position : position + _SEGMENT_BYTES], position + _SEGMENT_BYTES
            segments.append(_segment((0x80 if position >= len(value) else 0) | len(segments) + 1, piece))
        data = yield SdoState.BLOCK_UPLOAD, segments
        if data[1] > len(segments):
            raise SdoAbort(Abort.SEQUENCE)
        block_size = check_block_size(data[2])
        acknowledged += data[1] * _SEGMENT_BYTES
        whole = data[1] == len(segments) and acknowledged >= len(value)
    crc = crc_hqx(value, 0) if with_crc else 0
    yield SdoState.BLOCK_UPLOAD_END, [struct.pack("<BH5x", 0xC1 | acknowledged - len(value) << 2, crc)]
    return []


def check_block_size(size: int) -> int:
    """Return the number of segments in a block. Raises SdoAbort where it is not 1 to 127."""
    if not 1 <= size <= MAX_BLOCK_SEGMENTS:
        raise SdoAbort(Abort.BLOCK_SIZE)
    return size


def _check_toggle(command: int, toggle: int) -> None:
    if command & _TOGGLE_FLAG != toggle:
        raise SdoAbort(Abort.TOGGLE)


def _segment(command: int, piece: bytes) -> bytes:
    return bytes((command,)) + piece.ljust(_SEGMENT_BYTES, b"\0")
