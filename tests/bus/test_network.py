"""canopen's Network pumped by whoever waits, against canopen's own LocalNode as the server, in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.sdo import SdoAbortedError, SdoCommunicationError

from canprobe.bus.lockstep import LockstepBus
from canprobe.bus.network import PumpedNetwork
from canprobe.bus.port import VirtualClock
from canprobe.errors import UsageError
from canprobe.protocol.frames import RTR_FLAG, Frame

MS = 1_000_000
LONG = bytes(range(256)) * 3 + b"end"


def make_od() -> canopen.ObjectDictionary:
    od = canopen.ObjectDictionary()
    for index, data_type in ((0x2000, 0x07), (0x2001, 0x0F), (0x1017, 0x06)):  # UNSIGNED32, DOMAIN, UNSIGNED16
        variable = ODVariable(f"var {index:X}", index)
        variable.data_type = data_type
        variable.access_type = "rw"
        variable.default = 0 if data_type != 0x0F else b""
        od.add_object(variable)
    return od


class LocalServer:
    """A participant around canopen's LocalNode, whose own network only collects what it sends."""

    def __init__(self, node_id: int) -> None:
        self._out: list[Frame] = []
        network = canopen.Network()
        network.send_message = lambda i, data, remote=False: self._out.append((i, bytes(data)))  # type: ignore[method-assign]
        self._network = network
        self.node = network.create_node(node_id, make_od())
        self.next_deadline_ns: int | None = None
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


class BlockServer(LocalServer):
    """Answers one block upload or download of LONG by the book (CiA 301, 7.2.4.3.9 to 7.2.4.3.14), without CRC."""

    def __init__(self, node_id: int) -> None:
        super().__init__(node_id)
        self.received = bytearray()
        self._chunks = [LONG[k : k + 7].ljust(7, b"\0") for k in range(0, len(LONG), 7)]
        self._first = 0
        self._downloading = 0

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        if can_id != 0x605:
            return ()
        return [(0x585, bytes(answer)) for answer in self._answer(data)]

    def _answer(self, data: bytes) -> Sequence[bytes]:
        if self._downloading:
            return self._take(data)
        command = data[0]
        if command & 0xE3 == 0xA0:  # initiate upload
            return [b"\xc2" + data[1:4] + len(LONG).to_bytes(4, "little")]
        if command & 0xE3 == 0xA3:  # start upload
            return self._send()
        if command & 0xE3 == 0xA2:  # block acknowledged
            self._first += data[1]
            spare = (-len(LONG)) % 7
            return self._send() if self._first < len(self._chunks) else [bytes([0xC1 | spare << 2]).ljust(8, b"\0")]
        if command & 0xE1 == 0xC0:  # initiate download
            self._downloading = 1
            return [b"\xa0" + data[1:4] + b"\x7f\0\0\0"]
        return []

    def _send(self) -> Sequence[bytes]:
        block = self._chunks[self._first : self._first + 127]
        last = self._first + len(block) == len(self._chunks)
        numbers = range(1, len(block) + 1)
        return [bytes([n | (0x80 if last and n == len(block) else 0)]) + c for n, c in zip(numbers, block, strict=True)]

    def _take(self, data: bytes) -> Sequence[bytes]:
        if self._downloading == 2:  # end of the download
            spare = data[0] >> 2 & 7
            del self.received[len(self.received) - spare :]
            return [b"\xa1".ljust(8, b"\0")]
        self.received += data[1:]
        number = data[0] & 0x7F
        if data[0] & 0x80:
            self._downloading = 2
        return [bytes([0xA2, number, 0x7F]).ljust(8, b"\0")] if number == 127 or data[0] & 0x80 else []


@pytest.fixture
def cell() -> tuple[PumpedNetwork, LocalServer, LockstepBus]:
    return make_cell(LocalServer)


def make_cell(server: Callable[[int], LocalServer]) -> tuple[PumpedNetwork, LocalServer, LockstepBus]:
    bus = LockstepBus(VirtualClock())
    slave = server(5)
    bus.attach(slave)
    network = PumpedNetwork(bus.port())
    network.add_node(5, make_od())
    return network, slave, bus


