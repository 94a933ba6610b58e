"""When the estimator in the loop works, and when its answer is there."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.tasks.shape import MAX_CURVATURE, ShapeRecord, ShapeTracker, replay_samples
from canprobe.mechanics.touch import NoiseLevel, OnlineEstimator, PadLayer, SurfaceMap, make_estimator
from canprobe.mechanics.touch.contact import contact_sample, indentation_from_force
from canprobe.mechanics.touch.estimate.estimator import Estimator
from canprobe.mechanics.touch.map.noise import PAD_NOISE
from canprobe.mechanics.touch.online.estimator import AnswerStage
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation


def contact(t_s, x=0.0):
    return SimpleNamespace(t_s=t_s, p_base=np.array([x, 0.0, 0.0]))


class Counting(Estimator):
    """Answers; remembers of how many contacts it knew."""

    def __init__(self, curvature=10.0):
        self.n, self.resets, self.knew, self._curvature = 0, 0, [], curvature

    def add(self, _):
        self.n += 1

    def reset(self):
        self.n, self.resets = 0, self.resets + 1

    def estimate(self):
        self.knew.append(self.n)
        return SimpleNamespace(
            kappa=np.array([self._curvature, 0.0]),
            observed=np.array([True, True]),
            S=np.eye(4),
            T_frame_contact=np.eye(4),
        )


def touch_of_ball(i):
    """Contact number i of a weave over a ball of 50 mm, 0.125 mm from one to the next, every 5 ms."""
    x = 0.125e-3 * i
    normal = np.array([np.sin(x / 0.05), 0.04 * np.sin(x / 1e-3), 1.0])
    normal /= np.linalg.norm(normal)
    T = homogeneous(tangent_rotation(-normal), 0.0895 * normal)
    return contact_sample(t_s=5e-3 * i, T_base_probe=T, uv=(0.0, 0.0), depth=0.5e-3, radius=0.04, force_n=2.0)


def cycle(tracker, t_s, *, contacts=()):
    """One cycle of a loop: ask, add what was felt, one step once the commands are out; whether an answer was there."""
    reported = tracker.answer(t_s) is not None
    for t in contacts:
        tracker.add(contact(t, 25e-3 * t))
    tracker.work()
    return reported


def test_an_answer_is_there_two_cycles_after_the_contact_that_it_stands_at():
    estimator = Counting()
    tracker = ShapeTracker(estimator, every=2)
    reported = [cycle(tracker, 2.5e-3 * k, contacts=[2.5e-3 * k] if k % 2 == 0 else ()) for k in range(9)]
    assert [k for k, one in enumerate(reported) if one] == [4, 8]
    assert estimator.knew == [2, 4]
    first, second = tracker.records
    assert (first.t_s, first.reported_s) == (5e-3, 10e-3) and (second.t_s, second.reported_s) == (15e-3, 20e-3)


def test_noise_is_no_path():
    """Contacts 0.02 mm apart with a noise of 0.05 mm along each axis, and then at rest: 20 mm, not 100."""
    rng, tracker = np.random.default_rng(3), ShapeTracker(Counting(), every=2)
    for i in range(2000):
        noise = 0.05e-3 * rng.normal(size=3)
        tracker.add(SimpleNamespace(t_s=5e-3 * i, p_base=np.array([0.02e-3 * min(i, 1000), 0.0, 0.0]) + noise))
    assert tracker.travelled_m == pytest.approx(20e-3, rel=0.05)


def test_an_answer_has_the_path_up_to_its_contact():
    tracker = ShapeTracker(Counting(), every=2)
    paths = {}
    for k in range(121):  # a contact of 25 mm/s every second cycle
        cycle(tracker, 2.5e-3 * k, contacts=[2.5e-3 * k] if k % 2 == 0 else ())
        paths[2.5e-3 * k] = tracker.travelled_m
    assert len(tracker.records) == 30
    assert all(record.travelled_m == paths[record.t_s] for record in tracker.records)
    late = tracker.records[-1]
    assert late.reported_s > late.t_s and late.travelled_m > 5e-3
    assert late.travelled_m == pytest.approx(25e-3 * late.t_s, abs=13 * 0.125e-3)  # a dozen contacts behind


class NotedStage(AnswerStage):
    """A stage whose work is a step by itself, and is noted."""

    is_step = True

    def __init__(self, steps):
        self._steps = steps

    def refine(self, answer, sample):
        self._steps.append("stage")
        return answer


def noted(steps, owner, name):
    """Let a method note that it was called."""
    call = getattr(owner, name)

    def calls(*args):
        steps.append(name)
        return call(*args)

    setattr(owner, name, calls)


@pytest.mark.parametrize(("every", "busy"), [(8, 0), (8, 1), (8, 2), (1, 1), (2, 1), (5, 3)])
def test_answers_in_steps_are_those_at_once_and_at_most_one_answer_later(every, busy):
    """A contact in every cycle, or in one of two or three, over a start of the filter and the way behind it.

    Each answer has the values and the time of one that is computed in the cycle of its contact.
    """
    samples = [touch_of_ball(i) for i in range(160)]
    steps, carried = [], []

    def tracker(note):
        motion = make_estimator("recursive", sigma_point=2e-5, sigma_normal=1e-3)
        surface_map = SurfaceMap(PadLayer(0.04, 1.3e8), PAD_NOISE)
        if note:
            noted(steps, motion, "_step")
            noted(steps, motion, "estimate")
            noted(steps, surface_map, "add_samples")
        stages = NotedStage(steps if note else []), NoiseLevel(0.02)
        return ShapeTracker(OnlineEstimator(motion, *stages), every, surface_map)

    at_once, in_steps = tracker(False), tracker(True)
    for sample in samples:
        at_once.add(sample)
        at_once.answer_at_once(sample.t_s)
        for spare in range(busy + 1):
            in_steps.answer(sample.t_s)
            if spare == 0:
                in_steps.add(sample)
            if spare or not busy:
                before = len(steps)
                in_steps.work()
                carried.append(len(steps) - before)
    for _ in range(8):
        in_steps.work()
        in_steps.answer(samples[-1].t_s)
    assert len(in_steps.records) == len(at_once.records) > 0.9 * len(samples) // every
    times = [sample.t_s for sample in samples]
    for one, other in zip(in_steps.records, at_once.records, strict=True):
        assert (one.t_s, one.travelled_m) == (other.t_s, other.travelled_m)
        assert np.array_equal(one.estimate.K, other.estimate.K, equal_nan=True)
        assert np.array_equal(one.estimate.covariance, other.estimate.covariance, equal_nan=True)
        assert times.index(one.reported_s) <= times.index(one.t_s) + every + 1
    assert np.array_equal(in_steps.surface_map.points, at_once.surface_map.points)
    if every == 8:
        assert max(carried) == 1, "no cycle carries two steps"


def test_contacts_faster_than_cycles_are_all_taken():
    estimator = Counting()
    tracker = ShapeTracker(estimator, every=3)
    cycle(tracker, 0.0, contacts=[1e-3 * k for k in range(7)])
    cycle(tracker, 2.5e-3)
    cycle(tracker, 5e-3)
    assert estimator.n == 7 and estimator.knew == [3, 6]
    assert [record.t_s for record in tracker.records] == pytest.approx([2e-3, 5e-3])


def test_a_new_contact_after_a_gap_makes_an_answer_void():
    estimator = Counting()
    tracker = ShapeTracker(estimator, every=2)
    cycle(tracker, 0.0, contacts=[0.0, 2.5e-3])
    cycle(tracker, 2.5e-3)
    tracker.add(contact(1.0))
    assert not any(cycle(tracker, 1.0 + 2.5e-3 * k) for k in range(4))
    assert estimator.resets == 1 and estimator.n == 1 and not tracker.records


def test_a_diverged_answer_starts_the_estimator_afresh():
    estimator = Counting(curvature=2.0 * MAX_CURVATURE)
    tracker = ShapeTracker(estimator, every=2)
    assert not any(cycle(tracker, 5e-3 * k, contacts=[5e-3 * k]) or cycle(tracker, 5e-3 * k) for k in range(5))
    assert tracker.restarts == 2 and estimator.resets == 2 and not tracker.records
    assert estimator.n == 1, "it goes on with the contacts that come"


def failing(whole, *, fails):
    """A call that raises as LAPACK's wrappers do, on its calls of these numbers."""
    calls = iter(range(1000))

    def call(*args):
        if next(calls) in fails:
            raise np.linalg.LinAlgError("matrix is not positive definite")
        return whole(*args)

    return call


