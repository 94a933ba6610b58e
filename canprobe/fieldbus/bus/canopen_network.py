"""canopen-python on a port, so that a master that somebody else wrote works with the devices of a bus."""

from __future__ import annotations

from typing import Any

import canopen

from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.frames import RTR_FLAG


class PortNetwork(canopen.Network):
    """A network of canopen-python that sends and receives through a port instead of python-can.

    It has no thread: frames are received after each one that is sent, and in `pass_time`. On a virtual bus a node
    answers at once, so that SDO, PDO and NMT of canopen-python work as they do on a real bus. A function that waits for
    a frame that nobody asked for (`wait_for_heartbeat`) waits in vain: let time pass instead, and read what came.

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

    def _take(self, can_id: int, data: bytes, t_ns: int) -> None:
        if can_id < RTR_FLAG:
            self.notify(can_id, bytearray(data), 1e-9 * t_ns)
