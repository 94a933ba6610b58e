"""Faults thrown at nodes: from texts and from Python, for as long as a block lasts; those of a test wait for nodes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from operator import attrgetter, itemgetter

from canprobe.errors import UsageError
from canprobe.fieldbus.drive.drive import DriveApplication
from canprobe.fieldbus.tools.faults.fault import FOREVER_NS, Fault, FaultKind, FaultSpan
from canprobe.fieldbus.tools.faults.faulty_node import FaultyNode
from canprobe.fieldbus.tools.faults.frame_faults import HEADER_INDEX
from canprobe.fieldbus.tools.faults.registry import BUS_FAULTS
from canprobe.fieldbus.tools.faults.text import node_of, parse_fault


class FaultyNodes:
    """The nodes of one process, and the faults that are thrown at them.

    Args:
        nodes: the nodes, attached to their buses in this form.
        kinds: kinds of faults that may be thrown at nodes; motors have their own.
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
        from canprobe.fieldbus.tools.faults.motor_faults import MOTOR_FAULTS, FaultyMotor

        fault = parse_fault(text, {**MOTOR_FAULTS, **self.kinds})
        node = next((one for one in self.nodes if one.node_id == fault.node_id), None)
        if node is None:
            there = ", ".join(str(one.node_id) for one in self.nodes) or "none"
            raise UsageError(f"fault {text!r}: no node {fault.node_id} is emulated here; nodes: {there}")
        kind, is_motor = fault.kind, isinstance(node, FaultyMotor)
        if kind.name not in MOTOR_FAULTS if is_motor else kind.needs == "motor":
            of_motors = ", ".join(MOTOR_FAULTS)
            raise UsageError(f"fault {text!r}: {kind.name} cannot happen to {node.name}; to motors can: {of_motors}")
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

    def spans(self, start_ns: int = 0, now_ns: int = FOREVER_NS) -> list[FaultSpan]:
        """When faults held, in order; one that holds still ends now.

        Args:
            start_ns: time on the clock of the bus that is 0 in what is returned.
            now_ns: present time on that clock.
        """
        spans = sorted((span for node in self.nodes for span in node.spans), key=attrgetter("begin_ns"))
        return [
            replace(one, begin_ns=one.begin_ns - start_ns, end_ns=min(one.end_ns, now_ns) - start_ns) for one in spans
        ]


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


class PlannedFaults:
    """Faults of one test.

    Args:
        seed: seed of their random choices, where a fault names none.
        kinds: kinds that a fault may have whose node is not powered on yet.

    Attributes:
        waiting: texts of faults whose node is not powered on yet.
    """

    def __init__(self, seed: int, kinds: Mapping[str, FaultKind]) -> None:
        self.waiting: list[str] = []
        self._seed, self._kinds = seed, kinds
        self._throw: dict[int, tuple[Callable[[str], Fault], Callable[[Fault], None]]] = {}
        self._thrown: list[tuple[Fault, str]] = []
        self._nodes: list[FaultyNode] = []

    def inject(
        self,
        fault: str,
        *,
        node: int = 1,
        at_s: float | None = None,
        on: str = "",
        for_s: float | None = None,
        **values: float | str,
    ) -> None:
        """Throw a fault; where its node is not powered on yet, it waits for that.

        Args:
            fault: a fault as ``canprobe inject`` takes it, ``node 3: mute at 1 s``, or the name of its kind.
            node: node id, where `fault` is a name; the others likewise.
            at_s: time from now, s.
            on: event at which it begins, such as ``enabled``.
            for_s: its duration, s.
            values: parameters of the kind, and ``share``, ``count``, ``seed``, ``direction``.

        Raises:
            UsageError: the fault is wrong; whether its node is the device that it needs is found when it is thrown.
        """
        if ":" not in fault:
            words = [f"node {node}: {fault}", *(f"{name}={value}" for name, value in values.items())]
            words += [f"at {at_s} s"] if at_s is not None else []
            words += [f"on {on}"] if on else []
            words += [f"for {for_s} s"] if for_s is not None else []
            fault = " ".join(words)
        if "seed=" not in fault:
            fault = re.sub(r"(:\s*[\w-]+)", rf"\1 seed={self._seed}", fault, count=1)
        if (node_id := node_of(fault)) in self._throw:
            self._thrown.append((self._throw[node_id][0](fault), fault))
        else:
            parse_fault(fault, self._kinds)
            self.waiting.append(fault)

    def clear(self) -> None:
        """End all faults."""
        for fault, _ in self._thrown:
            self._throw[fault.node_id][1](fault)
        self.waiting.clear()

    def attach(self, throw: Callable[[str], Fault], end: Callable[[Fault], None], nodes: Sequence[FaultyNode]) -> None:
        """Take nodes that are powered on now, and throw what waits for them."""
        self._throw |= dict.fromkeys((node.node_id for node in nodes), (throw, end))
        self._nodes += nodes
        waiting, self.waiting = self.waiting, []
        for text in waiting:
            self.inject(text)

    def detach(self) -> None:
        """Forget nodes that are powered off; what is thrown from now on waits for the next ones."""
        self._throw.clear()

    def timeline(self, start_ns: int = 0) -> list[str]:
        """What was thrown, what began and ended when, and what waits still.

        Args:
            start_ns: time on the clock of the bus that is 0 in the lines.
        """
        texts = {id(fault): text for fault, text in self._thrown}
        spans = [span for node in self._nodes for span in node.spans]
        events = [(span.begin_ns, "begins", span.fault) for span in spans]
        events += [(span.end_ns, "ends", span.fault) for span in spans if span.end_ns < FOREVER_NS]
        lines = [f"thrown: {text}" for text in texts.values()] + [f"not yet thrown: {text}" for text in self.waiting]
        for t_ns, word, fault in sorted(events, key=itemgetter(0, 1)):
            lines.append(f"{(t_ns - start_ns) * 1e-9:.6f} s {word}: {texts.get(id(fault), fault.kind.name)}")
        return lines or ["none"]
