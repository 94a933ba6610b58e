"""When the estimator in the loop works, and how its answer comes in parts."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.tasks.shape import BEHIND, PARTS, SHARPEST, ShapeTracker, replay_samples


def contact(t_s, x=0.0):
    return SimpleNamespace(t_s=t_s, p_base=np.array([x, 0.0, 0.0]))


def estimate(curvature=10.0):
    return SimpleNamespace(
        kappa=np.array([curvature, 0.0]), observed=np.array([True, True]), S=np.eye(4), T_frame_contact=np.eye(4)
    )


class InOne:
    """Answers at once; remembers of how many contacts it knew."""

    def __init__(self, curvature=10.0):
        self.n, self.resets, self.knew, self._curvature = 0, 0, [], curvature

    def add(self, _):
        self.n += 1

    def reset(self):
        self.n, self.resets = 0, self.resets + 1

    def estimate(self):
        self.knew.append(self.n)
        return estimate(self._curvature)


class InParts(InOne):
    """Answers in so many parts, the first of which knows; contacts whose number is in `work` are taken in three."""

    def __init__(self, parts=3, work=(), **options):
        super().__init__(**options)
        self._parts, self._work = parts, work
        self.begun = self._now = 0

    def adding(self, _):
        self.n += 1
        self.begun += 1
        for _ in range(2 if self.n in self._work else 0):
            self._count()
            yield
        if self.n in self._work:
            self._count()
        self.begun -= 1

    def answering(self):
        assert self.begun == 0, "asked in the middle of taking a contact"
        found = self.estimate()
        for _ in range(self._parts - 1):
            self._count()
            yield
        self._count()
        return found

    def _count(self):
        self._now += 1

    def parts_since(self):
        """Worked out since this was last asked."""
        now, self._now = self._now, 0
        return now


def cycle(tracker, t_s, *, felt):
    """One cycle of a loop: ask, feel or not, work; whether an answer was there."""
    told = tracker.answer(t_s) is not None
    if felt:
        tracker.add(contact(t_s, 25e-3 * t_s))
    tracker.work()
    return told


def answered(tracker, contacts, every=2):
    """At which of the contacts, felt in every second cycle, an answer was told first."""
    told = [cycle(tracker, 2.5e-3 * k, felt=k % every == 0) for k in range(every * contacts)]
    return [k / every for k, there in enumerate(told) if there]


def test_the_cycle_after_a_contact_takes_it_and_the_next_one_tells():
    estimator = InOne()
    tracker = ShapeTracker(estimator, every=2)
    cycle(tracker, 0.0, felt=True)
    assert estimator.n == 0, "the cycle that feels a contact does no more"
    cycle(tracker, 0.0025, felt=False)
    assert estimator.n == 1
    assert [cycle(tracker, 0.005 + 0.0025 * k, felt=k == 0) for k in range(5)] == [False, False, True, False, False]


def test_one_part_of_an_answer_is_worked_out_for_each_contact():
    tracker = ShapeTracker(InParts(3), every=PARTS)
    assert answered(tracker, 3 * PARTS) == [PARTS + 2, 2 * PARTS + 2]


@pytest.mark.parametrize(("every", "later"), [(1, 0), (2, 1), (3, 2), (4, 3), (5, 3), (6, 3), (7, 6), (8, 6), (100, 6)])
def test_an_answer_is_there_before_the_next_is_due(every, later):
    tracker = ShapeTracker(InParts(PARTS), every)
    first, second, *_ = answered(tracker, 2 * every + PARTS + 1)
    assert (first, second) == (every + later, 2 * every + later)


@pytest.mark.parametrize("every", [2, 1])
def test_no_cycle_has_more_than_a_part_of_each(every):
    """Also where a contact is felt in every cycle; and no answer is lost."""
    estimator = InParts(PARTS, work=range(3, 1000, 4))
    tracker = ShapeTracker(estimator, every=PARTS + 1)
    most = told = 0
    for k in range(400):
        told += cycle(tracker, 2.5e-3 * k, felt=k % every == 0)
        most = max(most, estimator.parts_since())
    assert most == 2 and told >= 400 // (every * (PARTS + 1)) - 2, "two are still under way"
    assert estimator.n >= 400 // every - BEHIND - 2


def test_contacts_that_are_all_work_are_taken_and_answered_all_the_same():
    estimator = InParts(PARTS, work=range(1000))
    tracker = ShapeTracker(estimator, every=PARTS)
    told = answered(tracker, 80)
    assert len(told) >= 8 and estimator.n >= 80 - 3 * BEHIND, "three parts each: they wait until three are worked out"


def test_contacts_faster_than_cycles_are_all_taken():
    estimator = InOne()
    tracker = ShapeTracker(estimator, every=2)
    for k in range(7):
        tracker.add(contact(0.001 * k))
    for _ in range(5):
        tracker.work()
    assert estimator.n == 7


def test_an_answer_stands_at_the_contact_after_which_it_was_due():
    work = (PARTS - 1, PARTS, PARTS + 1)
    estimator = InParts(3, work=work)
    tracker = ShapeTracker(estimator, every=PARTS)
    told = answered(tracker, 2 * PARTS)
    (record,) = tracker.records
    assert estimator.knew[0] == PARTS, "it knows of no contact that was felt later"
    assert record.told_s == pytest.approx(5e-3 * told[0])
    assert record.t_s == pytest.approx(5e-3 * (PARTS - 1))
    assert record.travelled_m == pytest.approx(25e-3 * 5e-3 * (PARTS - 1))


def test_long_cycles_have_several_rounds_of_work():
    """Half the rate, half the contacts until an answer is there: it is no older."""
    once, twice = (answered(ShapeTracker(InParts(PARTS), PARTS + 1, n), 3 * PARTS)[0] for n in (1, 2))
    assert (once, twice) == (2 * PARTS, PARTS + 4)


def test_cycles_without_a_contact_go_on_with_the_work():
    """As of a slow sensor, or once a scan is over."""
    tracker = ShapeTracker(InParts(PARTS), every=1)
    cycle(tracker, 0.0, felt=True)
    tracker._parts = 1
    assert [cycle(tracker, 2.5e-3 * k, felt=False) for k in range(1, PARTS + 3)] == [False] * PARTS + [True, False]


def test_what_is_due_meanwhile_is_begun_afterwards():
    estimator = InParts(PARTS + 2)
    tracker = ShapeTracker(estimator, every=PARTS)
    told = answered(tracker, 4 * PARTS)
    assert told == [2 * PARTS + 1, 3 * PARTS + 3]
    assert estimator.knew == [PARTS, 2 * PARTS + 1, 3 * PARTS + 3]


@pytest.mark.parametrize("work", [(), (PARTS,)])
def test_a_new_contact_after_a_gap_makes_everything_unfinished_void(work):
    estimator = InParts(work=work)
    tracker = ShapeTracker(estimator, every=PARTS)
    answered(tracker, PARTS)
    assert not any(cycle(tracker, 1.0 + 2.5e-3 * k, felt=k == 0) for k in range(8))
    assert estimator.resets == 1 and estimator.n == 1 and not tracker.records


def test_a_diverged_answer_starts_the_estimator_afresh():
    estimator = InParts(work=(9,), curvature=2.0 * SHARPEST)
    tracker = ShapeTracker(estimator, every=PARTS)
    assert answered(tracker, PARTS + 4) == []
    assert tracker.restarts == 1 and estimator.resets == 1 and not tracker.records
    assert estimator.n >= 2, "it goes on with the contacts that come"


def test_recorded_contacts_are_answered_one_by_one():
    samples = [contact(0.005 * k) for k in range(10)]
    for estimator in (InOne(), InParts(work=(2, 3, 6))):
        assert [r.t_s for r in replay_samples(estimator, samples, 3)] == [s.t_s for s in samples[2::3]]
