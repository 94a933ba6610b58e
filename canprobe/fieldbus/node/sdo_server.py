"""One SDO server on the node's dictionary, by the table of `sdo_states`.

Each request that the table allows has one method. It returns the answers, or raises `SdoAbort` when the client breaks
the protocol.

Source: CiA 301, "SDO download", "SDO upload", "SDO block download", "SDO block upload"; the CRC is CRC-16/XMODEM
(polynomial 1021h, start 0).
"""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial

from canprobe.fieldbus.node.abort import Abort, SdoAbort
from canprobe.fieldbus.node.core import INVALID, NO_ROUTES, NodeCore, Route, Service, check_cob_id
from canprobe.fieldbus.node.entry import Entry, Value
from canprobe.fieldbus.node.sdo_states import SDO_TRANSITIONS, SdoRequest, SdoState, request_of
from canprobe.fieldbus.protocol.frames import SDO_RX_BASE, SDO_TX_BASE, NmtState

TIMEOUT_NS = 1_000_000_000
MAX_BYTES = 1 << 20
BLOCK_SIZE = 127
_TOGGLE = 0x10
_HEAD = struct.Struct("<BHBI")
_EXPEDITED = {size: partial(struct.Struct("<BHB4s").pack, 0x43 | (4 - size) << 2) for size in (1, 2, 3, 4)}
_SERVED = frozenset({NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL})


