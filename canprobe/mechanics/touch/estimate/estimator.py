"""The interface of an online estimator, whose work is done at once or in steps."""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING, TypeAlias, TypeVar

if TYPE_CHECKING:
    from canprobe.mechanics.touch.contact import ContactSample
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
    from canprobe.mechanics.touch.estimate.gate import Dropped

T = TypeVar("T")
Steps: TypeAlias = Generator[None, None, T]
"""Work that pauses at each `yield`, and its result."""


def at_once(steps: Steps[T]) -> T:
    """Do all steps; their result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


class Estimator:
    """Local shape from a stream of contacts.

    A loop that has no time for all of `add` or `estimate` takes `adding` and `answering`, the same in steps of half a
    millisecond. Until the last step nothing else may be asked of the estimator. A subclass writes one of each pair, and
    has the other.

    Attributes:
        dropped: samples that were not used, by reason.
    """

    dropped: Dropped

    def add(self, sample: ContactSample) -> None:
        """Take one contact; a sample that cannot be used is dropped and counted, never an error."""
        at_once(self.adding(sample))

    def adding(self, sample: ContactSample) -> Steps[None]:
        """Take one contact, in steps."""
        self.add(sample)
        yield from ()

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact, or None before there is any."""
        return at_once(self.answering())

    def answering(self) -> Steps[SurfaceEstimate | None]:
        """The answer at the last contact, in steps."""
        yield from ()
        return self.estimate()

    def reset(self) -> None:
        """Forget everything but the settings: contact was lost, or the array was reset."""
