"""Faults thrown at running nodes: from texts, from Python, for as long as a block lasts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from canprobe.errors import UsageError
from canprobe.fieldbus.drive.drive import DriveApplication
from canprobe.fieldbus.tools.faults.fault import Fault, FaultKind
from canprobe.fieldbus.tools.faults.faulty_node import FaultyNode
from canprobe.fieldbus.tools.faults.frame_faults import HEADER_INDEX
from canprobe.fieldbus.tools.faults.registry import BUS_FAULTS
from canprobe.fieldbus.tools.faults.text import parse_fault


class FaultyNodes:
    """The nodes of one process, and the faults that are thrown at them.

    Args:
        nodes: the nodes, attached to their buses in this form.
        kinds: kinds of faults that may be thrown.
    """

    def __init__(self, nodes: Iterable[FaultyNode], kinds: Mapping[str, FaultKind] = BUS_FAULTS) -> None:
        self.nodes = list(nodes)
        self.kinds = kinds

    def inject(self, text: str, now_ns: int | None = None) -> Fault:
        """Throw a fault, as `text.parse_fault` reads it.

        Args:
            text: the fault.
            now_ns: time from which its `at` counts; None: the last frame or deadline of its node. A fault whose time
                has passed begins at the next one.

        Raises:
            UsageError: the text is wrong, no node here has this id, or the kind needs another device.
        """
        fault = parse_fault(text, self.kinds)
        node = self._node(fault.node_id, text)
        kind = fault.kind
        if kind.needs == "drive" and not isinstance(node.node.application, DriveApplication):
            raise UsageError(f"fault {text!r}: node {fault.node_id} is no CiA 402 drive, which {kind.name} needs")
        if kind.needs == "array" and not node.node.dictionary.has_index(HEADER_INDEX):
            raise UsageError(f"fault {text!r}: node {fault.node_id} is no tactile array, which {kind.name} needs")
        fault = replace(fault, start_ns=fault.start_ns + (node.now_ns if now_ns is None else now_ns))
        node.add(fault)
        return fault

    def end(self, fault: Fault) -> None:
        """End a fault at the next frame or deadline of its node."""
        for node in self.nodes:
            node.remove(fault)

    def clear(self) -> list[Fault]:
        """End all faults; return them."""
        faults = self.faults
        for fault in faults:
            self.end(fault)
        return faults

    @property
    def faults(self) -> list[Fault]:
        """Faults that hold, and those that are to come."""
        return [fault for node in self.nodes for fault in node.faults]

    def _node(self, node_id: int, text: str) -> FaultyNode:
        for node in self.nodes:
            if node.node_id == node_id:
                return node
        there = ", ".join(str(node.node_id) for node in self.nodes) or "none"
        raise UsageError(f"fault {text!r}: no node {node_id} is emulated here; nodes: {there}")


@contextmanager
def inject(nodes: FaultyNodes | FaultyNode, text: str) -> Iterator[Fault]:
    """Throw a fault for as long as the block lasts.

    Example::

        node = FaultyNode(make_eds_node(load_eds("drive.eds", 5), 5))
        bus.attach(node)
        with inject(node, "node 5: heartbeat-off"):
            ...

    Args:
        nodes: the nodes, or the one.
        text: the fault, as `parse_fault` reads it; an `at` counts from the beginning of the block.

    Raises:
        UsageError: as for `FaultyNodes.inject`.
    """
    nodes = FaultyNodes([nodes]) if isinstance(nodes, FaultyNode) else nodes
    fault = nodes.inject(text)
    try:
        yield fault
    finally:
        nodes.end(fault)
