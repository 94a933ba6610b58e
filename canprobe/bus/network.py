"""canopen's `Network` without its threads: SDO, NMT, EMCY, LSS and heartbeats over any `Port`, in the port's own
time.

Whoever waits for an answer pumps the port: it receives frames itself, gives canopen its own and everything else to a
callback, so that nothing is lost. Time-outs run on the port's clock; on a `LockstepBus` they cost no real time.

Not for the cycle: PDO objects of canopen and periodic messages are left out on purpose.
"""

from __future__ import annotations

import queue
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Never, cast

import canopen
from canopen.lss import LssError, LssMaster
from canopen.node.remote import RemoteNode
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError

from canprobe.bus.port import Port, TimedFrame
from canprobe.errors import UsageError
from canprobe.protocol.frames import (
    EFF_FLAG,
    LSS_LENGTH,
    LSS_REQUEST_ID,
    NOTHING_ASKED,
    RTR_FLAG,
    SDO_RX_BASE,
    SDO_TX_BASE,
    LssCommand,
    pack_fastscan,
    pack_lss,
    pack_number,
)

# canopen's LSS master, waiting by receiving: on the port's clock, whatever that is.
#
# canopen's own waits for a thread that puts answers into a queue, sleeps 10 ms after each question of a search and 0.2
# s after each part of an address, and takes a second answer to one question for the answer to the next one.

SETTLE_S = 0.005
"""Several nodes may give the same answer to one question, one after another: so long the later ones are waited for."""


class _Arrivals(queue.Queue[bytes]):
    """Answers; whoever waits for one, receives."""

    def __init__(self, network: PumpedNetwork) -> None:
        super().__init__()
        self._network = network

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        self._network.pump_until(lambda: self.qsize() > 0, timeout or 0.0)
        return super().get(block=False)


