"""SDO dialogues and waiting over a port, against canopen's own LocalNode as the server, in virtual time."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from canprobe.fieldbus import VirtualClock
from canprobe.fieldbus.bus.lss import Lss, LssAnswerError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import (
    MAX_TRANSFER_TIMEOUTS,
    MAX_UPLOAD_BYTES,
    SdoTimeoutError,
    download,
    hold_dialogues,
    read_value,
    upload,
)
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.protocol.frames import RTR_FLAG, Frame
from canprobe.fieldbus.protocol.lss import LssAddress

MS = 1_000_000
LONG = bytes(range(256)) * 3 + b"end"


def make_od() -> canopen.ObjectDictionary:
    od = canopen.ObjectDictionary()
    for index, data_type in ((0x2000, 0x07), (0x2001, 0x0F), (0x2002, 0x06)):  # UNSIGNED32, DOMAIN, UNSIGNED16
        variable = ODVariable(f"var {index:X}", index)
        variable.data_type = data_type
        variable.access_type = "rw"
        variable.default = 0 if data_type != 0x0F else b""
        od.add_object(variable)
    return od


class LocalServer(Participant):
    """A participant around canopen's LocalNode, whose own network only collects what it sends."""

    next_deadline_ns: int | None = None

    def __init__(self, node_id: int) -> None:
        self._out: list[Frame] = []
        network = canopen.Network()
        network.send_message = lambda i, data, remote=False: self._out.append((i, bytes(data)))  # type: ignore[method-assign]
        self._network = network
        self.node = network.create_node(node_id, make_od())
        self.later: list[tuple[int, Frame]] = []

    def start(self, t_ns: int) -> Sequence[Frame]:
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        self._network.notify(can_id, bytearray(data), t_ns * 1e-9)
        sent, self._out[:] = self._out.copy(), []
        return sent

    def say(self, t_ns: int, can_id: int, data: bytes) -> None:
        self.later.append((t_ns, (can_id, data)))
        self.next_deadline_ns = min(t for t, _ in self.later)

    def advance(self, t_ns: int) -> Sequence[Frame]:
        due = [frame for t, frame in self.later if t <= t_ns]
        self.later = [entry for entry in self.later if entry[0] > t_ns]
        self.next_deadline_ns = min((t for t, _ in self.later), default=None)
        return due


Cell = tuple[PumpedNetwork, LocalServer, LockstepBus]


@pytest.fixture
def cell() -> Cell:
    bus = LockstepBus(VirtualClock())
    slave = LocalServer(5)
    bus.attach(slave)
    return PumpedNetwork(bus.port()), slave, bus


def held(network: PumpedNetwork, dialogue: Generator[bytes | None, bytes, Any], node_id: int = 5, **how: Any) -> Any:
    """What a dialogue returns."""
    results: list[Any] = []

    def keep() -> Generator[bytes | None, bytes, None]:
        results.append((yield from dialogue))

    hold_dialogues(network, {node_id: keep()}, timeout_s=how.pop("timeout_s", 1.0), **how)
    return results[0]


def test_sdo_expedited_both_ways_and_segmented_upload(cell: Cell) -> None:
    network, slave, bus = cell
    held(network, download(0x2000, 0, 0xDEADBEEF.to_bytes(4, "little")))
    assert slave.node.sdo[0x2000].raw == 0xDEADBEEF
    assert held(network, read_value(make_od()[0x2000])) == 0xDEADBEEF
    held(network, download(0x2002, 0, b"\x34\x12"))
    assert held(network, upload(0x2002, 0)) == b"\x34\x12"
    slave.node.sdo.download(0x2001, 0, LONG)
    assert held(network, upload(0x2001, 0)) == LONG
    assert bus.clock.now_ns() == 0, "answers come at the same instant"


def test_sdo_writes_of_more_than_four_bytes_are_refused(cell: Cell) -> None:
    with pytest.raises(SdoCommunicationError, match="2001h:00 takes 5 bytes"):
        held(cell[0], download(0x2001, 0, b"12345"))


def test_sdo_abort_and_time_out_run_in_virtual_time(cell: Cell) -> None:
    network, _, bus = cell
    with pytest.raises(SdoAbortedError) as caught:
        held(network, upload(0x5FFF, 0))
    assert caught.value.code == 0x06020000
    with pytest.raises(SdoTimeoutError, match=r"No SDO response received within 60 s, 2 times"):
        held(network, upload(0x2000, 0), 6, timeout_s=60.0, retries=1)
    assert bus.clock.now_ns() == 120 * 10**9


