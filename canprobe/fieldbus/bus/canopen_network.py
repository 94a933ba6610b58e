"""canopen-python on a port: a master that somebody else wrote works with whatever is on the bus."""

from __future__ import annotations

from typing import Any

import canopen

from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.protocol.frames import RTR_FLAG


class PortNetwork(canopen.Network):
    """A network of canopen-python that sends and receives through a port instead of python-can.

    It has no thread: frames are received after each one that is sent, and in `pass_time`. On a virtual bus a node
    answers at once, so that SDO, PDO and NMT of canopen-python work as they do on a real bus. What waits for a frame
    that nobody asked for (`wait_for_heartbeat`) waits in vain: let time pass instead, and read what came.

    Args:
        port: connection to the bus; it is closed by `disconnect`.
    """

    def __init__(self, port: Port) -> None:
        super().__init__()
        self.port = port

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a frame, and receive what comes at once."""
        self.port.send_batch(((can_id | RTR_FLAG if remote else can_id, bytes(data)),))
        self._receive()

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Any:
        """Refused: nothing is sent by itself here.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a network without a thread sends nothing by itself: send in a loop with pass_time")

    def pass_time(self, seconds: float) -> None:
        """Let time pass on the port's clock, and receive what comes."""
        until_ns = self.port.clock.now_ns() + round(seconds * 1e9)
        while self.port.clock.now_ns() < until_ns:
            self.port.wait(until_ns)
            self._receive()

    def disconnect(self) -> None:
        """Close the port."""
        self.port.close()

    def _receive(self) -> None:
        for can_id, data, t_ns in self.port.drain():
            if can_id < RTR_FLAG:
                self.notify(can_id, bytearray(data), 1e-9 * t_ns)
