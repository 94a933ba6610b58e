"""One SDO server on the node's dictionary: it answers expedited requests, and begins and ends the other transfers.

The table of `sdo_states` says which frame may follow which; `sdo_transfers` has the transfers of several frames.

Source: CiA 301, "SDO download", "SDO upload", "SDO block download", "SDO block upload".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from canprobe.fieldbus.node import sdo_transfers
from canprobe.fieldbus.node.core import TALKING_STATES, DelayedFrames, NodeCore, Route, Service, check_cob_id
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.node.sdo_states import SDO_TRANSITIONS, SdoRequest, SdoState, request_of
from canprobe.fieldbus.node.sdo_transfers import Transfer
from canprobe.fieldbus.protocol import sdo
from canprobe.fieldbus.protocol.frames import INVALID_FLAG, SDO_RX_BASE, SDO_TX_BASE
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

SDO_TIMEOUT_NS = 1_000_000_000
"""Time without a frame of the client after which a transfer is aborted with 05040000h."""


class SdoServer(Service):
    """The server of one channel, 1200h by default; `index` 1201h… makes an additional one.

    Attributes:
        state: state, which says for what frame of the client it waits.
    """

    states = TALKING_STATES

    def __init__(self, core: NodeCore, index: int = 0x1200) -> None:
        self._core = core
        self._index = index
        self._place: sdo.Place = (0, 0)
        self._answer_id = 0
        self._timer = core.timers.new(lambda _due_ns: self._abort(Abort.TIMED_OUT))
        self._slow_ns = core.quirks.sdo_ns
        self._late = DelayedFrames(core, self._slow_ns)
        self._transfer: Transfer | None = None
        self.state = SdoState.IDLE
        self._initiate: dict[SdoRequest, Callable[[bytes], Transfer]] = {
            SdoRequest.INITIATE_DOWNLOAD: self._download,
            SdoRequest.INITIATE_UPLOAD: self._upload,
            SdoRequest.INITIATE_BLOCK_DOWNLOAD: self._block_download,
            SdoRequest.INITIATE_BLOCK_UPLOAD: self._block_upload,
        }
        if index != 0x1200:
            core.dictionary.on_check(index, self._check_cob_id)
        core.dictionary.on_write(index, lambda _sub, _value: core.reroute())

    def reset(self, t_ns: int) -> None:
        """Drop the open transfer and the answers that wait."""
        self._drop()
        self._late.clear()

    def entered(self, t_ns: int) -> None:
        """End a transfer in the stopped state, which none survives."""
        if self._core.state not in TALKING_STATES:
            self.reset(t_ns)

    def routes(self) -> Mapping[int, Route]:
        """The request identifier."""
        cob_id, answer_id = self._cob_id(1, SDO_RX_BASE), self._cob_id(2, SDO_TX_BASE)
        self._answer_id = answer_id & 0x7FF
        return {} if (cob_id | answer_id) & INVALID_FLAG else {cob_id & 0x7FF: self._receive}

    def _cob_id(self, subindex: int, base: int) -> int:
        default = base + self._core.node_id if self._index == 0x1200 else INVALID_FLAG
        return self._core.dictionary.number(self._index, subindex, default)

    def _check_cob_id(self, subindex: int, value: Value) -> None:
        if subindex in (1, 2):
            check_cob_id(value, self._core.dictionary.number(self._index, subindex, INVALID_FLAG))

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
        if self.state is SdoState.IDLE:
            self._drop()
        else:
            self._timer.arm(t_ns + self._slow_ns + SDO_TIMEOUT_NS)  # the delay of the answer is ours

    def _answer(self, data: bytes) -> list[bytes]:
        """What is answered to a request. Raises SdoAbort when the client breaks the protocol."""
        request = request_of(self.state, data[0])
        initiate = self._initiate.get(request)
        # frames amid a transfer name no object: an abort then names that of the transfer
        if initiate is not None or (self.state is SdoState.IDLE and request is not SdoRequest.ABORT):
            self._place = sdo.place_of(data)
        if (self.state, request) not in SDO_TRANSITIONS:
            raise SdoAbort(Abort.COMMAND)
        try:
            if initiate is not None:
                self._transfer = initiate(data)
                self.state, answers = next(self._transfer)
            elif request is not SdoRequest.ABORT and self._transfer is not None:
                self.state, answers = self._transfer.send(data)
            else:
                self.state, answers = SdoState.IDLE, []
        except StopIteration as over:
            self.state, answers = SdoState.IDLE, over.value
        return answers

    def _download(self, data: bytes) -> Transfer:
        dictionary, answer = self._core.dictionary, sdo.pack_request(0x60, *self._place)
        entry = dictionary.find_writable(*self._place)
        if not data[0] & 2:
            return (yield from sdo_transfers.segmented_download(answer, entry, sdo.stated_size(data), self._store))
        dictionary.write_value(entry, entry.from_bytes(sdo.expedited_value(data, entry.bits // 8 or 4)))
        dictionary.configured(self._place[0])
        return [answer]

    def _block_download(self, data: bytes) -> Transfer:
        entry = self._core.dictionary.find_writable(*self._place)
        announced = int.from_bytes(data[4:8], "little") if data[0] & 2 else None
        answer = sdo.pack_request(0xA4, *self._place, bytes((sdo_transfers.MAX_BLOCK_SEGMENTS,)))
        with_crc = bool(data[0] & 4)
        return (yield from sdo_transfers.block_download(answer, entry, announced, self._store, with_crc=with_crc))

    def _store(self, value: bytes) -> None:
        self._core.dictionary.write(*self._place, value)
        self._core.dictionary.configured(self._place[0])

    def _upload(self, data: bytes) -> Transfer:
        value = self._core.dictionary.read(*self._place)
        if 1 <= len(value) <= 4:
            return [sdo.pack_request(0x43 | (4 - len(value)) << 2, *self._place, value)]
        answer = sdo.pack_request(0x41, *self._place, len(value).to_bytes(4, "little"))
        return (yield from sdo_transfers.segmented_upload(answer, value))

    def _block_upload(self, data: bytes) -> Transfer:
        value = self._core.dictionary.read(*self._place)
        block_size = sdo_transfers.check_block_size(data[4])
        if 0 < len(value) <= data[5]:  # the protocol switch threshold
            return (yield from self._upload(data))
        answer = sdo.pack_request(0xC6, *self._place, len(value).to_bytes(4, "little"))
        return (yield from sdo_transfers.block_upload(answer, value, block_size, with_crc=bool(data[0] & 4)))

    def _drop(self) -> None:
        self._transfer, self.state = None, SdoState.IDLE
        self._timer.cancel()

    def _abort(self, code: Abort) -> None:
        self._drop()
        self._send(sdo.pack_abort(*self._place, code))

    def _send(self, answer: bytes) -> None:
        self._late.send([(self._answer_id, answer)], self._core.now_ns)