class SdoServer(Service):
    """The server of one channel, 1200h by default; `index` 1201h… makes an additional one.

    Attributes:
        state: where the transfer in progress is.
    """

    def __init__(self, core: NodeCore, index: int = 0x1200) -> None:
        self._core = core
        self._index = index
        self._multiplexer = (0, 0)
        self._answer_id = 0
        self._timer = core.timers.new(self._timed_out)
        self._slow_ns = core.quirks.sdo_ns
        self._slow_timer = core.timers.new(self._send_late)
        self._late: deque[tuple[int, bytes]] = deque()  # when, and what
        self.state = SdoState.IDLE
        self._data = bytearray()  # what was received so far, or what is sent
        self._announced: int | None = None
        self._most = self._position = self._toggle = 0
        self._sequence = self._block_size = 0  # of a block: the last segment, the segments at most
        self._with_crc = False
        self._initiate: dict[SdoRequest, Callable[[bytes], bytes]] = {
            SdoRequest.INITIATE_DOWNLOAD: self._download,
            SdoRequest.INITIATE_UPLOAD: self._upload,
            SdoRequest.INITIATE_BLOCK_DOWNLOAD: self._block_download,
            SdoRequest.INITIATE_BLOCK_UPLOAD: self._block_upload,
        }
        self._go_on: dict[SdoRequest, Callable[[bytes], list[bytes]]] = {
            SdoRequest.DOWNLOAD_SEGMENT: self._download_segment,
            SdoRequest.UPLOAD_SEGMENT: self._upload_segment,
            SdoRequest.BLOCK_SEGMENT: self._block_segment,
            SdoRequest.END_BLOCK_DOWNLOAD: self._end_block_download,
            SdoRequest.START_BLOCK_UPLOAD: self._send_block,
            SdoRequest.ACKNOWLEDGE_BLOCK: self._acknowledge_block,
            SdoRequest.END_BLOCK_UPLOAD: self._end,
            SdoRequest.ABORT: self._end,
        }
        if index != 0x1200:
            core.dictionary.on_check(index, self._check_cob_id)
        core.dictionary.on_write(index, lambda _sub, _value: core.reroute())

    def reset(self, t_ns: int) -> None:
        """Drop what is open."""
        self._forget()

    def entered(self, t_ns: int) -> None:
        """A transfer does not survive the stopped state."""
        if self._core.state not in _SERVED:
            self._forget()

    def _forget(self) -> None:
        self._drop()
        self._late.clear()
        self._slow_timer.cancel()

    def routes(self) -> Mapping[int, Route]:
        """The request identifier, in pre-operational and operational."""
        cob_id, answer_id = self._cob_id(1, SDO_RX_BASE), self._cob_id(2, SDO_TX_BASE)
        self._answer_id = answer_id & 0x7FF
        if self._core.state not in _SERVED or (cob_id | answer_id) & INVALID:
            return NO_ROUTES
        return {cob_id & 0x7FF: self._receive}

    def _cob_id(self, subindex: int, base: int) -> int:
        default = base + self._core.node_id if self._index == 0x1200 else INVALID
        return self._core.dictionary.number(self._index, subindex, default)

    def _check_cob_id(self, subindex: int, value: Value) -> None:
        if subindex in (1, 2):
            check_cob_id(value, self._core.dictionary.number(self._index, subindex, INVALID))

    def _receive(self, data: bytes, t_ns: int) -> None:
        if len(data) != 8:
            return
        try:
            answers = self._answer(data)
        except SdoAbort as abort:
            self._abort(abort.code)
            return
        for answer in answers:
            self._send(answer)
        if self.state is not SdoState.IDLE:
            self._timer.arm(t_ns + self._slow_ns + TIMEOUT_NS)
        elif self._timer.due_ns is not None:
            self._drop()

    def _send(self, answer: bytes) -> None:
        if not self._slow_ns:
            self._core.out.append((self._answer_id, answer))
            return
        self._late.append((self._core.now_ns + self._slow_ns, answer))
        self._slow_timer.arm(self._late[0][0])

    def _send_late(self, due_ns: int) -> None:
        while self._late and self._late[0][0] <= due_ns:
            self._core.out.append((self._answer_id, self._late.popleft()[1]))
        if self._late:
            self._slow_timer.arm(self._late[0][0])

    def _answer(self, data: bytes) -> list[bytes]:
        request = request_of(self.state, data[0])
        if request in self._initiate or (self.state is SdoState.IDLE and request is not SdoRequest.ABORT):
            self._multiplexer = _HEAD.unpack(data)[1:3]
        if initiate := self._initiate.get(request):
            self.state = SdoState.IDLE
            return [initiate(data)]
        if (self.state, request) not in SDO_TRANSITIONS:
            raise SdoAbort(Abort.COMMAND)
        return self._go_on[request](data)

    # ------------------------------------------------------------------ download

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
            self._expect(entry, data if command & 1 else None, SdoState.DOWNLOAD)
        return _HEAD.pack(0x60, index, subindex, 0)

    def _block_download(self, data: bytes) -> bytes:
        entry = self._core.dictionary.find_writable(*self._multiplexer)
        self._expect(entry, data if data[0] & 2 else None, SdoState.BLOCK_DOWNLOAD)
        self._with_crc = bool(data[0] & 4)
        return _HEAD.pack(0xA4, *self._multiplexer, BLOCK_SIZE)

    def _expect(self, entry: Entry, announcing: bytes | None, state: SdoState) -> None:
        """Begin to receive a value; a request that announces its size is checked for that."""
        self._announced = None
        self._most = entry.bits // 8 or MAX_BYTES
        if announcing is not None:
            self._announced = self._most = int.from_bytes(announcing[4:8], "little")
            entry.check_size(self._announced)
            if self._announced > MAX_BYTES:
                raise SdoAbort(Abort.MEMORY)
        self._data, self._toggle, self._sequence, self.state = bytearray(), 0, 0, state

    def _take(self, piece: bytes, slack: int = 0) -> None:
        """Append what came, of which `slack` bytes may be filling."""
        self._data += piece
        if len(self._data) - slack > self._most:
            raise SdoAbort(Abort.TOO_LONG)

    def _received(self, unused: int = 0) -> bytes:
        """What was received, but for the last `unused` bytes."""
        value = bytes(self._data[: len(self._data) - unused])
        if self._announced is not None and len(value) != self._announced:
            raise SdoAbort(Abort.TOO_SHORT if len(value) < self._announced else Abort.TOO_LONG)
        return value

    def _store(self, value: bytes) -> None:
        self._core.dictionary.write(*self._multiplexer, value)
        self._core.dictionary.configured(self._multiplexer[0])
        self.state = SdoState.IDLE

    def _toggled(self, command: int) -> int:
        """The toggle bit of this segment, which must alternate."""
        toggle = self._toggle
        if command & _TOGGLE != toggle:
            raise SdoAbort(Abort.TOGGLE)
        self._toggle ^= _TOGGLE
        return toggle

    def _download_segment(self, data: bytes) -> list[bytes]:
        toggle = self._toggled(data[0])
        self._take(data[1 : 8 - (data[0] >> 1 & 7)])
        if data[0] & 1:
            self._store(self._received())
        return [bytes((0x20 | toggle, 0, 0, 0, 0, 0, 0, 0))]

    def _block_segment(self, data: bytes) -> list[bytes]:
        """A numbered segment; behind a lost one the others are not taken, and the client sends them again."""
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if number == 0:
            raise SdoAbort(Abort.SEQUENCE)
        accepted = number == self._sequence + 1
        if accepted:
            self._sequence = number
            self._take(data[1:8], slack=6)
        if not last and number < BLOCK_SIZE:
            return []
        if last and accepted:
            self.state = SdoState.BLOCK_DOWNLOAD_END
        acknowledged, self._sequence = self._sequence, 0
        return [bytes((0xA2, acknowledged, BLOCK_SIZE, 0, 0, 0, 0, 0))]

    def _end_block_download(self, data: bytes) -> list[bytes]:
        value = self._received(unused=data[0] >> 2 & 7)
        if self._with_crc and crc_hqx(value, 0) != data[1] | data[2] << 8:
            raise SdoAbort(Abort.CRC)
        self._store(value)
        return [b"\xa1".ljust(8, b"\0")]

    # ------------------------------------------------------------------ upload

    def _upload(self, data: bytes) -> bytes:
        value = self._core.dictionary.read(*self._multiplexer)
        if 1 <= len(value) <= 4:
            return _EXPEDITED[len(value)](*self._multiplexer, value)
        self._offer(value, SdoState.UPLOAD)
        return _HEAD.pack(0x41, *self._multiplexer, len(value))

    def _block_upload(self, data: bytes) -> bytes:
        value = self._core.dictionary.read(*self._multiplexer)
        self._set_block_size(data[4])
        if 0 < len(value) <= data[5]:  # the protocol switch threshold
            return self._upload(data)
        self._offer(value, SdoState.BLOCK_UPLOAD_START)
        self._with_crc = bool(data[0] & 4)
        return _HEAD.pack(0xC6, *self._multiplexer, len(value))

    def _offer(self, value: bytes, state: SdoState) -> None:
        self._data, self._position, self._toggle, self.state = bytearray(value), 0, 0, state

    def _set_block_size(self, size: int) -> None:
        if not 1 <= size <= BLOCK_SIZE:
            raise SdoAbort(Abort.BLOCK_SIZE)
        self._block_size = size

    def _upload_segment(self, data: bytes) -> list[bytes]:
        toggle = self._toggled(data[0])
        piece = self._data[self._position : self._position + 7]
        self._position += 7
        last = self._position >= len(self._data)
        if last:
            self.state = SdoState.IDLE
        return [bytes((toggle | (7 - len(piece)) << 1 | last,)) + piece.ljust(7, b"\0")]

    def _send_block(self, data: bytes) -> list[bytes]:
        """The segments of the next block; they are sent again from the first that the client did not get."""
        self.state = SdoState.BLOCK_UPLOAD
        frames: list[bytes] = []
        position, end = self._position, len(self._data)
        while len(frames) < self._block_size and (position < end or not frames):
            piece = self._data[position : position + 7]
            position += 7
            last = 0x80 if position >= end else 0
            frames.append(bytes((last | len(frames) + 1,)) + piece.ljust(7, b"\0"))
        self._sequence = len(frames)
        return frames

    def _acknowledge_block(self, data: bytes) -> list[bytes]:
        sequence, end = data[1], len(self._data)
        if sequence > self._sequence:
            raise SdoAbort(Abort.SEQUENCE)
        self._set_block_size(data[2])
        self._position += sequence * 7
        if sequence < self._sequence or self._position < end:
            return self._send_block(data)
        self.state = SdoState.BLOCK_UPLOAD_END
        crc = crc_hqx(self._data, 0) if self._with_crc else 0
        return [struct.pack("<BH5x", 0xC1 | self._position - end << 2, crc)]

    # ------------------------------------------------------------------ end

    def _end(self, data: bytes) -> list[bytes]:
        self.state = SdoState.IDLE
        return []

    def _drop(self) -> None:
        self.state = SdoState.IDLE
        self._timer.cancel()

    def _abort(self, code: Abort) -> None:
        self._drop()
        self._send(_HEAD.pack(0x80, *self._multiplexer, code))

    def _timed_out(self, due_ns: int) -> None:
        self._abort(Abort.TIMED_OUT)
