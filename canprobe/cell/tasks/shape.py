"""The estimator in the loop: what it is fed, and how its answer reaches the servo and the log."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from canprobe.touch.estimators.base import adding, answering

if TYPE_CHECKING:
    from canprobe.touch.contact import ContactSample
    from canprobe.touch.estimate import SurfaceEstimate
    from canprobe.touch.estimators import Estimator
    from canprobe.touch.estimators.base import Adding, Answering


PARTS = 7
"""Of the longest answer: where fewer contacts come between two answers, several are worked out after each. One contact
is left of the eight between two answers by default, as none begins while a contact is being taken."""
BEHIND = 4
"""Contacts that may wait before more than a part of taking them is worked out for each."""
ROUND_S = 2.5e-3
"""Of a cycle, for which a part of each is cut."""
GAP_S = 0.1
"""Time without contact after which an estimator starts afresh: a contact that is regained may be of another surface."""
SHARPEST = 1e3
"""1/m; no pad feels a ball of 1 mm, so an answer beyond it has diverged."""


@dataclass(frozen=True, slots=True)
class ShapeRecord:
    """One estimate with its place in the run.

    Attributes:
        t_s: instant of its last sample, s, since the first SYNC; in results on the run's clock.
        travelled_m: path of the contact since the start of the scan, m.
        estimate: the answer, in the base frame's terms.
        told_s: instant of the cycle in which it was told, s, on the same clock.
    """

    t_s: float
    travelled_m: float
    estimate: SurfaceEstimate
    told_s: float


def on_run_clock(records: Sequence[ShapeRecord], start_s: float) -> list[ShapeRecord]:
    """Estimates of a run in which the first SYNC was due at ``start_s``."""
    return [replace(record, t_s=start_s + record.t_s, told_s=start_s + record.told_s) for record in records]


class _Felt(NamedTuple):
    """A contact that waits to be taken, its number in the scan and how far the path had come (m)."""

    sample: ContactSample
    number: int
    travelled_m: float


class ShapeTracker:
    """Feeds an estimator with the contacts of a scan and keeps what it said.

    The estimator has more to do after some contacts than fits on top of a cycle's other work, so it is done in parts,
    one of each kind in a cycle: taking contacts, which may lag (`BEHIND`), and working out an answer, which is that at
    the contact after which it was due, whatever is felt meanwhile. The cycle that felt a contact does none of it,
    unless the one before felt one too.

    Args:
        estimator: the online estimator.
        every: samples between two answers.
        rounds: how often a cycle may do so; a long one more often.
        gap_s: time without a contact after which the estimator starts afresh.

    Attributes:
        records: every answer.
        samples: every contact.
        travelled_m: path of the contact, m.
        restarts: how often the estimator diverged and started afresh.
    """

    def __init__(self, estimator: Estimator, every: int, rounds: int = 1, gap_s: float = GAP_S) -> None:
        self.records: list[ShapeRecord] = []
        self.samples: list[ContactSample] = []
        self.travelled_m = 0.0
        self.restarts = 0
        self._estimator = estimator
        self._every = max(1, every)
        self._parts = -(-PARTS // self._every)
        self._rounds = rounds
        self._gap_s = gap_s
        self._forget()

    def _forget(self) -> None:
        """Let go of everything under way."""
        self._waiting: deque[_Felt] = deque()
        self._taking: Adding | None = None
        self._taken: _Felt | None = None
        self._due = False
        self._answering: tuple[Answering, _Felt] | None = None
        self._found: tuple[SurfaceEstimate, _Felt] | None = None
        self._felt = False, False  # in the cycle before, in this one

    def add(self, sample: ContactSample) -> None:
        """Hear of one contact."""
        if self.samples:
            last = self.samples[-1]
            if sample.t_s - last.t_s > self._gap_s:
                self._estimator.reset()
                self._forget()
            else:
                self.travelled_m += float(np.linalg.norm(sample.p_base - last.p_base))
        self.samples.append(sample)
        self._waiting.append(_Felt(sample, len(self.samples), self.travelled_m))
        self._felt = self._felt[0], True

    def work(self) -> SurfaceEstimate | None:
        """A cycle's share of the work; the estimate that it came to, which `answer` has yet to tell."""
        (before, felt), self._felt = self._felt, (self._felt[1], False)
        for _ in range(self._rounds if before or not felt else 0):
            self._take_on()
            for _ in range(self._parts):
                self._answer_part()
        return None if self._found is None else self._found[0]

    def answer(self, t_s: float) -> SurfaceEstimate | None:
        """The estimate, once, that has been found since it was last asked for.

        Args:
            t_s: instant of the cycle in which it is told, s.
        """
        if self._found is None:
            return None
        (estimate, at), self._found = self._found, None
        self.records.append(ShapeRecord(at.sample.t_s, at.travelled_m, estimate, t_s))
        return estimate

    def answer_at_once(self, t_s: float) -> SurfaceEstimate | None:
        """Take every contact; the estimate, if one is due, in the cycle at an instant (s)."""
        while self._waiting:
            self._take_part()
        while self._may_begin or self._answering is not None:
            self._answer_part()
        return self.answer(t_s)

    def _take_on(self) -> None:
        """A part of taking contacts, or as many as it takes not to fall behind, and every contact that is no work."""
        left = 1 + (len(self._waiting) - 1) // BEHIND
        while self._waiting and left and not self._may_begin:
            left -= self._take_part()

    def _take_part(self) -> bool:
        """A part of taking the oldest contact; False where it was the only one."""
        begun = self._taking is None
        if self._taking is None:
            self._taking = adding(self._estimator, self._waiting[0].sample)
        for _ in self._taking:
            return True
        self._taking = None
        self._taken = self._waiting.popleft()
        self._due = self._due or self._taken.number % self._every == 0
        return not begun

    @property
    def _may_begin(self) -> bool:
        """Whether an answer is due and none under way; it begins with what is known before another contact is taken."""
        return self._due and self._answering is None and self._taking is None

    def _answer_part(self) -> None:
        """A part of the answer that is under way or may begin."""
        if self._may_begin and self._taken is not None:
            self._due = False
            self._answering = answering(self._estimator), self._taken
        if self._answering is None:
            return
        parts, at = self._answering
        try:
            next(parts)
        except StopIteration as end:
            self._answering = None
            self._keep(end.value, at)

    def _keep(self, estimate: SurfaceEstimate | None, at: _Felt) -> None:
        """An estimate to be told; where it has diverged the estimator starts afresh."""
        if estimate is None:
            return
        if has_diverged(estimate):
            self.restarts += 1
            self._estimator.reset()
            self._taking = None
            return
        self._found = estimate, at


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
