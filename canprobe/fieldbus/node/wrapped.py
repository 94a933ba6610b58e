"""Base class of what stands between a node and a lockstep bus, attached in the node's place."""

from __future__ import annotations

from collections.abc import Callable, Container

from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.node.slave_node import SlaveNode


class WrappedNode(Participant):
    """Passes the questions of the bus on to a node; the derived class changes the frames.

    Args:
        node: the node.
    """

    def __init__(self, node: SlaveNode) -> None:
        self.node = node

    @property
    def node_id(self) -> int:
        """Node id of the node."""
        return self.node.node_id

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def listens(self) -> Container[int]:
        return self.node.listens

    @property
    def kind(self) -> type:
        return self.node.kind

    @property
    def patient(self) -> frozenset[int]:
        return self.node.patient

    def connect(self, rerouted: Callable[[], None]) -> None:
        self.node.connect(rerouted)
