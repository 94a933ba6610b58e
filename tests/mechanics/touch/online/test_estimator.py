"""The way of an answer: stages in their order, contacts that the motion has used, and a reset of all."""

from dataclasses import replace

import numpy as np

from canprobe.mechanics.touch import ContactSample, OnlineEstimator, make_estimator
from canprobe.mechanics.touch.online.estimator import AnswerStage


class Noting(AnswerStage):
    """A stage that adds its name to an answer's notes, and keeps what it was given."""

    def __init__(self, name):
        self.name, self.taken, self.resets = name, [], 0

    def take(self, sample):
        self.taken.append(sample)

    def refine(self, answer, sample):
        assert sample is self.taken[-1]
        return None if answer is None else replace(answer, notes=(*answer.notes, self.name))

    def reset(self):
        self.resets += 1


def test_stages_refine_in_order_what_the_motion_has_used(truth):
    first, second = Noting("first"), Noting("second")
    motion = make_estimator("recursive", sigma_point=2e-5, sigma_normal=1e-3)
    one = OnlineEstimator(motion, first, second)
    assert one.estimate() is None
    path = truth.path("sphere")
    for sample in truth.samples(path.points, path.normals):
        one.add(sample)
        one.add(ContactSample(sample.t_s, sample.p_base * np.nan, sample.n_base, np.eye(4), sample.r_probe, 1.0))
    assert one.estimate().notes == ("first", "second")
    assert np.array_equal(one.estimate().K, motion.estimate().K)
    assert len(first.taken) == len(second.taken) == one.dropped.not_finite == 160
    one.reset()
    assert one.estimate() is None and (first.resets, second.resets) == (1, 1)
