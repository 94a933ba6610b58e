"""The case that a seed draws: a scenario, and one to three faults at random times in its phases."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from random import Random

from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault, FaultKind

PHASES = ("bring-up", "approach", "scan", "retreat", "stop")
"""`listen` has no approach and no retreat, `free` no retreat; the approach of `free` is the enabling."""
FILES_EVERY = 8
"""One run in so many writes its log, and is scored on that."""
SENSOR_SHARE = 0.3
Windows = Mapping[str, tuple[int, int]]
"""Beginning and end of each phase in a run without faults, ns."""
DRAWN_KINDS = (
    "drop",
    "delay",
    "duplicate",
    "corrupt",
    "reorder",
    "mute",
    "deaf",
    "reboot",
    "freeze",
    "babble",
    "wrong-data",
)
"""Kinds of the registry that the study draws."""
KINDS = tuple(BUS_FAULTS[name] for name in DRAWN_KINDS)
_BOTH_WAYS = ("drop", "delay", "duplicate", "corrupt")
"""A frame that the wire corrupts is dropped for its CRC-15, all but one in 10¹⁰; a frame that is corrupted here stands
for errors behind it: in a controller's memory, a driver, a gateway."""
NEED_TIME = ("babble", "delay", "reorder")
"""Kinds that act by the time that frames take on the bus, or by their order."""


@dataclass(frozen=True, slots=True)
class FaultCase:
    """One run.

    Attributes:
        seed: seed of everything random in the run.
        scenario: one of `SCENARIOS`.
        phase: phase in which the first fault begins.
        faults: the drawn faults.
        timed: whether frames take time on the bus.
        files: whether the run writes its log.
    """

    seed: int
    scenario: str
    phase: str
    faults: tuple[Fault, ...]
    timed: bool = False
    files: bool = True


def draw_fault(rng: Random, kind: FaultKind, nodes: tuple[int, ...], window: tuple[int, int]) -> Fault:
    amount_ns = rng.uniform(2e5, 2e6) if kind.name == "babble" else 10 ** rng.uniform(5.0, 7.5)
    return Fault(
        kind,
        node_id=nodes[-1] if rng.random() < SENSOR_SHARE else rng.choice(nodes),
        start_ns=rng.randrange(*window),
        duration_ns=int(10 ** rng.uniform(6.0, 8.7)),
        share=rng.choice((1.0, 1.0, 0.5, 0.1)),
        incoming=kind.name in _BOTH_WAYS and rng.random() < 0.4,
        values={name: int(amount_ns) * 1e-6 for name in ("ms", "gap_ms") if name in kind.parameters},
        seed=rng.randrange(2**32),
    )