def test_nodes_are_served_side_by_side_and_requests_sent_again_are_counted(cell: Cell) -> None:
    network, slave, bus = cell
    slave.say(300 * MS, 0x586, b"\x43\x00\x20\x00\x78\x56\x34\x12")
    read: dict[int, bytes] = {}

    def keep(node_id: int) -> Generator[bytes | None, bytes, None]:
        read[node_id] = yield from upload(0x2000, 0)

    assert hold_dialogues(network, {6: keep(6), 5: keep(5)}, timeout_s=0.2, retries=2) == {6: 1, 5: 0}
    assert (list(read), read[6]) == ([5, 6], b"\x78\x56\x34\x12")
    assert bus.clock.now_ns() == 300 * MS


class Segments(LocalServer):
    """Answers a read of 1008h:00 with given segments, the last of them again and again, each after a delay."""

    def __init__(self, announced: int | None, *segments: str, delay_ns: int = 0) -> None:
        super().__init__(5)
        size = (announced or 0).to_bytes(4, "little")
        self.head = bytes((0x40 if announced is None else 0x41, 0x08, 0x10, 0x00)) + size
        self.segments, self.delay_ns = list(segments), delay_ns
        self.asked = 0
        self.aborts: list[tuple[str, int]] = []

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        if data[0] == 0x80:
            self.aborts.append((data[1:4].hex(), int.from_bytes(data[4:], "little")))
            return ()
        if data[0] == 0x40:
            self.asked = 0
            return [(0x585, self.head)]
        segment = bytes.fromhex(self.segments[min(self.asked, len(self.segments) - 1)])
        self.asked += 1
        answer = (0x585, (bytes((segment[0] | data[0] & 0x10,)) + segment[1:]).ljust(8, b"\0"))
        if not self.delay_ns:
            return [answer]
        self.say(t_ns + self.delay_ns, *answer)
        return ()


FULL, EMPTY = "00" + b"abcdefg".hex(), "0e"


@pytest.mark.parametrize(
    ("server", "code", "why"),
    [
        (Segments(20, FULL), 0x06070012, "20 bytes announced, more sent"),
        (Segments(20, FULL, "0b6162"), 0x06070013, "20 bytes announced, 9 sent"),
        (Segments(9, FULL, "01" + b"abcdefg".hex()), 0x06070012, "9 bytes announced, more sent"),
        (Segments(0, "0d61"), 0x06070012, "0 bytes announced, more sent"),
        (Segments(None, FULL), 0x05040005, f"no end after {MAX_UPLOAD_BYTES} bytes"),
        (Segments(0xFFFFFFFF, FULL), 0x05040005, f"announced, {MAX_UPLOAD_BYTES} at most"),
        (Segments(None, EMPTY), 0x08000000, "a segment without a byte that is not the last"),
        (Segments(20, FULL, EMPTY), 0x08000000, "a segment without a byte that is not the last"),
        (Segments(14, "10" + b"abcdefg".hex()), 0x05030000, "Toggle bit mismatch"),
    ],
)
def test_a_transfer_that_is_not_as_announced_is_one_failed_read_with_an_abort(
    server: Segments, code: int, why: str
) -> None:
    """CiA 301, SDO abort codes: too long, too short, out of memory, general error, toggle bit not alternated."""
    bus = LockstepBus(VirtualClock())
    bus.attach(server)
    network = PumpedNetwork(bus.port())
    with pytest.raises(SdoCommunicationError, match=why):
        held(network, upload(0x1008, 0))
    assert server.aborts == [("081000", code)]
    assert server.asked <= MAX_UPLOAD_BYTES // 7 + 1
    server.head, server.segments = b"\x41\x08\x10\x00\x07\0\0\0", ["01" + b"abcdefg".hex()]
    assert held(network, upload(0x1008, 0)) == b"abcdefg", "the next read is as if nothing had been"


@pytest.mark.parametrize(
    ("announced", "segments", "data"),
    [
        (600, [FULL] * 85 + ["05" + b"abcde".hex()], b"abcdefg" * 85 + b"abcde"),
        (None, [FULL] * 85 + ["05" + b"abcde".hex()], b"abcdefg" * 85 + b"abcde"),
        (14, [FULL, FULL, "0f"], b"abcdefg" * 2),
        (0, ["0f"], b""),
    ],
)
def test_a_size_that_is_announced_and_delivered_is_taken(
    announced: int | None, segments: list[str], data: bytes
) -> None:
    bus = LockstepBus(VirtualClock())
    bus.attach(server := Segments(announced, *segments))
    assert (held(PumpedNetwork(bus.port()), upload(0x1008, 0)), server.aborts) == (data, [])


