"""The result of a joint's first motion, and the operator who watches it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from canprobe.mechanics.types import Floats

TRAVEL_TOLERANCE_SHARE, TRAVEL_TOLERANCE_RESTS = 0.05, 0.5
"""Tolerance of an encoder's way: this share of the commanded way, but at least this part of `rest_counts`."""


class Answer(Enum):
    """The answer of an operator."""

    YES = "yes"
    NO = "no"
    QUIT = "quit"


class Operator(Protocol):
    """A person who watches the arm. The cell goes on meanwhile: `answer` never waits."""

    def ask(self, question: str) -> None:
        """Put a question."""

    def answer(self) -> Answer | None:
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
    """

    joint: int
    start: float
    asked: float = 0.0
    moved: float = 0.0
    fault: str | None = None
    skipped: str | None = None
    unit: str = "deg"

    def __str__(self) -> str:
        where = f"joint {self.joint + 1} at {self.start:.2f} {self.unit}: "
        if self.skipped is not None:
            return where + f"not moved, {self.skipped}"
        way = f"asked {self.asked:+.2f} {self.unit}, {VERBS[self.unit][1]} {self.moved:+.2f} {self.unit}"
        return where + way + (f": {self.fault}" if self.fault is not None else ": as expected")


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
