"""When the estimator in the loop is asked, and how its answer comes in parts."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.tasks.shape import PARTS, SHARPEST, ShapeTracker, replay_samples


def contact(t_s, x=0.0):
    return SimpleNamespace(t_s=t_s, p_base=np.array([x, 0.0, 0.0]))


def estimate(curvature=10.0):
    return SimpleNamespace(
        kappa=np.array([curvature, 0.0]), observed=np.array([True, True]), S=np.eye(4), T_frame_contact=np.eye(4)
    )


class InOne:
    """Tells an answer that names how many samples it rests on."""

    def __init__(self, curvature=10.0, work=()):
        self.n, self.resets, self.asked, self._curvature, self._work = 0, 0, 0, curvature, work

    def add(self, _):
        self.n += 1
        return self.n in self._work

    def reset(self):
        self.n, self.resets = 0, self.resets + 1

    def estimate(self):
        self.asked += 1
        return estimate(self._curvature)


class InParts(InOne):
    def __init__(self, parts=3, **options):
        super().__init__(**options)
        self._parts = parts

    def answering(self):
        for _ in range(self._parts - 1):
            yield
        return self.estimate()


def taken(tracker, times):
    for t in times:
        tracker.add(contact(t, 25e-3 * t))


def answered(tracker, times, calls=2):
    """Whether an answer was there: after each contact, over so many cycles."""
    found = []
    for t in times:
        taken(tracker, [t])
        found.append([tracker.answer(t + 0.1 * k) is not None for k in range(calls)])
    return found


def test_the_cycle_after_a_contact_takes_it_and_answers():
    estimator = InOne()
    tracker = ShapeTracker(estimator, every=2)
    taken(tracker, [0.0])
    assert estimator.n == 0, "the cycle that feels a contact does no more"
    assert tracker.answer(0.0) is None and estimator.n == 1
    assert answered(tracker, [0.005, 0.01], calls=3) == [[True, False, False], [False] * 3]


def test_one_part_is_worked_out_after_each_contact():
    tracker = ShapeTracker(InParts(), every=PARTS)
    found = answered(tracker, [0.005 * k for k in range(18)])
    assert [k for k, calls in enumerate(found) if any(calls)] == [7, 13]
    assert all(calls[1] is False for calls in found)


@pytest.mark.parametrize(("every", "later"), [(1, 0), (2, 1), (3, 2), (4, 2), (5, 2), (6, 5), (100, 5)])
def test_an_answer_is_there_before_the_next_is_due(every, later):
    tracker = ShapeTracker(InParts(PARTS), every)
    found = answered(tracker, [0.005 * k for k in range(2 * every + PARTS)])
    first, second, *_ = [k for k, calls in enumerate(found) if any(calls)]
    assert (first, second) == (every - 1 + later, 2 * every - 1 + later)


def test_where_a_contact_is_work_the_part_waits_for_the_next_cycle():
    tracker = ShapeTracker(InParts(work=(6, 7, 14)), every=PARTS)
    found = answered(tracker, [0.005 * k for k in range(17)])
    assert found[7] == [True, False] and found[13] == [False, True]
    assert sum(map(sum, found)) == 2


def test_contacts_that_are_all_work_and_come_in_every_cycle_leave_every_second_for_an_answer():
    estimator = InParts(work=range(100))
    tracker = ShapeTracker(estimator, every=8)
    found = answered(tracker, [0.0025 * k for k in range(24)], calls=1)
    assert [k for k, calls in enumerate(found) if any(calls)] == [11, 19]
    assert estimator.n == 24


def test_contacts_faster_than_cycles_are_all_taken():
    estimator = InOne()
    tracker = ShapeTracker(estimator, every=2)
    taken(tracker, [0.001 * k for k in range(7)])
    tracker.answer(0.0)
    assert estimator.n == 7


def test_an_answer_stands_at_the_contact_after_which_it_was_due():
    tracker = ShapeTracker(InParts(), every=PARTS)
    taken(tracker, [0.005 * k for k in range(PARTS - 1)])
    assert answered(tracker, [0.025, 0.03, 0.031]) == [[False, False], [False, False], [True, False]]
    (record,) = tracker.records
    assert record.told_s == 0.031
    assert record.t_s == 0.025 and record.travelled_m == pytest.approx(25e-3 * 0.025)


def test_what_is_due_meanwhile_is_begun_afterwards():
    estimator = InParts(8)
    tracker = ShapeTracker(estimator, every=PARTS)
    found = [any(calls) for calls in answered(tracker, [0.005 * k for k in range(21)])]
    assert [k for k, there in enumerate(found) if there] == [12, 20] and estimator.asked == 2


@pytest.mark.parametrize("begun", [True, False])
def test_a_new_contact_makes_an_unfinished_answer_void(begun):
    estimator = InParts(work=() if begun else (PARTS,))
    tracker = ShapeTracker(estimator, every=PARTS)
    answered(tracker, [0.005 * k for k in range(PARTS)], calls=1)
    assert answered(tracker, [1.0], calls=4) == [[False] * 4]
    assert estimator.resets == 1 and not tracker.records


def test_a_diverged_answer_starts_the_estimator_afresh():
    estimator = InParts(curvature=2.0 * SHARPEST)
    tracker = ShapeTracker(estimator, every=1)
    taken(tracker, [0.0])
    assert tracker.answer_at_once(0.0) is None
    assert tracker.restarts == 1 and estimator.resets == 1 and not tracker.records


def test_recorded_contacts_are_answered_one_by_one():
    samples = [contact(0.005 * k) for k in range(10)]
    for estimator in (InOne(), InParts()):
        assert [r.t_s for r in replay_samples(estimator, samples, 3)] == [s.t_s for s in samples[2::3]]
