"""The default SDO channel of a node, followed from outside: which transfer is open, and what it carried.

Values of at most eight bytes are kept; of longer ones, and of block transfers, only beginning and end are known.
Source: CiA 301, SDO protocols.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from canprobe.fieldbus.protocol import sdo
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import AbortSeen, AnswerSeen, BusEvent, RequestSeen
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_DOWNLOAD, _UPLOAD, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD = 1, 2, 5, 6
"""Client command specifiers that open a transfer; 0 and 3 are its segments."""
_BLOCK_END = 0xA1


@dataclass(slots=True)
class _Transfer:
    request: BusFrame
    writes: bool
    place: sdo.Place
    data: bytes = b""
    answered: bool = False
    segmented: bool = False
    block: bool = False
    last: bool = False


class SdoChannel:
    """Follows the frames 600h + id and 580h + id of one node."""

    def __init__(self, node: SeenNode) -> None:
        self._node = node
        self._open: _Transfer | None = None
        self._aborted: _Transfer | None = None

    def reset(self) -> None:
        """Forget the open transfer: the node has booted."""
        self._open = self._aborted = None

    def from_client(self, frame: BusFrame) -> Iterator[BusEvent]:
        """Take a frame of the client."""
        data, one = frame.data, self._open
        if len(data) < 1:
            return
        command = data[0] >> 5
        place = sdo.place_of(data)
        if data[0] == sdo.ABORT:
            self._open, self._aborted = None, one or self._aborted
            writes, of, request = (one.writes, one.place, one.request) if one is not None else (False, None, None)
            yield AbortSeen(frame, self._node, writes, of, place, sdo.abort_code(data), True, request)
        # its frames are segments now, whose first byte is a number and looks like any command
        elif one is not None and one.block and one.answered:
            if not one.writes and data[0] == _BLOCK_END:
                yield from self._end(frame)
        elif command in (_DOWNLOAD, _UPLOAD, _BLOCK_UPLOAD, _BLOCK_DOWNLOAD):
            if command == _BLOCK_UPLOAD and data[0] & 3:  # the later frames of a block upload
                return
            pending = one.request if one is not None else None
            writes = command in (_DOWNLOAD, _BLOCK_DOWNLOAD)
            self._open = made = _Transfer(frame, writes, place, block=command in (_BLOCK_UPLOAD, _BLOCK_DOWNLOAD))
            made.data = _expedited(data) if command == _DOWNLOAD else b""
            made.segmented = command == _DOWNLOAD and not data[0] & 2
            value = self._node.value_of(place, made.data) if writes and not made.segmented else None
            yield RequestSeen(frame, self._node, writes, place, value, pending)
        elif command == 0 and one is not None and one.writes and one.segmented:
            one.data += sdo.segment_value(data)
            one.last = bool(data[0] & 1)

    def from_server(self, frame: BusFrame) -> Iterator[BusEvent]:
        """Take a frame of the server."""
        data, one = frame.data, self._open
        if len(data) < 1:
            return
        command = data[0] >> 5
        if one is None:
            late = self._aborted  # a transfer that the client has given up
            if late is not None and command in (2, 3) and sdo.place_of(data) == late.place:
                self._aborted = None
                yield AnswerSeen(frame, self._node, late.writes, late.place, None, late.request, late=True)
        elif data[0] == sdo.ABORT:
            self._open = None
            code = sdo.abort_code(data)
            yield AbortSeen(frame, self._node, one.writes, one.place, sdo.place_of(data), code, False, one.request)
        elif _ends(one, data, command):
            yield from self._end(frame)

    def _end(self, frame: BusFrame) -> Iterator[BusEvent]:
        one, self._open = self._open, None
        assert one is not None
        value = self._node.value_of(one.place, one.data)
        yield AnswerSeen(frame, self._node, one.writes, one.place, value, one.request)


def _ends(one: _Transfer, data: bytes, command: int) -> bool:
    """Take an answer; whether it is the last of its transfer."""
    if one.block:
        one.answered = True
        return one.writes and data[0] == _BLOCK_END
    if one.writes:
        initiated = command == 3 and sdo.place_of(data) == one.place
        return not one.segmented if initiated else command == 1 and one.segmented and one.last
    if command == 2 and sdo.place_of(data) == one.place:
        one.segmented = not data[0] & 2
        one.data = _expedited(data)
        return not one.segmented
    if command == 0 and one.segmented:
        one.data += sdo.segment_value(data)
        return bool(data[0] & 1)
    return False


def _expedited(data: bytes) -> bytes:
    """Bytes of an expedited transfer."""
    return sdo.expedited_value(data) if data[0] & 2 else b""
