"""Faults thrown while a master is judged: a list with times, or the standard sequence, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from canprobe.errors import UsageError
from canprobe.fieldbus.tools.faults import FaultSpan, FaultyNode, FaultyNodes
from canprobe.fieldbus.tools.faults.motor_faults import FaultyMotor

STANDARD_FAULTS = (
    "sdo-slow ms=200 for 2 s",
    "heartbeat-off for 2 s",
    "mute for 2 s",
    "drive-fault code=0x2310 for 100 ms",
    "reboot for 200 ms",
)
"""The standard sequence, from what a master may bear to what it must bring up anew."""
STANDARD_MOTOR_FAULTS = ("mute for 2 s", "over-temperature for 2 s", "watchdog-trip for 100 ms", "brown-out for 100 ms")
"""The same for motors that speak no CANopen."""
_CALM_NS = 2_000_000_000
"""Time for which the nodes must have been at work before the next fault."""


class Injections:
    """Throws faults, and notes when they hold.

    Args:
        nodes: the served nodes.
        faults: faults with their nodes, as `parse_fault` reads them; None for the standard sequence.
        now_ns: present time, from which `at` counts.

    Attributes:
        not_thrown: faults of the sequence that were not thrown yet.
    """

    def __init__(self, nodes: FaultyNodes, faults: Sequence[str] | None, now_ns: int) -> None:
        self._nodes = nodes
        others = [node for node in nodes.nodes if not isinstance(node, FaultyMotor)]
        self._targets = others or nodes.nodes  # of the standard sequence
        standard = STANDARD_FAULTS if others else STANDARD_MOTOR_FAULTS
        self.not_thrown = list(standard) if faults is None else []
        self._calm_ns: int | None = None
        self._now_ns = now_ns
        for text in faults or ():
            nodes.inject(text, now_ns)

    def thrown(self, start_ns: int = 0) -> list[FaultSpan]:
        """Faults that held, in order, with times from a beginning; one that holds ends at the last look."""
        return self._nodes.spans(start_ns, self._now_ns)

    def look(self, now_ns: int) -> None:
        """Throw the next fault of the sequence when no other holds and the nodes are at work."""
        self._now_ns = now_ns
        if not self.not_thrown or any(node.holding for node in self._nodes.nodes):
            return
        at_work = _at_work(self._targets)
        if at_work is None:
            self._calm_ns = None
        elif self._calm_ns is None:
            self._calm_ns = now_ns
        elif now_ns - self._calm_ns >= _CALM_NS:
            with suppress(UsageError):  # the node is no drive, which this kind needs
                self._nodes.inject(f"{at_work.name}: {self.not_thrown.pop(0)}", now_ns)
                self._calm_ns = None


def _at_work(nodes: Sequence[FaultyNode]) -> FaultyNode | None:
    """The first node that does what it is for: a drive that is enabled, or without drives a node in operational."""
    wanted = "enabled" if any(node.is_drive for node in nodes) else "operational"
    return next((node for node in nodes if wanted in node.states), None)
