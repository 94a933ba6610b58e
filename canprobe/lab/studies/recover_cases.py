"""Cases of study `faults --recover`: what a cell loses while it works, when and for how long, from a seed.

What is lost: power of a node or of all nodes, the link of a node (bus-off), its SYNC or its heartbeats, its state by
itself, the interface of the master, or the master's own time; one of them or a pair, while the arm holds, moves,
presses or scans.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from random import Random
from types import MappingProxyType
from typing import Any

SCENES: Mapping[str, str] = MappingProxyType({"hold": "free", "free": "free", "press": "press", "scan": "plane"})
"""Scene of each kind of work."""
LOST: Mapping[str, str] = MappingProxyType(
    {
        "reboot": "reboot",
        "bus-off": "bus-off",
        "freeze": "freeze",
        "sync-lost": "sync-lost",
        "heartbeat-off": "heartbeat-off",
        "nmt-reset": "nmt command=129",
        "nmt-preop": "nmt command=128",
    }
)
"""Faults of a node in the words of the registry, by name."""
POWER, REPLUG, STALL = "power", "replug", "stall"
"""All nodes are without power; the interface of the master is down; the master itself stands still."""
BOOTING = frozenset(("reboot", "nmt-reset", POWER))
"""Outages after which a node boots."""
AT_ONCE = frozenset(("nmt-reset", "nmt-preop"))
"""Outages that have no length: the node is back at once."""
BEGIN_S, END_S = 0.3, 3.0
"""Time of the first loss after the first cycle of the task."""


@dataclass(frozen=True, slots=True)
class Outage:
    """One thing that is lost.

    Attributes:
        name: key of `LOST`, `POWER`, `REPLUG` or `STALL`.
        node_id: the node; 0 for all nodes, or the master.
        after_s: time of the loss after the first cycle of the task.
        lasts_ms: how long it lasts; 0 of `AT_ONCE`.
    """

    name: str
    node_id: int
    after_s: float
    lasts_ms: int

    @property
    def ends_s(self) -> float:
        """Time of its end after the first cycle of the task."""
        return self.after_s + self.lasts_ms * 1e-3

    def nodes(self, node_ids: Collection[int]) -> tuple[int, ...]:
        """The nodes that it takes away, of those of the cell."""
        return tuple(node_ids) if self.name == POWER else (self.node_id,) if self.node_id else ()

    def fault(self, node_id: int, after_s: float) -> str:
        """The outage of a node as text for the registry, to begin in a time."""
        words = LOST["reboot" if self.name == POWER else self.name]
        lasts = f" for {self.lasts_ms} ms" if self.lasts_ms else ""
        return f"node {node_id}: {words} at {after_s:.4f} s{lasts}"

    def __str__(self) -> str:
        who = f" of node {self.node_id}" if self.node_id else ""
        lasts = f" for {self.lasts_ms} ms" if self.lasts_ms else ""
        return f"{self.name}{who} at {self.after_s:g} s{lasts}"


@dataclass(frozen=True, slots=True)
class RecoverCase:
    """One run.

    Attributes:
        seed: seed that it follows from.
        work: what the cell does: a key of `SCENES`.
        outages: what is lost, in order.
    """

    seed: int
    work: str
    outages: tuple[Outage, ...]

    def __str__(self) -> str:
        return f"{self.work}: " + "; ".join(map(str, self.outages))


def draw_case(seed: int) -> RecoverCase:
    """The run of a seed: every other one has a pair, whose second outage begins 1 ms to 3 s after the first."""
    rng = Random(seed)
    work = rng.choice([*SCENES])
    nodes = (*range(1, 7), *((16,) if work in ("press", "scan") else ()))
    outages = []
    after_s = rng.uniform(BEGIN_S, END_S)
    for _ in range(rng.choice((1, 2))):
        name = rng.choice((*LOST, "reboot", POWER, REPLUG, STALL))
        node_id = rng.choice(nodes) if name in LOST else 0
        lasts_ms = 0 if name in AT_ONCE else round(10 ** rng.uniform(1.0, 3.5))
        outages.append(Outage(name, node_id, round(after_s, 4), lasts_ms))
        after_s += 10 ** rng.uniform(-3.0, 0.5)
    return RecoverCase(seed, work, tuple(outages))


def shrink(case: RecoverCase, run: Callable[[RecoverCase], Mapping[str, Any]]) -> RecoverCase:
    """The case with the fewest outages that still fails when it is run; the case itself where none of them does."""
    for i in range(len(case.outages)):
        fewer = replace(case, outages=case.outages[:i] + case.outages[i + 1 :])
        if fewer.outages and run(fewer)["failures"]:
            return shrink(fewer, run)
    return case