class PumpedLss(LssMaster):
    """LSS over a `PumpedNetwork`; RESPONSE_TIMEOUT (s) runs on the port's clock. Errors are canopen's `LssError`."""

    RESPONSE_TIMEOUT = 0.5
    SCAN_TIMEOUT = 0.05
    """How long nobody has to answer a question of fastscan before it is taken for a no."""

    def __init__(self, network: PumpedNetwork) -> None:
        self._pumped = network
        super().__init__()
        self.network = network

    @property
    def responses(self) -> queue.Queue[Any]:
        """Answers that have arrived. canopen forgets old ones by putting a new queue in their place."""
        return self._arrivals

    @responses.setter
    def responses(self, _: Any) -> None:
        self._arrivals = _Arrivals(self._pumped)

    def on_message_received(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Keep an answer; one of another length is none."""
        if len(data) != LSS_LENGTH:
            raise struct.error("an LSS message has 8 bytes")
        self.responses.put(bytes(data))

    def send_switch_state_selective(
        self, vendorId: int, productCode: int, revisionNumber: int, serialNumber: int
    ) -> bool:
        """Put the node of this address into configuration; whether it answered."""
        numbers = (vendorId, productCode, revisionNumber, serialNumber)
        *first, last = [pack_number(LssCommand(LssCommand.SELECT_VENDOR + i), n) for i, n in enumerate(numbers)]
        for message in first:
            self._pumped.send_message(LSS_REQUEST_ID, message)
        return self._ask(last, self.RESPONSE_TIMEOUT, LssCommand.SELECTED) > 0

    def inquire_node_ids(self) -> list[int]:
        """What all the nodes in configuration answer: one node id, unless several devices have one address."""
        self._ask(pack_lss(LssCommand.INQUIRE_NODE_ID), self.RESPONSE_TIMEOUT, LssCommand.INQUIRE_NODE_ID)
        return [answer[1] for answer in self._answers]

    def fast_scan(self) -> tuple[bool, list[int] | None]:
        """Find the unconfigured node with the lowest address; it is in configuration afterwards.

        Returns:
            (True, the four numbers of 1018h), or (False, None) where nobody answers.

        Raises:
            LssError: somebody answers, but to no address: answers were lost or came late.
        """
        for timeout_s in (self.SCAN_TIMEOUT, 5 * self.SCAN_TIMEOUT):
            if not self._identified(0, NOTHING_ASKED, 0, 0, self.RESPONSE_TIMEOUT):
                return False, None
            if (numbers := self._search(timeout_s)) is not None:
                return True, numbers
        raise LssError("nodes without an id answer, but not to the end of a search; connect them one at a time")

    def _search(self, timeout_s: float) -> list[int] | None:
        found: list[int] = []
        for position in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not self._identified(number, bit, position, position, timeout_s):
                    number |= 1 << bit
            if not self._identified(number, 0, position, (position + 1) % 4, self.RESPONSE_TIMEOUT):
                return None
            found.append(number)
        return found

    def _identified(self, number: int, bit: int, position: int, following: int, timeout_s: float) -> bool:
        return self._ask(pack_fastscan(number, bit, position, following), timeout_s, LssCommand.IDENTIFIED) > 0

    def _ask(self, message: bytes, timeout_s: float, answer: LssCommand) -> int:
        """Ask, and count the answers that come; `_answers` are they."""
        self._pumped.pump_until(lambda: True, 0.0)
        self.responses = None
        self._pumped.send_message(LSS_REQUEST_ID, message)
        self._answers: Sequence[bytes] = ()
        if self._pumped.pump_until(lambda: self.responses.qsize() > 0, timeout_s):
            self._pumped.pump_until(lambda: False, SETTLE_S)
            arrived = [self.responses.get_nowait() for _ in range(self.responses.qsize())]
            self._answers = [data for data in arrived if data[0] == answer]
        return len(self._answers)


# canopen's `Network` without its threads: SDO, NMT, EMCY, LSS and heartbeats over any `Port`, in the port's own time.

_NOT_FOR_CANOPEN = EFF_FLAG | RTR_FLAG
_SDO_LENGTH = 8


class PumpedNetwork(canopen.Network):
    """A canopen network that receives only while somebody waits, or what it is fed.

    Args:
        port: the connection to the bus; it is not closed with the network.
        other: called with (can_id, data, t_ns) for each frame that arrives during a wait and is not canopen's.

    Attributes:
        malformed: frames that canopen could not unpack, such as an EMCY of three bytes; they are dropped.
    """

    def __init__(self, port: Port, other: Callable[[int, bytes, int], None] | None = None) -> None:
        super().__init__()
        self.port = port
        self.other = other
        self.malformed = 0
        self.unsubscribe(self.lss.LSS_RX_COBID)  # of canopen's own, which waits for a thread
        self.lss = PumpedLss(self)
        self.subscribe(self.lss.LSS_RX_COBID, self.lss.on_message_received)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send one frame through the port."""
        self.port.send_batch(((can_id | RTR_FLAG if remote else can_id, bytes(data)),))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Never:
        """Refuse: nothing here sends by itself.

        Raises:
            UsageError: always.
        """
        raise UsageError(f"{can_id:03X} cannot be sent periodically by a PumpedNetwork; send it from the cycle")

    def connect(self, *args: Any, **kwargs: Any) -> PumpedNetwork:
        """Return the network itself: it is connected by its port."""
        return self

    def add_node(self, node: Any, object_dictionary: Any = None, upload_eds: bool = False) -> PumpedNode:
        """Add a remote node by number and object dictionary, with clients that pump the port.

        Raises:
            UsageError: `node` is another RemoteNode, whose clients wait for a thread, or an EDS is to be uploaded.
        """
        if isinstance(node, int):
            node = PumpedNode(node, object_dictionary)
        if upload_eds or not isinstance(node, PumpedNode):
            raise UsageError("a PumpedNetwork takes a node by number with its object dictionary, or a PumpedNode")
        self[cast(int, node.id)] = node
        return node

    def feed(self, frames: Iterable[TimedFrame]) -> None:
        """Give canopen frames that were drained elsewhere; those that nobody subscribed to are ignored."""
        for can_id, data, t_ns in frames:
            self._notify(can_id, data, t_ns)

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Receive until `done()`, at most `timeout_s` on the port's clock.

        Returns:
            The last answer of `done`.
        """
        port = self.port
        deadline_ns = port.clock.now_ns() + round(timeout_s * 1e9)
        self._pump()
        while not done():
            if port.clock.now_ns() >= deadline_ns:
                return False
            port.wait(deadline_ns)
            self._pump()
        return True

    def _pump(self) -> None:
        other = self.other
        for can_id, data, t_ns in self.port.drain():
            if can_id in self.subscribers:
                self._notify(can_id, data, t_ns)
            elif other is not None:
                other(can_id, data, t_ns)

    def _notify(self, can_id: int, data: bytes, t_ns: int) -> None:
        if can_id & _NOT_FOR_CANOPEN:
            return
        try:
            self.notify(can_id, bytearray(data), t_ns * 1e-9)
        except struct.error:
            self.malformed += 1


class PumpedNode(RemoteNode):
    """A canopen `RemoteNode` whose SDO waits pump the network."""

    def add_sdo(self, rx_cobid: int, tx_cobid: int) -> PumpedSdoClient:
        """Add an SDO client on these identifiers."""
        client = PumpedSdoClient(rx_cobid, tx_cobid, self.object_dictionary)  # type: ignore[no-untyped-call]
        self.sdo_channels.append(client)
        if self.has_network():
            client.network = self.network
            self.network.subscribe(client.tx_cobid, client.on_response)
        return client


class PumpedSdoClient(SdoClient):
    """canopen's SDO client, waiting by receiving; its RESPONSE_TIMEOUT (s) runs on the port's clock."""

    def on_response(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Keep a response for the transfer; anything but 8 bytes is no SDO (CiA 301, 7.2.4.3)."""
        if len(data) != _SDO_LENGTH:
            raise struct.error("an SDO response has 8 bytes")
        super().on_response(can_id, data, timestamp)  # type: ignore[no-untyped-call]

    def read_response(self) -> bytes:
        """Receive until a response is there, then read it as canopen does.

        Raises:
            SdoCommunicationError: none came in RESPONSE_TIMEOUT.
            SdoAbortedError: the server aborted.
        """
        arrived = cast(PumpedNetwork, self.network).pump_until(
            lambda: not self.responses.empty(), self.RESPONSE_TIMEOUT
        )
        if not arrived:
            raise SdoCommunicationError("No SDO response received")
        response: bytes = super().read_response()  # type: ignore[no-untyped-call]
        return response


# Who is there? One SDO read of 1000h to each node id, all at once; any answer counts, an abort too.

UPLOAD_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0))
BURST = 8
BURST_PAUSE_NS = 2_000_000


def answering_nodes(port: Port, node_ids: Iterable[int], timeout_s: float) -> tuple[int, ...]:
    """Node ids, ascending, whose SDO server answers within the time-out. Every other frame that arrives is dropped.

    Args:
        port: the bus.
        node_ids: whom to ask, 1–127.
        timeout_s: after the last question.

    Raises:
        InterfaceError: the interface failed.
    """
    asked = sorted(set(node_ids))
    found: set[int] = set()
    for first in range(0, len(asked), BURST):
        port.send_batch([(SDO_RX_BASE + n, UPLOAD_DEVICE_TYPE) for n in asked[first : first + BURST]])
        _listen(port, asked, found, port.clock.now_ns() + BURST_PAUSE_NS)
    _listen(port, asked, found, port.clock.now_ns() + round(timeout_s * 1e9))
    return tuple(sorted(found))


def _listen(port: Port, asked: list[int], found: set[int], until_ns: int) -> None:
    while len(found) < len(asked) and port.clock.now_ns() < until_ns:
        port.wait(until_ns)
        found.update(can_id - SDO_TX_BASE for can_id, _, _ in port.drain() if can_id - SDO_TX_BASE in asked)
