"""One SDO server: expedited, segmented and block transfers on the node's dictionary, by the table of `sdo_states`.

Source: CiA 301, "Service data object (SDO)", objects 1200h–127Fh.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import partial

from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.core import NO_ROUTES, NodeCore, Route
from canprobe.emulator.entries import Value
from canprobe.emulator.sdo_block import BlockDownload, BlockUpload
from canprobe.emulator.sdo_states import SDO_TRANSITIONS, SdoRequest, SdoState, request_of
from canprobe.emulator.sdo_transfers import SegmentedDownload, SegmentedUpload, Transfer
from canprobe.protocol.frames import SDO_RX_BASE, SDO_TX_BASE, NmtState, is_restricted

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
