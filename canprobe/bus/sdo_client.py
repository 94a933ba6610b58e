"""SDO transfers to many nodes at once: each node's accesses one after another, those of different nodes side by side.

A *dialogue* is a generator: it yields the 8 bytes of a request, or None to wait on, and is sent the 8 bytes of each
answer. `upload` and `download` are parts of such dialogues (`yield from`). What a node needs is written as a plain
sequence, and the waiting is done for all of them together.

Source: CiA 301, SDO protocols (expedited download, expedited and segmented upload, abort).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from typing import Any

from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import SIGNED_TYPES
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.bus.network import PumpedNetwork
from canprobe.protocol.frames import SDO_RX_BASE, SDO_TX_BASE

Dialogue = Generator[bytes | None, bytes, Any]
"""What is said to one node."""

_LENGTH = 8
_ABORT, _DOWNLOADED, _UPLOADED, _SEGMENT, _EXPEDITED, _SIZED = 0x80, 0x60, 0x40, 0x00, 0x02, 0x01
_MOST_EXPEDITED = 4
_TIMED_OUT = 0x05040000
ROUND_S = 0.02
"""So long the others wait for the slowest answer: asked at once again they would take the bus from higher node ids."""


class SdoTimeoutError(SdoCommunicationError):
    """A request got no answer in time, however often it was sent."""


def download(index: int, subindex: int, data: bytes) -> Generator[bytes | None, bytes, None]:
    """Write up to four bytes.

    Raises:
        SdoAbortedError: the node refused.
        SdoCommunicationError: no answer, or more than four bytes.
    """
    if not 0 < len(data) <= _MOST_EXPEDITED:
        raise SdoCommunicationError(f"{index:04X}h:{subindex:02X} takes {len(data)} bytes; a concise write has 1 to 4")
    command = 0x23 | (_MOST_EXPEDITED - len(data)) << 2
    yield from _answered(bytes((command,)), index, subindex, data.ljust(4, b"\0"), _DOWNLOADED)


def read_value(variable: ODVariable) -> Generator[bytes | None, bytes, Any]:
    """Read an entry by its data type, in the entry's own length whatever the length of the answer.

    Many nodes answer with four bytes where the entry has one or two. What is beyond its own must then be padding.

    Raises:
        SdoAbortedError: the node refused.
        SdoCommunicationError: no answer, or one that does not fit the entry.
    """
    size = len(variable) // 8
    data = yield from upload(variable.index, variable.subindex, size)
    own, beyond = data[:size], data[size:]
    negative = variable.data_type in SIGNED_TYPES and own[-1:] >= b"\x80"
    if len(own) < size or (any(beyond) and not (negative and min(beyond) == 0xFF)):
        got = f"{len(data)}: {data.hex(' ')}" if data else "none"
        raise SdoCommunicationError(f"expected {size} byte{'s' * (size > 1)}, got {got}")
    return variable.decode_raw(own)


def upload(index: int, subindex: int, size: int = _MOST_EXPEDITED) -> Generator[bytes | None, bytes, bytes]:
    """Read an entry of any length.

    Args:
        index, subindex: of the entry.
        size: bytes that are taken of an expedited answer that does not tell how many of its four are the value.

    Raises:
        SdoAbortedError: the node refused.
        SdoCommunicationError: no answer, or one segment twice.
    """
    answer = yield from _answered(b"\x40", index, subindex, bytes(4), _UPLOADED)
    if answer[0] & _EXPEDITED:
        return answer[4 : 8 - (answer[0] >> 2 & 3)] if answer[0] & _SIZED else answer[4 : 4 + size]
    return (yield from _segments())


def _answered(
    command: bytes, index: int, subindex: int, data: bytes, expected: int
) -> Generator[bytes | None, bytes, bytes]:
    multiplexer = index.to_bytes(2, "little") + bytes((subindex,))
    answer = yield command + multiplexer + data
    while answer[1:4] != multiplexer or not (answer[0] == _ABORT or answer[0] & 0xE0 == expected):
        answer = yield None  # a late one, to an earlier request: of this entry too, which is read after it was written
    _check_abort(answer)
    return answer


def _segments() -> Generator[bytes | None, bytes, bytes]:
    data, toggle, last = b"", 0, False
    while not last:
        answer = yield bytes((0x60 | toggle,)) + bytes(7)
        while not (answer[0] == _ABORT or answer[0] & 0xE0 == _SEGMENT):  # a late one, to the request that began this
            answer = yield None
        _check_abort(answer)
        if answer[0] & 0xF0 != toggle:
            raise SdoCommunicationError("Toggle bit mismatch")
        data += answer[1 : 8 - (answer[0] >> 1 & 7)]
        toggle ^= 0x10
        last = bool(answer[0] & 1)
    return data


def _check_abort(answer: bytes) -> None:
    if answer[0] == _ABORT:
        raise SdoAbortedError(int.from_bytes(answer[4:], "little"))


class _Talk:
    """One dialogue under way."""

    def __init__(self, node_id: int, dialogue: Dialogue) -> None:
        self.node_id = node_id
        self.dialogue = dialogue
        self.request = b""
        self.tries = 0
        self.due_ns = 0
        self.inbox: list[bytes] = []
        self.over = False


def hold_dialogues(
    network: PumpedNetwork, dialogues: Mapping[int, Dialogue], *, timeout_s: float, retries: int = 0
) -> dict[int, int]:
    """Carry out dialogues with several nodes at once, on the predefined SDO channel.

    Args:
        network: pumped meanwhile.
        dialogues: by node id; each must catch what it can live with, an exception of it ends them all.
        timeout_s: for an answer.
        retries: how often a request without an answer is sent again.

    Returns:
        Requests that were sent again, by node id.
    """
    talks = [_Talk(node_id, dialogue) for node_id, dialogue in dialogues.items()]
    repeated = dict.fromkeys(dialogues, 0)
    subscriptions = [(SDO_TX_BASE + talk.node_id, _taker(talk)) for talk in talks]
    for can_id, taker in subscriptions:
        network.subscribe(can_id, taker)
    try:
        timeout_ns = round(timeout_s * 1e9)
        for talk in talks:
            _go_on(network, talk, None, timeout_ns)
        while waiting := [talk for talk in talks if not talk.over]:
            due_ns = min(talk.due_ns for talk in waiting)
            left_s = max(0, due_ns - network.port.clock.now_ns()) * 1e-9
            network.pump_until(_all_answered(waiting), min(left_s, ROUND_S))
            for talk in waiting:
                _serve(network, talk, timeout_ns, retries, repeated)
    finally:
        for can_id, taker in subscriptions:
            network.unsubscribe(can_id, taker)
    return repeated


def _all_answered(talks: list[_Talk]) -> Callable[[], bool]:
    return lambda: all(talk.inbox for talk in talks)


def _taker(talk: _Talk) -> Any:
    def take(can_id: int, data: bytearray, t_s: float) -> None:
        if len(data) == _LENGTH and not talk.over:
            talk.inbox.append(bytes(data))

    return take


def _serve(network: PumpedNetwork, talk: _Talk, timeout_ns: int, retries: int, repeated: dict[int, int]) -> None:
    while talk.inbox and not talk.over:
        _go_on(network, talk, talk.inbox.pop(0), timeout_ns)
    now_ns = network.port.clock.now_ns()
    if talk.over or talk.due_ns > now_ns:
        return
    multiplexer = talk.request[1:4]
    network.send_message(SDO_RX_BASE + talk.node_id, bytes((_ABORT,)) + multiplexer + _TIMED_OUT.to_bytes(4, "little"))
    if talk.tries <= retries and talk.request[0] >> 5 != 3:  # a segment cannot be asked for twice
        repeated[talk.node_id] += 1
        _send(network, talk, timeout_ns)
    else:
        tries = f", {talk.tries} times" if talk.tries > 1 else ""
        late = SdoTimeoutError(f"No SDO response received within {timeout_ns * 1e-9:g} s{tries}")
        _throw(network, talk, late, timeout_ns)


def _go_on(network: PumpedNetwork, talk: _Talk, answer: bytes | None, timeout_ns: int) -> None:
    try:
        request = next(talk.dialogue) if answer is None else talk.dialogue.send(answer)
    except StopIteration:
        talk.over = True
        return
    _take_request(network, talk, request, timeout_ns)


def _throw(network: PumpedNetwork, talk: _Talk, error: Exception, timeout_ns: int) -> None:
    try:
        request = talk.dialogue.throw(error)
    except StopIteration:
        talk.over = True
        return
    _take_request(network, talk, request, timeout_ns)


def _take_request(network: PumpedNetwork, talk: _Talk, request: bytes | None, timeout_ns: int) -> None:
    if request is not None:
        talk.request, talk.tries = request, 0
        talk.inbox.clear()
        _send(network, talk, timeout_ns)


def _send(network: PumpedNetwork, talk: _Talk, timeout_ns: int) -> None:
    talk.tries += 1
    talk.due_ns = network.port.clock.now_ns() + timeout_ns
    network.send_message(SDO_RX_BASE + talk.node_id, talk.request)