def test_a_transfer_that_creeps_ends_with_one_failed_read() -> None:
    """Each segment comes in time, and there is no end of them."""
    bus, server = LockstepBus(VirtualClock()), Segments(None, "0c61", delay_ns=400 * MS)
    bus.attach(server)
    with pytest.raises(SdoTimeoutError, match="SDO transfer not complete after 5 s"):
        held(PumpedNetwork(bus.port()), upload(0x1008, 0), timeout_s=0.5, retries=2)
    assert bus.clock.now_ns() == 500 * MS * MAX_TRANSFER_TIMEOUTS
    assert server.aborts == [("081000", 0x05040000)]


@pytest.mark.parametrize("stale", [b"\x43\x18\x10\x01\x01\0\0\0", b"\x60\x00\x20\x00\0\0\0\0", b"\x43\x00\x20"])
def test_an_answer_to_something_else_is_passed_over(cell: Cell, stale: bytes) -> None:
    network, slave, _ = cell
    slave.say(50 * MS, 0x586, stale)
    slave.say(100 * MS, 0x586, b"\x43\x00\x20\x00\x78\x56\x34\x12")
    assert held(network, read_value(make_od()[0x2000]), 6) == 0x12345678


def test_foreign_frames_of_a_wait_go_to_the_callback(cell: Cell) -> None:
    _, slave, bus = cell
    others: list[tuple[int, bytes, int]] = []
    mine: list[tuple[int, bytes, int]] = []
    network = PumpedNetwork(bus.port(), other=lambda *frame: others.append(frame))
    network.subscribe(0x705, lambda *frame: mine.append(frame))
    slave.say(1 * MS, 0x185, b"pdo")
    slave.say(2 * MS, 0x705 | RTR_FLAG, b"")
    slave.say(3 * MS, 0x705, b"\x05")
    assert network.pump_until(lambda: bool(mine), 1.0)
    assert mine == [(0x705, b"\x05", 3 * MS)]
    assert others == [(0x185, b"pdo", 1 * MS), (0x705 | RTR_FLAG, b"", 2 * MS)]


def test_feed_gives_frames_that_the_cycle_drained_to_all_subscribers(cell: Cell) -> None:
    network, _, _ = cell
    taken: list[int] = []

    def take(can_id: int, _data: bytes, t_ns: int) -> None:
        taken.append(t_ns)

    network.subscribe(0x705, take)
    network.subscribe(0x705, take)
    network.feed([(0x705, b"\x04", 5), (0x185, b"pdo", 6)])
    network.unsubscribe(0x705, take)
    network.feed([(0x705, b"\x04", 7)])
    network.unsubscribe(0x705, take)
    network.feed([(0x705, b"\x04", 8)])
    assert taken == [5, 5, 7]


class Scripted(LocalServer):
    """An LSS slave that answers a request with given bytes, or not at all."""

    def __init__(self, **answers: str) -> None:
        super().__init__(5)
        self.heard: list[str] = []
        self.answers = answers

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        assert can_id == 0x7E5 and len(data) == 8
        self.heard.append(data.hex().rstrip("0"))
        answer = self.answers.get(f"_{data[0]:02x}")
        return [(0x7E4, bytes.fromhex(answer).ljust(8, b"\0"))] if answer else ()


def test_lss_messages_are_those_of_cia_305() -> None:
    """CiA 305, LSS protocol specification: command specifiers, numbers little-endian, unused bytes 0."""
    bus, slave = LockstepBus(VirtualClock()), Scripted(_43="44", _11="1100", _17="1701", _5e="5e09")
    bus.attach(slave)
    lss = Lss(PumpedNetwork(bus.port()))
    lss.release()
    assert lss.select(LssAddress(0xCA5E, 0x260, 0x10000, 7))
    lss.configure_node_id(9)
    assert lss.store() is False, "error 1: storing is not supported"
    assert lss.inquire_node_ids() == [9]
    assert slave.heard == ["04", "405eca", "416002", "42000001", "4307", "1109", "17", "5e"]
    slave.answers = {"_11": "1101", "_17": "1702", "_43": "51"}
    assert not lss.select(LssAddress(0xCA5E, 0x260, 0x10000, 8)), "an answer to something else"
    with pytest.raises(LssAnswerError, match="LSS error 1"):
        lss.configure_node_id(200)
    with pytest.raises(LssAnswerError, match="could not store it: LSS error 2"):
        lss.store()
    slave.answers = {}
    with pytest.raises(LssAnswerError, match="no answer to configure node id"):
        lss.configure_node_id(9)
