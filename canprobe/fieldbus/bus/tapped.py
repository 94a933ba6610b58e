"""Ports in the place of another one: a record, a judge or a meter hears its frames, a study disturbs them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from canprobe.fieldbus.bus.port import ControllerState, PlainPort, Port, PortCounters, TimedFrame
from canprobe.fieldbus.protocol.frames import Frame


class OuterPort(PlainPort):
    """Base of ports through which another one is used.

    Args:
        port: port to use.
    """

    def __init__(self, port: Port) -> None:
        self._port = port
        self.clock, self.channel, self.close = port.clock, port.channel, port.close

    @property
    def counters(self) -> PortCounters:
        """Counters of the port."""
        return self._port.counters

    @property
    def state(self) -> ControllerState:
        """State of the port's controller."""
        return self._port.state


class TappedPort(OuterPort, ABC):
    """A `Port` through which another one is used, and whose frames are heard on the way.

    Args:
        port: port to use.
    """

    def __init__(self, port: Port) -> None:
        super().__init__(port)
        self.stamps_arrival, self.wait = port.stamps_arrival, port.wait

    @property
    def descriptor(self) -> int | None:
        return self._port.descriptor

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames`, which are heard with `t_ns` where it is given, and else with the time before they are sent."""
        sent_ns = self.clock.now_ns() if t_ns is None else t_ns
        self._port.send_batch(frames, t_ns)
        self.hear_sent(frames, sent_ns)

    def send_on(self, channel: str, frames: Sequence[Frame]) -> None:
        """Send frames on the bus of a channel, which are heard with the time before they are sent."""
        sent_ns = self.clock.now_ns()
        self._port.send_on(channel, frames)
        self.hear_sent(frames, sent_ns)

    def drain(self) -> list[TimedFrame]:
        """Return what arrived, which is heard."""
        frames = self._port.drain()
        self.hear_received(frames)
        return frames

    @abstractmethod
    def hear_sent(self, frames: Sequence[Frame], t_ns: int) -> None:
        """Hear frames that were sent."""

    @abstractmethod
    def hear_received(self, frames: Sequence[TimedFrame]) -> None:
        """Hear frames that arrived."""
