"""Faults of a test: thrown at once, or when the nodes that they name are powered on."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

from canprobe.errors import UsageError
from canprobe.fieldbus.tools.faults.fault import Fault, FaultKind
from canprobe.fieldbus.tools.faults.faulty_node import FaultyNode
from canprobe.fieldbus.tools.faults.text import FORM, parse_fault


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
        match = re.match(r"\s*node\s+(\d+)\s*:", fault)
        if match is None:
            raise UsageError(f"fault {fault!r}: expected {FORM}")
        if (node_id := int(match[1])) in self._throw:
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
        events = [event for node in self._nodes for event in node.history]
        lines = [f"thrown: {text}" for text in texts.values()] + [f"not yet thrown: {text}" for text in self.waiting]
        for t_ns, word, fault in sorted(events, key=lambda event: event[0]):
            lines.append(f"{(t_ns - start_ns) * 1e-9:.6f} s {word}: {texts.get(id(fault), fault.kind.name)}")
        return lines or ["none"]
