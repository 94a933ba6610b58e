"""canopen's `Network` without its threads: SDO, NMT, EMCY, LSS and heartbeats over any `Port`, in the port's own time.

Whoever waits for an answer pumps the port: it receives frames itself, gives canopen its own and everything else to a
callback, so that nothing is lost. Time-outs run on the port's clock; on a `LockstepBus` they cost no real time.

Not for the cycle: PDO objects of canopen and periodic messages are left out on purpose.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Any, Never, cast

import canopen
from canopen.emcy import EmcyConsumer, EmcyError
from canopen.nmt import NmtError, NmtMaster
from canopen.node.remote import RemoteNode
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoCommunicationError

from canprobe.bus.lss import PumpedLss
from canprobe.bus.port import EFF_FLAG, RTR_FLAG, Port, TimedFrame
from canprobe.errors import UsageError

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
    """A canopen `RemoteNode` whose SDO, NMT and EMCY waits pump the network."""

    def __init__(self, node_id: int, object_dictionary: Any, load_od: bool = False) -> None:
        super().__init__(node_id, object_dictionary, load_od)
        self.nmt = PumpedNmt(cast(int, self.id))
        self.emcy = PumpedEmcy(self)

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


class PumpedNmt(NmtMaster):
    """canopen's NMT master with waits that receive."""

    def wait_for_heartbeat(self, timeout: float = 10) -> str:
        """Wait for a heartbeat or boot-up and return the state it tells; NmtError if none comes in `timeout` s."""
        self._state_received = None
        if not cast(PumpedNetwork, self.network).pump_until(lambda: self._state_received is not None, timeout):
            raise NmtError("No boot-up or heartbeat received")
        return str(self.state)

    def wait_for_bootup(self, timeout: float = 10) -> None:
        """Wait for a boot-up message; NmtError if none comes in `timeout` s."""
        self._state_received = None
        if not cast(PumpedNetwork, self.network).pump_until(lambda: self._state_received == 0, timeout):
            raise NmtError("Timeout waiting for boot-up message")


class PumpedEmcy(EmcyConsumer):
    """canopen's EMCY consumer with a wait that receives."""

    def __init__(self, node: PumpedNode) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._node = node

    def wait(self, emcy_code: int | None = None, timeout: float = 10) -> EmcyError | None:  # type: ignore[override]
        """Wait for the next EMCY, of that code if given; `None` if none comes in `timeout` s."""
        first = len(self.log)

        def new() -> list[EmcyError]:
            return [e for e in self.log[first:] if emcy_code is None or e.code == emcy_code]

        network = cast(PumpedNetwork, self._node.network)
        return new()[0] if network.pump_until(lambda: bool(new()), timeout) else None
