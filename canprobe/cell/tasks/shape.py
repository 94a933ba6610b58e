"""The estimator in the loop: what it is fed, and how its answer reaches the servo and the log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING

import numpy as np

from canprobe.touch.estimators.base import answering

if TYPE_CHECKING:
    from canprobe.touch.contact import ContactSample
    from canprobe.touch.estimate import SurfaceEstimate
    from canprobe.touch.estimators import Estimator
    from canprobe.touch.estimators.base import Answering


PARTS = 6
"""Of the longest answer: where fewer contacts come between two answers, several are worked out after each."""
GAP_S = 0.1
"""Time without contact after which an estimator starts afresh: a contact that is regained may be of another surface."""
SHARPEST = 1e3
"""1/m; no pad feels a ball of 1 mm, so an answer beyond it has diverged."""


@dataclass(frozen=True, slots=True)
class ShapeRecord:
    """One estimate with its place in the run.

    Attributes:
        t_s: instant of its last sample, on the cycle's clock, s.
        travelled_m: path of the contact since the start of the scan, m.
        estimate: the answer, in the base frame's terms.
        told_s: instant of the cycle in which it was told, s.
    """

    t_s: float
    travelled_m: float
    estimate: SurfaceEstimate
    told_s: float


class ShapeTracker:
    """Feeds an estimator with the contacts of a scan and keeps what it said.

    Sensing, taking a contact and answering are each too long to come on top of one another. A contact is taken in the
    cycle after the one that felt it. An answer is worked out in parts, one a contact (see `PARTS`): in the cycle that
    takes it, or in the next where taking it was work itself. It is the answer at the contact after which it was due,
    whatever comes meanwhile.

    Args:
        estimator: the online estimator.
        every: samples between two answers.
        gap_s: time without a contact after which the estimator starts afresh.

    Attributes:
        records: every answer.
        samples: every contact.
        travelled_m: path of the contact, m.
        restarts: how often the estimator diverged and started afresh.
    """

    def __init__(self, estimator: Estimator, every: int, gap_s: float = GAP_S) -> None:
        self.records: list[ShapeRecord] = []
        self.samples: list[ContactSample] = []
        self.travelled_m = 0.0
        self.restarts = 0
        self._estimator = estimator
        self._every = max(1, every)
        self._at_once = -(-PARTS // self._every)
        self._gap_s = gap_s
        self._last: ContactSample | None = None
        self._waiting: ContactSample | None = None
        self._owed = False
        self._due = False
        self._answering: Answering | None = None
        self._place = (0.0, 0.0)

    def add(self, sample: ContactSample) -> None:
        """Hear of one contact."""
        if self._waiting is not None:
            self._take(self._waiting)
        if self._last is not None:
            if sample.t_s - self._last.t_s > self._gap_s:
                self._estimator.reset()
                self._due, self._answering = False, None
            else:
                self.travelled_m += float(np.linalg.norm(sample.p_base - self._last.p_base))
        self.samples.append(sample)
        self._last = self._waiting = sample

    def answer(self, t_s: float) -> SurfaceEstimate | None:
        """A cycle's work: take the last contact, or a part of the estimate that is due; it, once, when it is there.

        Args:
            t_s: instant of the cycle, s.
        """
        if self._waiting is not None:
            owed, self._owed = self._owed, True
            if self._take(self._waiting) and not owed:
                return None
        if not self._owed:
            return None
        self._owed = False
        return self._work(t_s, repeat(None, self._at_once))

    def answer_at_once(self, t_s: float) -> SurfaceEstimate | None:
        """All parts of the estimate that is due, in the cycle at an instant (s)."""
        if self._waiting is not None:
            self._take(self._waiting)
        return self._work(t_s, repeat(None))

    def _take(self, sample: ContactSample) -> bool:
        """Whether it was work."""
        self._waiting = None
        self._due = self._due or len(self.samples) % self._every == 0
        return self._estimator.add(sample)

    def _work(self, t_s: float, parts: Iterable[None]) -> SurfaceEstimate | None:
        """So many parts of the estimate that is due or under way, or fewer if it has no more."""
        if self._answering is None:
            if not self._due or self._last is None:
                return None
            self._due = False
            self._place = self._last.t_s, self.travelled_m
            self._answering = answering(self._estimator)
        for _ in parts:
            try:
                next(self._answering)
            except StopIteration as end:
                self._answering = None
                return self._told(end.value, t_s)
        return None

    def _told(self, estimate: SurfaceEstimate | None, t_s: float) -> SurfaceEstimate | None:
        """An estimate with its place on record; None where it has diverged."""
        if estimate is None:
            return None
        if has_diverged(estimate):
            self.restarts += 1
            self._estimator.reset()
            return None
        self.records.append(ShapeRecord(*self._place, estimate, t_s))
        return estimate


def has_diverged(estimate: SurfaceEstimate) -> bool:
    """Whether an answer is none: not finite, or sharper than anything that a pad can feel."""
    known = np.asarray(estimate.kappa)[np.asarray(estimate.observed)]
    finite = np.isfinite(known).all() and np.isfinite(estimate.S).all() and np.isfinite(estimate.T_frame_contact).all()
    return not (finite and bool((np.abs(known) < SHARPEST).all()))


def replay_samples(estimator: Estimator, samples: Sequence[ContactSample], every: int) -> list[ShapeRecord]:
    """Feed recorded contacts to another estimator, as the loop would have."""
    tracker = ShapeTracker(estimator, every)
    for sample in samples:
        tracker.add(sample)
        tracker.answer_at_once(sample.t_s)
    return tracker.records
