"""What a device does with its CANopen node: the base class of drive and sensor, which does nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from canprobe.emulator.node import SlaveNode


class Application:
    """A device without a function; subclasses override what they need."""

    def attach(self, node: SlaveNode) -> None:
        """Once, at construction of the node: hang checks, hooks and samplers on its dictionary and PDOs."""

    def keep(self) -> bytes:
        """What "save" (1010h) stores of the device beside its dictionary."""
        return b""

    def recall(self, kept: bytes) -> None:
        """Before `reset`: what was stored; empty when nothing was, or after "load" (1011h)."""

    def reset(self, t_ns: int) -> None:
        """The node boots; the dictionary holds its defaults or what was stored."""

    def entered(self, t_ns: int) -> None:
        """The NMT state has just changed."""

    def sync(self, t_ns: int, counter: int) -> None:
        """A SYNC in operational: synchronous RPDOs have been applied, TPDOs are packed next."""

    def advance(self, t_ns: int) -> None:
        """Time has come to `t_ns`; called before anything that the node does then."""

    def connection_lost(self, t_ns: int) -> None:
        """The network is gone: heartbeat consumer, life guarding, NMT stop."""
