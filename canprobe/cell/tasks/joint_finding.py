"""The result of a joint's first motions, and the operator who watches them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from canprobe.mechanics.types import Floats

TRAVEL_TOLERANCE_SHARE, TRAVEL_TOLERANCE_RESTS = 0.05, 0.5
"""Tolerance of an encoder's way: this share of the commanded way, but at least this part of `rest_counts`."""
SEEN_TOLERANCE_SHARE = 0.25
"""Tolerance of a way that an operator saw, as a share of it: an eye is right within that, and half and twice as far are
outside."""


class Answer(Enum):
    """The answer of an operator."""

    YES = "yes"
    NO = "no"
    QUIT = "quit"


@dataclass(frozen=True, slots=True)
class SeenWay:
    """The way of a motion, as an operator saw or measured it.

    Attributes:
        number: its length; that of a joint is negative in negative direction.
        unit: unit that came with the number, deg or mm; None without one. Millimetres of a joint that turns are those
            of the flange, straight from where it was.
        signed: the number came with a sign; else it goes the way that was asked for.
    """

    number: float
    unit: str | None = None
    signed: bool = True


class Operator(Protocol):
    """A person who watches the arm. The cell goes on meanwhile: `answer` never waits."""

    def ask(self, question: str, *, for_way: bool = False) -> None:
        """Put a question; one for a way may be answered by a number, and yes stands for the way in the question."""

    def answer(self) -> Answer | SeenWay | None:
        """The answer to it; None until it is given."""


VERBS = {"deg": ("turn", "turned"), "mm": ("move", "moved")}
"""Verbs for the motion of a joint, present and past, by its unit."""


@dataclass(frozen=True, slots=True)
class JointFinding:
    """The result of the check of a joint.

    Attributes:
        joint: number of the joint, from 0.
        start: position before the motion, in the joint's unit, as the next two.
        asked: the way of its target; 0 where it was not moved.
        moved: way by its own motor's encoder.
        unit: deg or mm.
        fault: fault that was found; None without one.
        skipped: why it was not moved; None where it was.
        seen: the way that the operator saw, in words; None where nobody saw enough to judge gear and counts.
        unseen: why the operator did not; None where he did, or nobody was asked.
        force: highest force that the array showed meanwhile, N; None without an array that was seen alive.
    """

    joint: int
    start: float
    asked: float = 0.0
    moved: float = 0.0
    fault: str | None = None
    skipped: str | None = None
    unit: str = "deg"
    seen: str | None = None
    unseen: str | None = None
    force: float | None = None

    def __str__(self) -> str:
        where = f"joint {self.joint + 1} at {self.start:.2f} {self.unit}: "
        if self.skipped is not None:
            return where + f"not moved, {self.skipped}"
        way = f"asked {self.asked:+.2f} {self.unit}, {VERBS[self.unit][1]} {self.moved:+.2f} {self.unit}"
        seen = f", seen {self.seen}" if self.seen is not None else ""
        unseen = f"; gear and counts are not known, {self.unseen}" if self.unseen is not None else ""
        return where + way + seen + (f": {self.fault}" if self.fault is not None else f": as expected{unseen}")


def find_seen_fault(seen: float, due: float, unit: str) -> str | None:
    """The fault in the way that an operator saw; None where it is the one that is due, within the tolerance.

    Args:
        seen, due: both ways, in one unit.
        unit: unit of the joint, deg or mm.
    """
    share = seen / due
    if abs(share - 1.0) <= SEEN_TOLERANCE_SHARE:
        return None
    if share < 0.0:
        return f"it {VERBS[unit][1]} the wrong way, as the operator saw it: sign, or polarity (607Eh)"
    return (
        f"it {VERBS[unit][1]} {share:.2f} times as far, as the operator saw it: gear, counts_per_{_OF_COUNTS[unit]}, or"
        " another joint's drive; no encoder shows that"
    )


_OF_COUNTS = {"deg": "turn", "mm": "m"}


def find_fault(joint: int, asked: Floats, moved: Floats, rest: Sequence[float], unit: str = "deg") -> str | None:
    """The fault in the motors' ways, the joint's own first; None without one.

    Args:
        joint: number of the joint that was to move, from 0.
        asked, moved: ways of the motors (n,), drive units.
        rest: distance within which each is at rest (n,), drive units.
        unit: unit of the joint, deg or mm.
    """
    least = TRAVEL_TOLERANCE_RESTS * np.array(rest)
    tolerance = np.maximum(TRAVEL_TOLERANCE_SHARE * np.abs(asked), least)
    wrong = np.abs(moved - asked) > tolerance
    if wrong[joint]:
        share = float(moved[joint] / asked[joint])
        if abs(moved[joint]) <= least[joint]:
            return f"it did not {VERBS[unit][0]}"
        if share < 0:
            return f"it {VERBS[unit][1]} the wrong way"
        return f"it {VERBS[unit][1]} {share:.2f} times as far: gear or encoder resolution"
    if wrong.any():
        other = int(np.argmax(wrong))
        return (
            f"the motor of joint {other + 1} turned by {moved[other]:.0f} counts,"
            f" {asked[other]:.0f} are due to joint {joint + 1}"
        )
    return None
