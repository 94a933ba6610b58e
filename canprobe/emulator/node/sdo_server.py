"""One SDO server: expedited, segmented and block transfers on the node's dictionary, by one table of states.

Source: CiA 301, "Service data object (SDO)", objects 1200h–127Fh.
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Callable, Mapping
from enum import IntEnum, auto
from functools import partial
from typing import Protocol

from canprobe.emulator.node.core import NO_ROUTES, NodeCore, Route
from canprobe.emulator.node.dictionary import Abort, Entry, SdoAbort, Value
from canprobe.protocol.frames import SDO_RX_BASE, SDO_TX_BASE, NmtState, is_restricted

# The state machine of an SDO server as a table.
#
#     IDLE → (initiate) DOWNLOAD, UPLOAD: a segment stays or, the last one, returns to IDLE
#          → BLOCK_DOWNLOAD → BLOCK_DOWNLOAD_END → IDLE
#          → BLOCK_UPLOAD_START → BLOCK_UPLOAD → BLOCK_UPLOAD_END → IDLE
#
# Expedited transfers begin and end in IDLE. A request that the table has not is aborted (05040001h), and every abort,
# the time-out and the stopped state lead to IDLE. An initiate request takes the place of an open transfer: a master
# that was restarted is served at once. Source: CiA 301, "SDO protocols".


class SdoState(IntEnum):
    """What a server waits for: a new request, or the next frame of a transfer."""

    IDLE = auto()
    DOWNLOAD = auto()
    UPLOAD = auto()
    BLOCK_DOWNLOAD = auto()
    BLOCK_DOWNLOAD_END = auto()
    BLOCK_UPLOAD_START = auto()
    BLOCK_UPLOAD = auto()
    BLOCK_UPLOAD_END = auto()


class SdoRequest(IntEnum):
    """What a client's frame is, by its command byte."""

    INITIATE_DOWNLOAD = auto()
    INITIATE_UPLOAD = auto()
    DOWNLOAD_SEGMENT = auto()
    UPLOAD_SEGMENT = auto()
    INITIATE_BLOCK_DOWNLOAD = auto()
    BLOCK_SEGMENT = auto()
    END_BLOCK_DOWNLOAD = auto()
    INITIATE_BLOCK_UPLOAD = auto()
    START_BLOCK_UPLOAD = auto()
    ACKNOWLEDGE_BLOCK = auto()
    END_BLOCK_UPLOAD = auto()
    ABORT = auto()
    UNKNOWN = auto()


_S, _R = SdoState, SdoRequest
_COMMANDED = tuple(state for state in SdoState if state is not SdoState.BLOCK_DOWNLOAD)
_INITIATE = {
    _R.INITIATE_DOWNLOAD: (_S.IDLE, _S.DOWNLOAD),  # expedited; segmented
    _R.INITIATE_UPLOAD: (_S.IDLE, _S.UPLOAD),
    _R.INITIATE_BLOCK_DOWNLOAD: (_S.BLOCK_DOWNLOAD,),
    _R.INITIATE_BLOCK_UPLOAD: (_S.BLOCK_UPLOAD_START, _S.IDLE, _S.UPLOAD),  # the last two by the protocol switch
}

SDO_TRANSITIONS: dict[tuple[SdoState, SdoRequest], tuple[SdoState, ...]] = {
    **{(state, request): goals for state in _COMMANDED for request, goals in _INITIATE.items()},
    **{(state, _R.ABORT): (_S.IDLE,) for state in SdoState},
    (_S.DOWNLOAD, _R.DOWNLOAD_SEGMENT): (_S.DOWNLOAD, _S.IDLE),
    (_S.UPLOAD, _R.UPLOAD_SEGMENT): (_S.UPLOAD, _S.IDLE),
    (_S.BLOCK_DOWNLOAD, _R.BLOCK_SEGMENT): (_S.BLOCK_DOWNLOAD, _S.BLOCK_DOWNLOAD_END),
    (_S.BLOCK_DOWNLOAD_END, _R.END_BLOCK_DOWNLOAD): (_S.IDLE,),
    (_S.BLOCK_UPLOAD_START, _R.START_BLOCK_UPLOAD): (_S.BLOCK_UPLOAD,),
    (_S.BLOCK_UPLOAD, _R.ACKNOWLEDGE_BLOCK): (_S.BLOCK_UPLOAD, _S.BLOCK_UPLOAD_END),
    (_S.BLOCK_UPLOAD_END, _R.END_BLOCK_UPLOAD): (_S.IDLE,),
}
"""State and request → the states that may follow when the request is right in itself; IDLE by an abort if not."""