Cell = tuple[PumpedNetwork, LocalServer, LockstepBus]


def test_sdo_expedited_and_segmented_both_ways(cell: Cell) -> None:
    network, slave, bus = cell
    sdo = network[5].sdo
    sdo[0x2000].raw = 0xDEADBEEF
    assert slave.node.sdo[0x2000].raw == 0xDEADBEEF
    sdo.download(0x2001, 0, LONG)
    assert sdo.upload(0x2001, 0) == LONG
    assert sdo[0x2000].raw == 0xDEADBEEF
    assert bus.clock.now_ns() == 0, "answers come at the same instant"


def test_sdo_block_upload_and_download() -> None:
    network, _, _ = make_cell(BlockServer)
    with network[5].sdo.open(0x2001, 0, "rb", block_transfer=True, request_crc_support=False) as stream:
        assert stream.read() == LONG
    network, slave, _ = make_cell(BlockServer)
    with network[5].sdo.open(0x2001, 0, "wb", block_transfer=True, size=len(LONG), request_crc_support=False) as stream:
        stream.write(LONG)
    assert isinstance(slave, BlockServer)
    assert bytes(slave.received) == LONG


def test_sdo_abort_and_time_out_run_in_virtual_time(cell: Cell) -> None:
    network, _, bus = cell
    with pytest.raises(SdoAbortedError) as caught:
        network[5].sdo.upload(0x5FFF, 0)
    assert caught.value.code == 0x06020000
    absent = network.add_node(6, make_od())
    absent.sdo.RESPONSE_TIMEOUT = 3600.0
    with pytest.raises(SdoCommunicationError, match="No SDO response received"):
        absent.sdo.upload(0x2000, 0)
    assert bus.clock.now_ns() == 3600 * 10**9


def test_a_late_answer_arrives_within_its_time_out(cell: Cell) -> None:
    network, slave, bus = cell
    node = network.add_node(6, make_od())
    slave.say(100 * MS, 0x586, b"\x43\x00\x20\x00\x78\x56\x34\x12")
    assert node.sdo[0x2000].raw == 0x12345678
    assert bus.clock.now_ns() == 100 * MS


def test_foreign_frames_of_a_wait_go_to_the_callback(cell: Cell) -> None:
    network, slave, _ = cell
    others: list[tuple[int, bytes, int]] = []
    network.other = lambda *frame: others.append(frame)
    slave.say(1 * MS, 0x185, b"pdo")
    slave.say(2 * MS, 0x705 | RTR_FLAG, b"")
    slave.say(3 * MS, 0x705, b"\x05")
    assert network.pump_until(lambda: network[5].nmt.state == "OPERATIONAL", 1.0)
    assert others == [(0x185, b"pdo", 1 * MS), (0x705 | RTR_FLAG, b"", 2 * MS)]


def test_feed_gives_frames_that_the_cycle_drained(cell: Cell) -> None:
    network, _, _ = cell
    network.feed([(0x705, b"\x04", 5), (0x185, b"pdo", 6), (0x705 | RTR_FLAG, b"\x05", 7)])
    assert network[5].nmt.state == "STOPPED"
    assert network.malformed == 0


@pytest.mark.parametrize("frame", [(0x705, b"", 0), (0x085, b"abc", 0), (0x585, b"\x43", 0)])
def test_malformed_frames_are_counted_and_dropped(cell: Cell, frame: tuple[int, bytes, int]) -> None:
    network, _, _ = cell
    network.feed([frame])
    assert network.malformed == 1
    network[5].sdo[0x2000].raw = 5  # nothing stale is left in the client


def test_what_needs_a_thread_is_refused(cell: Cell) -> None:
    network, _, _ = cell
    with pytest.raises(UsageError, match="080 cannot be sent periodically"):
        network.sync.start(0.01)
    with pytest.raises(UsageError, match="by number"):
        network.add_node(canopen.RemoteNode(7, make_od()))
    with network.connect() as same:
        assert same is network
