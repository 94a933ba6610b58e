"""What a joint's first motion showed, and the operator who looks at it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
TOLERANCE, TOLERANCE_COUNTS = 0.05, 4
"""How far an encoder's way may be from what was asked: this share, but at least so many counts."""


class Answer(Enum):
    """What an operator says."""

    YES = "yes"
    NO = "no"
    QUIT = "quit"


class Operator(Protocol):
    """Somebody who looks at the arm. The cell goes on meanwhile: `answer` never waits."""

    def ask(self, question: str) -> None:
        """Put a question."""

    def answer(self) -> Answer | None:
        """The answer to it, None as long as there is none."""


@dataclass(frozen=True, slots=True)
class JointFinding:
    """What became of one joint.

    Attributes:
        joint: 0 to 5.
        start_deg: where it stood.
        asked_deg: how far it was told to turn; 0 where it was not moved.
        moved_deg: how far it turned, by its own motor's encoder.
        fault: what is wrong; None where nothing is.
        skipped: why it was not moved; None where it was.
    """

    joint: int
    start_deg: float
    asked_deg: float = 0.0
    moved_deg: float = 0.0
    fault: str | None = None
    skipped: str | None = None

    def __str__(self) -> str:
        where = f"joint {self.joint + 1} at {self.start_deg:.2f} deg: "
        if self.skipped is not None:
            return where + f"not moved, {self.skipped}"
        way = f"told {self.asked_deg:+.2f} deg, turned {self.moved_deg:+.2f} deg"
        return where + way + (f": {self.fault}" if self.fault is not None else ", as it must")


def find_fault(joint: int, asked: Vector, moved: Vector) -> str | None:
    """What is wrong with the motors' ways, the joint's own first; None where nothing is.

    Args:
        joint: that was to turn, 0 to 5.
        asked, moved: ways of the motors (6,), counts.
    """
    tolerance = np.maximum(TOLERANCE * np.abs(asked), TOLERANCE_COUNTS)
    wrong = np.abs(moved - asked) > tolerance
    if wrong[joint]:
        share = float(moved[joint] / asked[joint])
        if abs(moved[joint]) <= TOLERANCE_COUNTS:
            return "it did not turn"
        if share < 0:
            return "it turned the wrong way"
        return f"it turned {share:.2f} times as far: gear or encoder resolution"
    if wrong.any():
        other = int(np.argmax(wrong))
        return (
            f"the motor of joint {other + 1} turned by {moved[other]:.0f} counts,"
            f" {asked[other]:.0f} are due to joint {joint + 1}"
        )
    return None
