"""SDO transfers to many nodes at once, over any `Port`, without threads.

A *dialogue* is a generator. It yields the 8 bytes of a request, or None to wait further, and gets the 8 bytes of each
answer; an abort that it yields is sent and not answered. `upload` and `download` are parts of dialogues (`yield from`).
So the accesses to a node are written as a plain sequence, and `hold_dialogues` waits for all nodes together: the
accesses to one node come one after another, those to different nodes side by side. The client of canopen is not used,
because it waits for a thread and for one node at a time. `pumped` reads the port meanwhile.

Source: CiA 301, SDO protocols (expedited download, expedited and segmented upload, abort).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from typing import Any, NoReturn

from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import SIGNED_TYPES
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol import sdo
from canprobe.fieldbus.protocol.frames import SDO_RX_BASE, SDO_TX_BASE

Dialogue = Generator[bytes | None, bytes, Any]
"""The transfers with one node."""

_SDO_BYTES = 8
_DOWNLOAD_ANSWER, _UPLOAD_ANSWER, _SEGMENT_ANSWER = 0x60, 0x40, 0x00
_EXPEDITED_FLAG = 0x02
MAX_UPLOAD_BYTES = 4096
"""Longest value that is read; names and numbers are far shorter. The transfer of a longer one is aborted."""
MAX_TRANSFER_TIMEOUTS = 10
"""Longest time of one transfer of several segments, in time-outs of one answer."""
MAX_ROUND_S = 0.02
"""Longest time that the others wait for the slowest answer; else requests to low node ids would fill the bus."""


class SdoTimeoutError(SdoCommunicationError):
    """A request got no answer in time, however often it was sent."""


def download(index: int, subindex: int, data: bytes) -> Generator[bytes | None, bytes, None]:
    """Write up to four bytes.

    Raises:
        SdoAbortedError: the node refused.
        SdoCommunicationError: no answer came, or there are not one to four bytes.
    """
    if not 0 < len(data) <= sdo.MAX_EXPEDITED_BYTES:
        place = sdo.place_text(index, subindex)
        raise SdoCommunicationError(f"{place} takes {len(data)} bytes; a concise write has 1 to 4")
    yield from _answered(sdo.pack_write(index, subindex, data), _DOWNLOAD_ANSWER)


def read_value(variable: ODVariable) -> Generator[bytes | None, bytes, Any]:
    """Read an entry by its data type, in the length of the entry, whatever the length of the answer.

    Many nodes answer with four bytes where the entry has one or two. The bytes beyond its length must be padding.

    Raises:
        SdoAbortedError: the node refused.
        SdoCommunicationError: no answer came, or one that does not fit the entry.
    """
    size = len(variable) // 8
    data = yield from upload(variable.index, variable.subindex, size)
    own, beyond = data[:size], data[size:]
    negative = variable.data_type in SIGNED_TYPES and own[-1:] >= b"\x80"
    if len(own) < size or (any(beyond) and not (negative and min(beyond) == 0xFF)):
        got = f"{len(data)}: {data.hex(' ')}" if data else "none"
        raise SdoCommunicationError(f"expected {size} byte{'s' * (size > 1)}, got {got}")
    return variable.decode_raw(own)


def upload(index: int, subindex: int, size: int = sdo.MAX_EXPEDITED_BYTES) -> Generator[bytes | None, bytes, bytes]:
    """Read an entry of any length.

    Args:
        index, subindex: place of the entry.
        size: number of bytes to take of an expedited answer that does not state how many of its four it uses.

    Raises:
        SdoAbortedError: the node refused.
        SdoCommunicationError: no answer came, one segment came twice, or the node sent more or fewer bytes than it
            announced, or more than `MAX_UPLOAD_BYTES`. The node gets an abort.
    """
    answer = yield from _answered(sdo.pack_read(index, subindex), _UPLOAD_ANSWER)
    if answer[0] & _EXPEDITED_FLAG:
        return sdo.expedited_value(answer, size)
    return (yield from _segments((index, subindex), sdo.stated_size(answer)))


def decode_text(data: bytes) -> str:
    """A VISIBLE_STRING as devices send it: UTF-8 or else Latin-1, up to the first zero byte."""
    text = data.partition(b"\0")[0]
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def _answered(request: bytes, expected: int) -> Generator[bytes | None, bytes, bytes]:
    answer = yield request
    while answer[1:4] != request[1:4] or not (answer[0] == sdo.ABORT or answer[0] & 0xE0 == expected):
        answer = yield None  # a late one, to an earlier request, maybe of the same entry
    _check_abort(answer)
    return answer


def _segments(place: sdo.Place, announced: int | None) -> Generator[bytes | None, bytes, bytes]:
    if announced is not None and announced > MAX_UPLOAD_BYTES:
        yield from _give_up(place, sdo.Abort.MEMORY, f"{announced} bytes announced, {MAX_UPLOAD_BYTES} at most")
    data, toggle, last = b"", 0, False
    while not last:
        answer = yield bytes((0x60 | toggle,)) + bytes(7)
        while answer[0] != sdo.ABORT and answer[0] & 0xE0 != _SEGMENT_ANSWER:
            answer = yield None  # a late one, to the request that began this transfer
        _check_abort(answer)
        if answer[0] & 0xF0 != toggle:
            yield from _give_up(place, sdo.Abort.TOGGLE, "Toggle bit mismatch")
        piece = sdo.segment_value(answer)
        data += piece
        toggle ^= 0x10
        last = bool(answer[0] & 1)
        if announced is not None and len(data) > announced:
            yield from _give_up(place, sdo.Abort.TOO_LONG, f"{announced} bytes announced, more sent")
        if len(data) > MAX_UPLOAD_BYTES:
            yield from _give_up(place, sdo.Abort.MEMORY, f"no end after {MAX_UPLOAD_BYTES} bytes")
        if not piece and not last:
            yield from _give_up(place, sdo.Abort.GENERAL, "a segment without a byte that is not the last")
    if announced is not None and len(data) < announced:
        yield from _give_up(place, sdo.Abort.TOO_SHORT, f"{announced} bytes announced, {len(data)} sent")
    return data


def _give_up(place: sdo.Place, code: int, why: str) -> Generator[bytes | None, bytes, NoReturn]:
    """Abort the transfer of the node, and raise SdoCommunicationError."""
    yield sdo.pack_abort(*place, code)
    raise SdoCommunicationError(f"transfer aborted: {why}")


def _check_abort(answer: bytes) -> None:
    if answer[0] == sdo.ABORT:
        raise SdoAbortedError(sdo.abort_code(answer))


class _Talk:
    """One dialogue that is under way."""

    def __init__(self, network: PumpedNetwork, node_id: int, dialogue: Dialogue, timeout_ns: int, retries: int) -> None:
        self.node_id = node_id
        self.inbox: list[bytes] = []
        self.over = False
        self.due_ns = 0
        self.repeated = 0
        self._network = network
        self._dialogue = dialogue
        self._timeout_ns = timeout_ns
        self._retries = retries
        self._request = b""
        self._place = 0, 0  # that of the transfer: a request for a segment has none
        self._end_ns = 0  # latest end of the transfer
        self._tries = 0
        self._go_on(lambda: next(dialogue))

    def take(self, _id: int, data: bytes, _t_ns: int) -> None:
        """Keep an answer; a frame of another length than 8 bytes is no SDO (CiA 301, 7.2.4.3)."""
        if len(data) == _SDO_BYTES and not self.over:
            self.inbox.append(data)

    def serve(self) -> None:
        """Give the dialogue its answers; where none came in time, ask again or give up."""
        while self.inbox and not self.over:
            answer = self.inbox.pop(0)
            self._go_on(lambda answer=answer: self._dialogue.send(answer))  # type: ignore[misc]
        if self.over or self.due_ns > self._network.port.clock.now_ns():
            return
        self._transmit(sdo.pack_abort(*self._place, sdo.Abort.TIMED_OUT))
        if self._tries <= self._retries and not self._asks_for_segment:  # which cannot be asked for twice
            self.repeated += 1
            self._ask()
        else:
            late = SdoTimeoutError(self._lateness())
            self._go_on(lambda: self._dialogue.throw(late))

    @property
    def _asks_for_segment(self) -> bool:
        return self._request[0] >> 5 == 3

    def _lateness(self) -> str:
        timeout_s = self._timeout_ns * 1e-9
        if self._asks_for_segment and self._network.port.clock.now_ns() >= self._end_ns:
            return f"SDO transfer not complete after {MAX_TRANSFER_TIMEOUTS * timeout_s:g} s"
        tries = f", {self._tries} times" if self._tries > 1 else ""
        return f"No SDO response received within {timeout_s:g} s{tries}"

    def _go_on(self, step: Callable[[], bytes | None]) -> None:
        try:
            request = step()
            while request is not None and request[0] == sdo.ABORT:
                self._transmit(request)
                request = next(self._dialogue)
        except StopIteration:
            self.over = True
            return
        if request is not None:
            self._request, self._tries = request, 0
            self.inbox.clear()
            self._ask()

    def _ask(self) -> None:
        self._tries += 1
        self.due_ns = self._network.port.clock.now_ns() + self._timeout_ns
        if self._asks_for_segment:
            self.due_ns = min(self.due_ns, self._end_ns)
        else:
            self._place = sdo.place_of(self._request)
            self._end_ns = self.due_ns + (MAX_TRANSFER_TIMEOUTS - 1) * self._timeout_ns
        self._transmit(self._request)

    def _transmit(self, data: bytes) -> None:
        self._network.send_message(SDO_RX_BASE + self.node_id, data)


class Dialogues:
    """Dialogues with several nodes at once, for a caller that receives the frames itself: see `hold_dialogues`.

    A context manager: the first requests go out on entering.

    Args:
        network: network, which the caller pumps or feeds.
        dialogues: dialogues by node id; an error that one does not catch itself ends them all.
        timeout_s: time-out of an answer.
        retries: number of times that a request without an answer is sent again.
    """

    def __init__(
        self, network: PumpedNetwork, dialogues: Mapping[int, Dialogue], *, timeout_s: float, retries: int = 0
    ) -> None:
        self._network = network
        self._dialogues = dialogues
        self._settings = round(timeout_s * 1e9), retries
        self._talks: list[_Talk] = []

    def __enter__(self) -> Dialogues:
        try:
            for node_id, dialogue in self._dialogues.items():
                self._talks.append(_Talk(self._network, node_id, dialogue, *self._settings))
                self._network.subscribe(SDO_TX_BASE + node_id, self._talks[-1].take)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for talk in self._talks:
            self._network.unsubscribe(SDO_TX_BASE + talk.node_id, talk.take)

    @property
    def waiting(self) -> list[_Talk]:
        """Dialogues that are not over."""
        return [talk for talk in self._talks if not talk.over]

    def serve(self) -> None:
        """Give each dialogue the answers that have come; where none came in time, ask again or give up."""
        for talk in self.waiting:
            talk.serve()

    @property
    def repeated(self) -> dict[int, int]:
        """Number of requests that were sent again, by node id."""
        return {talk.node_id: talk.repeated for talk in self._talks}


def hold_dialogues(
    network: PumpedNetwork, dialogues: Mapping[int, Dialogue], *, timeout_s: float, retries: int = 0
) -> dict[int, int]:
    """Carry out dialogues with several nodes at once, on the predefined SDO channel.

    Args:
        network: network, which is pumped meanwhile.
        dialogues: dialogues by node id; an error that one does not catch itself ends them all.
        timeout_s: time-out of an answer.
        retries: number of times that a request without an answer is sent again.

    Returns:
        The number of requests that were sent again, by node id.
    """
    with Dialogues(network, dialogues, timeout_s=timeout_s, retries=retries) as held:
        while waiting := held.waiting:
            left_s = max(0, min(talk.due_ns for talk in waiting) - network.port.clock.now_ns()) * 1e-9
            network.pump_until(lambda: all(talk.inbox for talk in waiting), min(left_s, MAX_ROUND_S))
            held.serve()
    return held.repeated
