"""Motion and patch as one answer: straight paths, images that lie, and regions over many draws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from image_models import (
    FORCE,
    NORMAL,
    RADIUS,
    STIFFNESS,
    base_tensor,
    entries,
    exact,
    model,
    samples,
)
from scipy.optimize import minimize

from canprobe.mechanics.touch import (
    ContactSample,
    OnlineEstimator,
    PatchCurvature,
    PatchFusion,
    Prior,
    Slope,
    indentation_from_force,
    make_estimator,
)
from canprobe.mechanics.touch.estimate.observed import CurvatureInformation
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation


def cylinder_touch(x, y, t, moments):
    """A touch on the cylinder of radius 36 mm along x: height over its crown."""
    a = y / 0.036
    normal = np.array([0.0, math.sin(a), math.cos(a)])
    point = 0.036 * normal + [x, 0.0, -0.036]
    T = homogeneous(tangent_rotation(-normal), point + (RADIUS - 0.4e-3) * normal)
    along = T[:3, :2].T @ [0.0, math.cos(a), -math.sin(a)]
    k = np.outer(along, along) / 0.036
    inner = np.array([0.0, 0.0, RADIUS - 0.4e-3])
    return ContactSample(t, point, normal, T, inner, FORCE, moments=exact(entries(k)) if moments else None)


def estimator(method="recursive", *later):
    motion = make_estimator(method, sigma_point=3e-5, sigma_normal=2e-3, memory_m=0.02)
    return OnlineEstimator(motion, PatchFusion(PatchCurvature(model()), 0.02), *later)


def after_path(line, *, moments=True, method="recursive", seed=4):
    rng = np.random.default_rng(seed)
    one = estimator(method)
    for i, (x, y) in enumerate(line):
        touch = cylinder_touch(x, y, i * 5e-3, moments)
        one.add(replace(touch, p_base=touch.p_base + 1e-5 * rng.standard_normal(3)))
    return one


AXIAL = [(x, 0.0) for x in np.arange(0.0, 0.04, 1.25e-4)]
CIRCUMFERENTIAL = [(0.0, y) for y in np.arange(-0.02, 0.02, 1.25e-4)]
WEAVE = [(0.004 * math.sin(y / 2e-3), y) for y in np.arange(-0.02, 0.02, 0.5e-4)]


@pytest.mark.parametrize("method", ["recursive", "ml"])
@pytest.mark.parametrize(("line", "alone"), [(AXIAL, 0.0), (CIRCUMFERENTIAL, 1 / 0.036)])
def test_patch_completes_a_straight_path(method, line, alone):
    without = after_path(line, moments=False, method=method).estimate()
    assert without.method == method
    assert list(without.observed) == [True, False]
    assert without.kappa[0] == pytest.approx(alone, abs=0.6)
    both = after_path(line, method=method).estimate()
    assert both.method == f"{method}+patch"
    assert both.rank == 3
    np.testing.assert_allclose(both.kappa, [1 / 0.036, 0.0], atol=0.6)
    assert abs(both.directions[0] @ [1.0, 0.0, 0.0]) < 0.03  # the larger one lies across the axis
    assert np.linalg.eigvalsh(both.covariance)[0] > 0.0
    np.testing.assert_array_equal(both.T_frame_contact, without.T_frame_contact)


def across(estimate, direction=(0.0, 1.0, 0.0)):
    """Standard deviation of the curvature across the axis, or along another direction, 1/m."""
    x, y = estimate.T_frame_contact[:3, :2].T @ direction
    weights = np.array([x * x, 2 * x * y, y * y])
    return math.sqrt(weights @ estimate.covariance @ weights)


def lies(factor):
    """The answers along an axial path under images whose moments are too large."""
    one = after_path(AXIAL, moments=False)
    for i, (x, y) in enumerate(AXIAL[-80:]):
        touch = cylinder_touch(x, y, 10.0 + i * 5e-3, True)
        one.add(replace(touch, moments=tuple(factor * m for m in touch.moments)))
        if i % 8 == 7:
            yield one.estimate()


def test_images_that_lie_widen_what_both_know_until_nothing_is_observed():
    """The curvature along the path stays the motion's, ever less certain."""
    before = 0.0
    for factor in (1.0, 1.01, 1.02, 1.03):
        answer = list(lies(factor))[1]
        ex = answer.T_frame_contact[:3, :2].T @ [1.0, 0.0, 0.0]
        assert 2.0 * ex @ answer.S[:2, :2] @ ex == pytest.approx(0.0, abs=0.5)
        sigma = across(answer, [1.0, 0.0, 0.0])
        assert sigma > before
        before = sigma
    for answer in list(lies(2.0))[1:]:
        assert "the patch contradicts the motion" in answer.notes
        assert answer.rank == 0


@pytest.fixture(scope="module")
def touches():
    """A touch whose patch is longer along x."""
    return samples(base_tensor(np.diag([-6.0, 27.8])), NORMAL, FORCE, exact, 12)


