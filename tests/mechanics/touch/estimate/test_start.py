"""The first stretch of the filter: one Gauss–Newton step at a time comes to what the full iteration finds."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.mechanics.touch import ContactSample, Prior, make_estimator
from canprobe.mechanics.touch.estimate import start as first_stretch
from canprobe.mechanics.touch.estimate.estimator import at_once
from canprobe.mechanics.touch.estimate.gate import MeasuredContact
from canprobe.mechanics.touch.estimate.information import batch_design
from canprobe.mechanics.touch.estimate.nonlinear import fit
from canprobe.mechanics.touch.estimate.start import MAX_CONTACTS, TAKEOVER_SHARE, Start, isolation

MEMORY, SIGMA = 0.02, (2e-5, 1e-3)
PRIOR = Prior.weak(MEMORY)


def touches(truth, name, seed, n=72):
    path = truth.path(name, T=truth.any_pose(seed))
    p, normals = path.noisy(*SIGMA, seed)
    return [MeasuredContact(a, b, SIGMA[0], *SIGMA) for a, b in zip(p[-n:], normals[-n:], strict=True)]


def stepwise(found, each=4):
    start = Start(MEMORY, PRIOR)
    for i in range(0, len(found), each):
        at_once(start.adding(found[i : i + each], each * 0.125e-3))
    return start


@pytest.mark.parametrize("name", ["plane", "ellipsoid"])
def test_it_has_settled_where_the_full_iteration_ends(name, truth):
    for seed in range(4):
        found = touches(truth, name, seed)
        start = stepwise(found)
        assert start.over
        assert start.steady
        full = fit(batch_design(start.T, MEMORY, found), PRIOR.rows(MEMORY))
        assert full.converged
        off = full.root @ (start.solution.target - full.c)
        assert off @ off < 0.01**2  # a hundredth of a standard deviation
        ratio = start.solution.root @ np.linalg.inv(full.root)
        assert np.linalg.svd(ratio, compute_uv=False) == pytest.approx(np.ones(9), abs=0.02)


def test_isolated_points_stand_out_and_the_others_do_not():
    rng = np.random.default_rng(0)
    x = np.outer(np.arange(60) * 0.125e-3, [0.6, 0.8, 0.0]) + 2e-5 * rng.normal(size=(60, 3))
    x[[0, 20, 21, 59]] += [0.0, 0.0, 3e-3]
    weight = isolation(x, np.full(60, 4e-10))
    assert (weight[[0, 20, 21, 59]] < 0.01).all()
    assert np.mean(np.delete(weight, [0, 20, 21, 59]) == 1.0) > 0.9
    assert (isolation(1e-3 * np.arange(30.0).reshape(10, 3), np.full(10, 1e-10))[2:-2] == 1.0).all()
    assert (isolation(x[:4], np.full(4, 1e-10)) == 1.0).all()


@pytest.fixture
def evaluations(monkeypatch):
    """Sizes of the batches that are evaluated: work is counted, not timed."""
    sizes = []
    linearise = first_stretch.linearise

    def counted(c, d):
        sizes.append(len(d.X))
        return linearise(c, d)

    monkeypatch.setattr(first_stretch, "linearise", counted)
    return sizes


@pytest.mark.parametrize(("way", "pace", "share"), [("weave", 0.125e-3, 0.1), ("straight", 0.02e-3, 0.0)])
def test_no_sample_evaluates_the_stretch_more_than_four_times(way, pace, share, truth, evaluations):
    s = np.arange(0.0, 0.6 * MEMORY, pace)
    y = 2e-3 * np.sin(s / 1e-3) if way == "weave" else 0.0 * s
    path = truth.placed(truth.surface("cylinder"), s, y)
    p, n = path.noisy(*SIGMA, 1)
    rng = np.random.default_rng(2)
    wrong = rng.random(len(p)) < share
    p[wrong] += 5e-3 * rng.normal(size=(int(wrong.sum()), 3))
    estimator = make_estimator("recursive", sigma_point=SIGMA[0], sigma_normal=SIGMA[1])
    most, total = 0, 0
    for i, (point, normal) in enumerate(zip(p, n, strict=True)):
        estimator.add(ContactSample(0.005 * i, point, normal, np.eye(4), np.array([0.0, 0.0, 0.04]), 1.0))
        most, total = max(most, len(evaluations)), total + len(evaluations)
        assert max(evaluations, default=0) <= MAX_CONTACTS
        evaluations.clear()
    assert 2 <= most <= 4
    assert total <= 4 * (2 * TAKEOVER_SHARE) / 0.025 + 4


def test_the_first_step_of_a_path_at_pace_is_not_crowded_that_of_a_contact_at_rest_is(truth):
    """Points from before there is a mean are no part of the first step's length; 16 on one spot are believed less."""
    counted = []
    for waits in (0, 40):
        path = truth.path("cylinder")
        rest = np.zeros(waits, dtype=int)
        order = np.concatenate([rest, np.arange(len(path.points))])
        settings = {"sigma_point": 1e-6, "sigma_normal": 1e-3, "memory_m": MEMORY, "window": 160}
        estimator = make_estimator("recursive", **settings)
        for i, sample in enumerate(truth.samples(path.points[order], path.normals[order])):
            estimator.add(sample)
            if (found := estimator.estimate()) is not None:
                counted.append((found.samples, min(i + 1, 16)))
                break
    (at_pace, taken), (at_rest, kept) = counted
    assert at_pace == taken
    assert at_rest < 0.8 * kept
