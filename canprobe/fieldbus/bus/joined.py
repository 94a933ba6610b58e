"""Several buses as one `Port`: a frame goes to the bus of its receiver, and what arrives comes in the order of time.

SYNC, NMT, TIME and the master's heartbeat go to all of them, so that one SYNC counts on every bus. A bus that is lost
is reported once; then the others go on without it, so that their nodes can be stopped in an orderly way.
"""

from __future__ import annotations

import select
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.port import ControllerState, PlainPort, Port, PortCounters, TimedFrame
from canprobe.fieldbus.protocol.frames import Frame

_SLICE_NS = 200_000
"""Time that one bus without a descriptor is waited for before the others are checked again."""


def wait_for_any(ports: Sequence[Port], until_ns: int) -> None:
    """Return as soon as `drain` of one of the ports may have something, at `until_ns` at the latest, or earlier.

    Args:
        ports: ports, at least one, all on one clock.
        until_ns: latest time to return, on that clock.

    Raises:
        InterfaceError: a port is closed or lost.
    """
    clock = ports[0].clock
    descriptors = [one for port in ports if (one := port.descriptor) is not None]
    if len(descriptors) == len(ports):
        select.select(descriptors, (), (), max(0, until_ns - clock.now_ns()) * 1e-9)
        return
    for port in ports:
        end_ns = min(until_ns, clock.now_ns() + _SLICE_NS)
        port.wait(end_ns)
        if clock.now_ns() < end_ns:  # something is there
            return


class JoinedPort(PlainPort):
    """A port on several buses.

    Args:
        ports: ports by channel, all on one clock.
        routes: channel of each identifier that belongs to one bus alone.
    """

    def __init__(self, ports: Mapping[str, Port], routes: Mapping[int, str]) -> None:
        self._ports = dict(ports)
        self._routes = {can_id: self._ports[channel] for can_id, channel in routes.items()}
        self._arrived: list[TimedFrame] = []
        self._lost: set[str] = set()
        self.clock = next(iter(ports.values())).clock
        self.channel = "+".join(ports)
        self.stamps_arrival = all(port.stamps_arrival for port in ports.values())

    @property
    def counters(self) -> PortCounters:
        """Sum of the counters of all ports; a step of the wall clock, which each port notices, counts once."""
        every = [port.counters for port in self._ports.values()]
        total = PortCounters()
        for one in every:
            total.add(one)
        total.clock_steps = max(one.clock_steps for one in every)
        return total

    @property
    def state(self) -> ControllerState:
        """The worst of their controllers' states."""
        return max(port.state for port in self._ports.values())

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send each frame on the bus of its identifier, or on all buses.

        Raises:
            InterfaceError: a bus is down, closed, lost or stays full; the others have their frames. It is raised once
                for each bus, as long as another one works.
        """

        def send(port: Port) -> None:
            mine = [frame for frame in frames if self._routes.get(frame[0], port) is port]
            if mine:
                port.send_batch(mine, t_ns)

        self._on_each(send)

    def send_on(self, channel: str, frames: Sequence[Frame]) -> None:
        """Send frames on one bus, whatever their identifiers."""
        self._on_each(lambda port: port.send_batch(frames) if port is self._ports[channel] else None)

    def drain(self) -> list[TimedFrame]:
        """Return every frame that has arrived on any bus, by time.

        Raises:
            InterfaceError: as for `send_batch`; frames of the other buses are kept for the next call.
        """
        self._take()
        frames, self._arrived = self._arrived, []
        return frames

    def wait(self, until_ns: int) -> None:
        """Return as soon as a frame is there on any bus, at `until_ns` at the latest."""
        clock = self.clock
        self._take()
        while not self._arrived and clock.now_ns() < until_ns:
            wait_for_any([port for name, port in self._ports.items() if name not in self._lost], until_ns)
            self._take()

    def close(self) -> None:
        """Close all of them."""
        for port in self._ports.values():
            port.close()

    def _take(self) -> None:
        new: list[TimedFrame] = []
        try:
            self._on_each(lambda port: new.extend(port.drain()))
        finally:
            if new:
                self._arrived = sorted([*self._arrived, *new], key=itemgetter(2))  # by time

    def _on_each(self, act: Callable[[Port], None]) -> None:
        """Call `act` for every bus, lost ones too as they may come back; then raise the first failure that is new."""
        news: InterfaceError | None = None
        failed: set[str] = set()
        for name, port in self._ports.items():
            try:
                act(port)
            except InterfaceError as error:
                failed.add(name)
                if name not in self._lost:
                    news = news or error
                last = error
        self._lost |= failed
        if news is not None:
            raise news
        if failed and len(self._lost) == len(self._ports):
            raise last
