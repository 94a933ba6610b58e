"""canopen-python on a port, so that a master that somebody else wrote works with the devices of a bus."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import canopen

from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.frames import RTR_FLAG


class PortNetwork(canopen.Network):
    """A network of canopen-python that sends and receives through a port instead of python-can.

    It has no thread: frames are received after each one that is sent, in `pass_time`, and where canopen-python waits
    for one: for an SDO answer, a heartbeat (`wait_for_heartbeat`), an EMCY or a PDO (`wait_for_reception`). Such a wait
    passes time on the port's clock. `time.sleep` and LSS do not.

    Args:
        port: connection to the bus; it is closed by `disconnect`.
    """

    def __init__(self, port: Port) -> None:
        super().__init__()
        self.port = port
        self._pumped = PumpedNetwork(port, self._take)

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame, and receive the frames that come at once."""
        self._pumped.send_message(can_id | RTR_FLAG if remote else can_id, bytes(data))
        self.pass_time(0.0)

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Any:
        """Refuse: a network without a thread sends nothing by itself.

        Raises:
            NotImplementedError: it is always raised.
        """
        raise NotImplementedError("a network without a thread sends nothing by itself: send in a loop with pass_time")

    def pass_time(self, seconds: float) -> None:
        """Let time pass on the port's clock, and receive the frames that come."""
        self._pumped.pump_until(lambda: False, seconds)

    def disconnect(self) -> None:
        """Close the port."""
        self.port.close()

    def __setitem__(self, node_id: int, node: Any) -> None:
        """Add a node; its waits pass time."""
        super().__setitem__(node_id, node)
        if hasattr(node, "sdo_channels"):  # a remote one
            for client in node.sdo_channels:
                client.read_response = partial(self._read_response, client, client.read_response)
            node.nmt.state_update = _PassingCondition(self._pumped)
            node.emcy.emcy_received = _PassingCondition(self._pumped)
            for pdo in (*node.tpdo.values(), *node.rpdo.values()):
                pdo.receive_condition = _PassingCondition(self._pumped)

    def _read_response(self, client: Any, read: Callable[[], bytes]) -> bytes:
        """The answer to an SDO request, which is in the client's queue when it is read."""
        if not self._pumped.pump_until(lambda: not client.responses.empty(), client.RESPONSE_TIMEOUT):
            raise canopen.SdoCommunicationError("No SDO response received")
        return read()

    def _take(self, can_id: int, data: bytes, t_ns: int) -> None:
        if can_id < RTR_FLAG:
            self.notify(can_id, bytearray(data), 1e-9 * t_ns)


class _PassingCondition:
    """Stands for a `threading.Condition` where there is one thread: a wait lets time pass until somebody notifies."""

    def __init__(self, network: PumpedNetwork) -> None:
        self._network = network
        self._notified = False

    def __enter__(self) -> bool:
        return True

    def __exit__(self, *_: object) -> None: ...

    def notify_all(self) -> None:
        self._notified = True

    def wait(self, timeout: float | None = None) -> bool:
        self._notified = False
        return self._network.pump_until(lambda: self._notified, threading.TIMEOUT_MAX if timeout is None else timeout)