_ABORT_COMMAND = 0x80
_BY_SPECIFIER = (
    _R.DOWNLOAD_SEGMENT,
    _R.INITIATE_DOWNLOAD,
    _R.INITIATE_UPLOAD,
    _R.UPLOAD_SEGMENT,
    _R.UNKNOWN,  # but for 80h itself
)
_BLOCK_UPLOAD = (_R.INITIATE_BLOCK_UPLOAD, _R.END_BLOCK_UPLOAD, _R.ACKNOWLEDGE_BLOCK, _R.START_BLOCK_UPLOAD)
_BLOCK_DOWNLOAD = (_R.INITIATE_BLOCK_DOWNLOAD, _R.END_BLOCK_DOWNLOAD)


def _read(command: int) -> SdoRequest:
    specifier = command >> 5
    if command == _ABORT_COMMAND:
        return _R.ABORT
    if specifier == 5:
        return _BLOCK_UPLOAD[command & 3]
    if specifier == 6:
        return _BLOCK_DOWNLOAD[command & 1]
    return _BY_SPECIFIER[specifier] if specifier < 5 else _R.UNKNOWN


_REQUESTS = tuple(_read(command) for command in range(256))


def request_of(state: SdoState, command: int) -> SdoRequest:
    """What a command byte means; during a block download every frame but an abort is a numbered segment."""
    if state is SdoState.BLOCK_DOWNLOAD and command != _ABORT_COMMAND:
        return SdoRequest.BLOCK_SEGMENT
    return _REQUESTS[command]


# Segmented SDO transfers, the server's side: one object per transfer in progress.
#
# A transfer gets the client's frames and gives the answers; it raises SdoAbort when the client breaks the protocol.
# Source: CiA 301, "SDO download segment", "SDO upload segment".

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


# SDO block transfers, the server's side.
#
# Source: CiA 301, "SDO block download", "SDO block upload"; CRC is CRC-16/XMODEM (polynomial 1021h, start 0).

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


# One SDO server: expedited, segmented and block transfers on the node's dictionary, by the table of states above.

TIMEOUT_NS = 1_000_000_000
_INVALID = 1 << 31
_UNUSED_BITS = 0x3FFFF800
_HEAD = struct.Struct("<BHBI")
_EXPEDITED = {size: partial(struct.Struct("<BHB4s").pack, 0x43 | (4 - size) << 2) for size in (1, 2, 3, 4)}
_SERVED = frozenset({NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL})


