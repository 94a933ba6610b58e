"""What the services of one node share: identity, state, time, dictionary, timers and the frames to send."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from canprobe.emulator.dictionary import Dictionary
from canprobe.emulator.timers import Timers
from canprobe.protocol.frames import Frame, NmtState

Route = Callable[[bytes, int], None]
NO_ROUTES: Mapping[int, Route] = {}


class NodeCore:
    """Shared by the services of one node; the node itself drives it.

    Attributes:
        node_id: 1–127.
        state: NMT state.
        now_ns: time of the event being served.
        out: frames to send, in order.
    """

    __slots__ = ("dictionary", "node_id", "now_ns", "out", "reroute", "state", "timers")

    def __init__(self, node_id: int, dictionary: Dictionary) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.timers = Timers()
        self.state = NmtState.INITIALISING
        self.now_ns = 0
        self.out: list[Frame] = []
        self.reroute: Callable[[], None] = _nothing

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame behind those the node already sends."""
        self.out.append((can_id, data))


class Service(Protocol):
    """One CiA 301 service of a node."""

    def reset(self, t_ns: int) -> None:
        """Forget everything and read the parameters again (the dictionary holds its defaults)."""

    def entered(self, t_ns: int) -> None:
        """The NMT state has just changed to `core.state`."""

    def routes(self) -> Mapping[int, Route]:
        """What to call for which CAN-ID, in the present NMT state."""


def _nothing() -> None:
    return None
