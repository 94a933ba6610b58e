"""The base of what stands between a node and a lockstep bus, attached in the node's place."""

from __future__ import annotations

from collections.abc import Callable, Container

from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.node.slave_node import SlaveNode


class WrappedNode(Participant):
    """Passes on what the bus asks of a node; what is done to its frames is the derived class's.

    Args:
        node: the node.
    """

    def __init__(self, node: SlaveNode) -> None:
        self.node = node

    @property
    def node_id(self) -> int:
        """As the node."""
        return self.node.node_id

    @property
    def name(self) -> str:
        """For messages."""
        return self.node.name

    @property
    def listens(self) -> Container[int]:
        """As the node."""
        return self.node.listens

    @property
    def kind(self) -> type:
        """As the node."""
        return self.node.kind

    @property
    def patient(self) -> frozenset[int]:
        """As the node."""
        return self.node.patient

    def connect(self, rerouted: Callable[[], None]) -> None:
        """Of the node."""
        self.node.connect(rerouted)