class SdoServer:
    """The server of one channel, 1200h by default; `index` 1201h… makes an additional one."""

    def __init__(self, core: NodeCore, index: int = 0x1200) -> None:
        self._core = core
        self._index = index
        self._transfer: Transfer | None = None
        self._multiplexer = (0, 0)
        self._answer_id = 0
        self._timer = core.timers.new(self._timed_out)
        self._initiate: dict[SdoRequest, Callable[[bytes], bytes]] = {
            SdoRequest.INITIATE_DOWNLOAD: self._download,
            SdoRequest.INITIATE_UPLOAD: self._upload,
            SdoRequest.INITIATE_BLOCK_DOWNLOAD: self._block_download,
            SdoRequest.INITIATE_BLOCK_UPLOAD: self._block_upload,
        }
        if index != 0x1200:
            core.dictionary.on_check(index, self._check_cob_id)
        core.dictionary.on_write(index, lambda _sub, _value: core.reroute())

    @property
    def state(self) -> SdoState:
        """Where the transfer in progress is."""
        return SdoState.IDLE if self._transfer is None else self._transfer.state

    def reset(self, t_ns: int) -> None:
        """Drop what is open."""
        self._drop()

    def entered(self, t_ns: int) -> None:
        """A transfer does not survive the stopped state."""
        if self._core.state not in _SERVED:
            self._drop()

    def routes(self) -> Mapping[int, Route]:
        """The request identifier, in pre-operational and operational."""
        cob_id, answer_id = self._cob_id(1, SDO_RX_BASE), self._cob_id(2, SDO_TX_BASE)
        self._answer_id = answer_id & 0x7FF
        if self._core.state not in _SERVED or (cob_id | answer_id) & _INVALID:
            return NO_ROUTES
        return {cob_id & 0x7FF: self._receive}

    def _cob_id(self, subindex: int, base: int) -> int:
        default = base + self._core.node_id if self._index == 0x1200 else _INVALID
        return self._core.dictionary.number(self._index, subindex, default)

    def _receive(self, data: bytes, t_ns: int) -> None:
        if len(data) != 8:
            return
        try:
            answers = self._answer(data)
        except SdoAbort as abort:
            self._abort(abort.code)
            return
        for answer in answers:
            self._core.out.append((self._answer_id, answer))
        transfer = self._transfer
        if transfer is not None and transfer.state is not SdoState.IDLE:
            self._timer.arm(t_ns + TIMEOUT_NS)
        elif transfer is not None or self._timer.due_ns is not None:
            self._drop()

    def _answer(self, data: bytes) -> list[bytes]:
        transfer = self._transfer
        state = SdoState.IDLE if transfer is None else transfer.state
        request = request_of(state, data[0])
        if initiate := self._initiate.get(request):
            self._transfer = None
            self._multiplexer = _HEAD.unpack(data)[1:3]
            return [initiate(data)]
        if request is SdoRequest.ABORT:
            self._transfer = None
            return []
        if transfer is None:
            self._multiplexer = _HEAD.unpack(data)[1:3]
        if transfer is None or (state, request) not in SDO_TRANSITIONS:
            raise SdoAbort(Abort.COMMAND)
        return transfer.receive(data)

    def _download(self, data: bytes) -> bytes:
        index, subindex = self._multiplexer
        dictionary = self._core.dictionary
        entry = dictionary.find_writable(index, subindex)
        command = data[0]
        if command & 2:
            size = 4 - (command >> 2 & 3) if command & 1 else min(entry.bits // 8 or 4, 4)
            dictionary.write_value(entry, entry.from_bytes(data[4 : 4 + size]))
            dictionary.configured(index)
        else:
            announced = int.from_bytes(data[4:8], "little") if command & 1 else None
            self._transfer = SegmentedDownload(entry, announced, self._write)
        return _HEAD.pack(0x60, index, subindex, 0)

    def _upload(self, data: bytes) -> bytes:
        value = self._core.dictionary.read(*self._multiplexer)
        size = len(value)
        if 1 <= size <= 4:
            return _EXPEDITED[size](*self._multiplexer, value)
        self._transfer = SegmentedUpload(value)
        return _HEAD.pack(0x41, *self._multiplexer, len(value))

    def _block_download(self, data: bytes) -> bytes:
        index, subindex = self._multiplexer
        entry = self._core.dictionary.find_writable(index, subindex)
        announced = int.from_bytes(data[4:8], "little") if data[0] & 2 else None
        self._transfer = BlockDownload(entry, announced, bool(data[0] & 4), self._write)
        return _HEAD.pack(0xA4, index, subindex, 127)

    def _block_upload(self, data: bytes) -> bytes:
        value = self._core.dictionary.read(*self._multiplexer)
        block_size, threshold = data[4], data[5]
        transfer = BlockUpload(value, block_size, bool(data[0] & 4))
        if 0 < len(value) <= threshold:
            return self._upload(data)
        self._transfer = transfer
        return _HEAD.pack(0xC6, *self._multiplexer, len(value))

    def _write(self, data: bytes) -> None:
        self._core.dictionary.write(*self._multiplexer, data)
        self._core.dictionary.configured(self._multiplexer[0])

    def _abort(self, code: Abort) -> None:
        self._drop()
        self._core.send(self._answer_id, _HEAD.pack(0x80, *self._multiplexer, code))

    def _drop(self) -> None:
        self._transfer = None
        self._timer.cancel()

    def _check_cob_id(self, subindex: int, value: Value) -> None:
        """COB-IDs of an additional server: not restricted, and not changed while in use."""
        if subindex not in (1, 2):
            return
        new, old = int(value), self._core.dictionary.number(self._index, subindex, _INVALID)
        changed_while_valid = not (new | old) & _INVALID and (new ^ old) & 0x7FF
        if new & _UNUSED_BITS or changed_while_valid or (not new & _INVALID and is_restricted(new & 0x7FF)):
            raise SdoAbort(Abort.VALUE)

    def _timed_out(self, due_ns: int) -> None:
        self._abort(Abort.TIMED_OUT)