def test_a_matrix_that_is_not_definite_withholds_one_answer_and_the_run_goes_on():
    estimator = Counting()
    estimator.estimate = failing(estimator.estimate, fails={1})
    tracker = ShapeTracker(estimator, every=2)
    for k in range(9):
        tracker.add(contact(2.5e-3 * k))
        tracker.answer_at_once(2.5e-3 * k)
    assert [round(record.t_s / 2.5e-3) for record in tracker.records] == [1, 5, 7]
    assert tracker.withheld == 1 and tracker.restarts == 0 and estimator.n == 9


def test_two_answers_in_a_row_that_cannot_be_computed_start_the_estimator_afresh():
    estimator = Counting()
    estimator.estimate = failing(estimator.estimate, fails={1, 2})
    tracker = ShapeTracker(estimator, every=2)
    cycle(tracker, 0.0, contacts=[2.5e-3 * k for k in range(8)])
    cycle(tracker, 2.5e-3)
    assert tracker.withheld == 2 and tracker.restarts == 1
    assert estimator.n == 2 and estimator.knew == [2, 2]


def test_a_contact_that_an_estimator_cannot_take_starts_it_afresh():
    estimator = Counting()
    estimator.add = failing(estimator.add, fails={2})
    tracker = ShapeTracker(estimator, every=2)
    cycle(tracker, 0.0, contacts=[2.5e-3 * k for k in range(6)])
    cycle(tracker, 2.5e-3)
    assert tracker.restarts == 1 and estimator.knew == [2, 1, 3]