class TestFusion:
    """Informations are added; nothing jumps."""

    T = homogeneous(tangent_rotation(-NORMAL), np.zeros(3))

    def patch(self, touches, scale=1.0):
        found = PatchCurvature(model())
        for touch in touches:
            found.add(replace(touch, moments=tuple(scale * m for m in touch.moments)))
        return found

    def test_it_is_the_minimum_of_both_costs(self, touches):
        """Against a general minimiser."""
        patch, rng, m = self.patch(touches), np.random.default_rng(5), model()
        A = rng.normal(size=(3, 3))
        information = A @ A.T + 0.3 * np.eye(3)
        motion = CurvatureInformation(np.array([-4.0, 0.8, 26.5]), information)
        v = exact((-6.0, 0.0, 27.8))

        def cost(q):
            _, r, W = m.linearised(v, FORCE, 12, (q[0], q[1] / math.sqrt(2.0), q[2]))
            return (q - motion.q) @ information @ (q - motion.q) + r @ W @ r

        best = minimize(cost, motion.q, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9}).x
        found = patch.fuse(self.T, motion)
        assert found.q == pytest.approx(best, abs=0.03)  # W moves with q, which steps leave out
        assert not found.contradicted
        assert np.linalg.norm(found.q - motion.q) > 0.3
        assert np.linalg.norm(found.q - [-6.0, 0.0, 27.8]) > 0.2

    def test_no_jump_where_images_leave_what_the_motion_believes_and_the_calibration(self, touches):
        motion = CurvatureInformation(np.array([-5.0, 0.0, 26.0]), np.diag([4.0, 4.0, 0.5]))
        scales = np.linspace(0.6, 1.6, 401)
        found = [one for s in scales if (one := self.patch(touches, s).fuse(self.T, motion))]
        assert len(found) > 380
        believed = [one.q for one in found if not one.contradicted]
        assert len(believed) > 30
        assert np.abs(np.diff(believed, axis=0)).max() < 0.4
        assert found[-1].contradicted  # nobody believes moments that are 60 % too large


def test_a_standing_contact_is_answered_by_the_patch_alone_and_a_reset_forgets_both():
    one = estimator()
    for i in range(20):
        one.add(cylinder_touch(0.0, 0.0, i * 5e-3, True))
    answer = one.estimate()
    assert answer.method == "patch"
    np.testing.assert_allclose(answer.kappa, [27.8, 0.0], atol=0.05)
    one.reset()
    assert one.estimate() is None


def test_a_sample_that_the_motion_drops_is_not_taken_from_the_patch_either():
    motion, patch = make_estimator("recursive", sigma_point=3e-5, sigma_normal=2e-3), PatchCurvature(model())
    one = OnlineEstimator(motion, PatchFusion(patch, 0.02))
    one.add(cylinder_touch(0.0, 0.0, 1.0, True))
    one.add(cylinder_touch(0.0, 0.0, 1.0, True))
    assert one.dropped.repeated == 1
    assert patch.frames == 1


def test_a_prior_on_curvature_counts_once_and_the_patch_still_observes():
    motion = make_estimator("ml", sigma_point=3e-5, sigma_normal=2e-3, prior=Prior.flat(0.02, 10.0))
    one = OnlineEstimator(motion, PatchFusion(PatchCurvature(model()), 0.02))
    for i, (x, y) in enumerate(AXIAL[:160]):
        one.add(cylinder_touch(x, y, i * 5e-3, True))
    before, both = motion.estimate(), one.estimate()
    assert before.rank < 3
    assert both.rank == 3
    assert both.prior == before.prior
    # the prior pulls 27.8 towards 0 by the ratio of its information to that of the patch and its own
    pull = both.covariance.trace() / 10.0**2
    assert 0.0 < pull < 0.03
    assert both.kappa[0] == pytest.approx((1 / 0.036) * (1.0 - pull), abs=0.25)


def test_stiffness_follows_from_the_images_where_the_motion_knows_curvature():
    """The slope of the touch is 10 % off. Along a weave k gets better, and it does not jump from answer to answer."""
    slope = Slope(1.1 / indentation_from_force(1.0, STIFFNESS, RADIUS, (27.8, 0.0)), 30.0)
    motion = make_estimator("recursive", sigma_point=3e-5, sigma_normal=2e-3, memory_m=0.02)
    one, found = OnlineEstimator(motion, PatchFusion(PatchCurvature(model(), 0.6), 0.02)), []
    for i, (x, y) in enumerate(WEAVE + WEAVE[::-1]):
        one.add(replace(cylinder_touch(x, y, i * 5e-3, True), slope=slope))
        if i % 20 == 19:
            found.append(math.log(one.estimate().stiffness / STIFFNESS))
    assert found[0] > 0.08
    assert abs(found[-1]) < 0.4 * found[0]
    assert np.abs(np.diff(found)).max() < 0.02
