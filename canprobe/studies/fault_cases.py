"""What a seed of the fault campaign stands for: a scenario, and one to three faults at random times in its phases."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from random import Random

from canprobe.emulator.faults import Fault, FaultKind
from canprobe.studies.fault_scenes import SCENARIOS, scenario_plan

PHASES = ("bring-up", "approach", "scan", "retreat", "stop")
"""`listen` knows no approach and no retreat, `free` no retreat; what it has before its motion is the enabling."""
FILES_EVERY = 8
"""One run in so many writes its frames down, and is scored on that."""
SENSOR_SHARE = 0.3
Windows = Mapping[str, tuple[int, int]]
"""Phase → when it begins and ends in a run without faults, ns."""
_KINDS = tuple(FaultKind)
_BOTH_WAYS = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE, FaultKind.CORRUPT)
"""A frame that the wire corrupts is dropped for its CRC-15, all but one in 10¹⁰; one that is corrupted here stands for
what goes wrong behind it: in a controller's memory, a driver, a gateway."""
_NEED_TIME = (FaultKind.BABBLE, FaultKind.DELAY, FaultKind.REORDER)
"""Kinds whose effect is that of frames in each other's way, or of their order."""


@dataclass(frozen=True, slots=True)
class FaultCase:
    """One run.

    Attributes:
        seed: of everything random in the run.
        scenario: one of `SCENARIOS`.
        phase: in which the first fault begins.
        faults: what happens.
        timed: frames take their time on the wire.
        files: the frames are written down.
    """

    seed: int
    scenario: str
    phase: str
    faults: tuple[Fault, ...]
    timed: bool = False
    files: bool = True


def draw_case(seed: int, windows_of: Callable[[str, bool], Windows]) -> FaultCase:
    """The case of a seed.

    Args:
        seed: which.
        windows_of: the windows of a scenario, timed or not.
    """
    rng = Random(f"fault campaign {seed}")
    (scenario,) = rng.choices(tuple(SCENARIOS), [scenario.share for scenario in SCENARIOS.values()])
    number = rng.choice((1, 1, 1, 1, 1, 1, 2, 2, 3))
    known = tuple(windows_of(scenario, True))
    phases = [rng.choice(known) for _ in range(number)]
    kinds = [rng.choice(_KINDS) for _ in range(number)]
    # an untimed bus configures all nodes at one instant: no fault could begin within it
    timed = "bring-up" in phases or any(kind in _NEED_TIME for kind in kinds) or rng.random() < 0.1
    windows = windows_of(scenario, timed)
    nodes = scenario_plan(scenario, timed).node_ids
    drawn = zip(kinds, phases, strict=True)
    faults = tuple(_draw_fault(rng, kind, nodes, windows[phase]) for kind, phase in drawn)
    return FaultCase(seed, scenario, phases[0], faults, timed, seed % FILES_EVERY == 0)


def _draw_fault(rng: Random, kind: FaultKind, nodes: tuple[int, ...], window: tuple[int, int]) -> Fault:
    amount = rng.uniform(2e5, 2e6) if kind is FaultKind.BABBLE else 10 ** rng.uniform(5.0, 7.5)
    return Fault(
        kind,
        node_id=nodes[-1] if rng.random() < SENSOR_SHARE else rng.choice(nodes),
        start_ns=rng.randrange(*window),
        duration_ns=int(10 ** rng.uniform(6.0, 8.7)),
        share=rng.choice((1.0, 1.0, 0.5, 0.1)),
        incoming=kind is FaultKind.DEAF or (kind in _BOTH_WAYS and rng.random() < 0.4),
        amount_ns=int(amount),
        seed=rng.randrange(2**32),
    )
