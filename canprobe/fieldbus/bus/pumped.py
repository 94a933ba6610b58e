"""A port that is read by whoever waits for an answer.

Whoever waits pumps the port: it receives the frames itself, gives each to the subscribers of its identifier and every
other one to a callback, so that nothing is lost. Time-outs run on the port's clock; on a `LockstepBus` they cost
no real time. The cycle does not use it: it reads the port itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from canprobe.fieldbus.bus.port import Port, TimedFrame

Taker = Callable[[int, bytes, int], object]
"""Called with (can_id, data, t_ns) of a frame."""


class PumpedNetwork:
    """A port with subscribers; frames come only while somebody waits, or by `feed`.

    Args:
        port: connection to the bus; it is not closed with the network.
        other: function that is called with each frame that arrives during a wait and has no subscriber.
    """

    def __init__(self, port: Port, other: Taker = lambda *_: None) -> None:
        self.port = port
        self._other = other
        self._takers: dict[int, list[Taker]] = {}

    def subscribe(self, can_id: int, take: Taker) -> None:
        """Call `take` with the frames of an identifier."""
        self._takers.setdefault(can_id, []).append(take)

    def unsubscribe(self, can_id: int, take: Taker) -> None:
        """Undo one `subscribe`."""
        takers = self._takers[can_id]
        takers.remove(take)
        if not takers:
            del self._takers[can_id]

    def send_message(self, can_id: int, data: bytes) -> None:
        """Send one frame through the port."""
        self.port.send_batch(((can_id, data),))

    def feed(self, frames: Iterable[TimedFrame]) -> None:
        """Give subscribers frames that were drained elsewhere; the others are ignored."""
        for can_id, data, t_ns in frames:
            for take in self._takers.get(can_id, ()):
                take(can_id, data, t_ns)

    def pump_until(self, done: Callable[[], bool], timeout_s: float) -> bool:
        """Receive until `done()`, at most `timeout_s` on the port's clock.

        Returns:
            The last value of `done()`.
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
        for frame in self.port.drain():
            for take in self._takers.get(frame[0], (self._other,)):
                take(*frame)
