"""The base of what stands between a node and a lockstep bus: it is attached in the node's place."""

from __future__ import annotations

from collections.abc import Callable, Container

from canprobe.emulator.node import SlaveNode


class WrappedNode:
    """Passes on what the bus asks of a node; what is done to its frames is the derived class's.

    Args:
        node: the node.
    """

    def __init__(self, node: SlaveNode) -> None:
        self.node = node

    @property
    def name(self) -> str:
        """For messages."""
        return self.node.name

    @property
    def listens(self) -> Container[int]:
        """As the node."""
        return self.node.listens

    @property
    def rerouted(self) -> Callable[[], None]:
        """As the node's."""
        return self.node.rerouted

    @rerouted.setter
    def rerouted(self, function: Callable[[], None]) -> None:
        self.node.rerouted = function