def test_recorded_contacts_are_answered_one_by_one():
    samples = [contact(0.005 * k) for k in range(10)]
    assert [r.t_s for r in replay_samples(Counting(), samples, 3)] == [s.t_s for s in samples[2::3]]


def test_settled_contacts_have_the_depth_of_what_is_known_in_the_end():
    """On a sphere of 50 mm: in the first half of the scan k and K are wrong, in all of it the force varies."""
    radius, stiffness, kappa = 0.04, 1.3e8, np.array([20.0, 20.0])
    tracker = ShapeTracker(Counting(), every=10)
    for i in range(40):
        a, force = 0.01 * i, 2.0 + 0.5 * np.sin(i)
        normal = np.array([np.sin(a), 0.0, np.cos(a)])
        depth = indentation_from_force(force, stiffness, radius, kappa)
        T = homogeneous(tangent_rotation(-normal), (0.05 + radius - depth) * normal)
        wrong = depth if i >= 20 else indentation_from_force(force, 0.9 * stiffness, radius, kappa + 5.0)
        tracker.add(contact_sample(
            t_s=0.01 * i, T_base_probe=T, uv=(0.0, 0.0), depth=wrong, radius=radius, force_n=force,
        ))  # fmt: skip
        if i % 10 == 9:
            k = stiffness if i > 30 else 0.9 * stiffness
            known = SimpleNamespace(rank=3, kappa=kappa, stiffness=k)
            tracker.records.append(ShapeRecord(0.01 * i, 0.0, known, 0.01 * i))
    before, after = (
        [np.linalg.norm(sample.p_base) - 0.05 for sample in samples]
        for samples in (tracker.samples, tracker.settled(radius))
    )
    assert np.ptp(before) > 30e-6
    assert np.abs(after).max() < 1e-9
    reach = [
        np.linalg.norm(s.T_base_probe[:3, 3] - s.p_base) - np.linalg.norm(s.r_probe) for s in tracker.settled(radius)
    ]
    assert np.abs(reach).max() < 1e-12


def test_contacts_stay_where_no_answer_knows_the_stiffness():
    tracker = ShapeTracker(Counting(), every=10)
    tracker.add(contact(0.0))
    tracker.records.append(ShapeRecord(0.0, 0.0, SimpleNamespace(rank=3, kappa=np.zeros(2), stiffness=None), 0.0))
    assert tracker.settled(0.04) == list(tracker.samples)
