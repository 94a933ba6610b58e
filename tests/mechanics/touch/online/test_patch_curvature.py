"""Curvature from the moments of a contact's images alone: rotations of scipy as truth, regions over many touches."""

import math
from dataclasses import replace

import numpy as np
import pytest
from image_models import (
    FORCE,
    HERE_FLOOR,
    NORMAL,
    PARAMETERS,
    RADIUS,
    STIFFNESS,
    base_tensor,
    entries,
    exact,
    model,
    samples,
    tensor,
)
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch import PatchCurvature, Slope, indentation_from_force
from canprobe.mechanics.touch.contact import direction_to_pad
from canprobe.mechanics.touch.estimate.noise import CHI2_95
from canprobe.mechanics.touch.image.moments import PadMemory
from canprobe.mechanics.touch.online.patch_curvature import MAX_RECENT_FRAMES, MIN_FRAMES, RECENT_OUTLIER_SHARE, _Mean
from canprobe.mechanics.touch.online.patch_fusion import patch_estimate
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation


def alone(patch, touches):
    """The patch's answer at the last of some touches that it takes."""
    for touch in touches:
        patch.add(touch)
    return patch_estimate(touches[-1], patch, 0.02)


@pytest.mark.parametrize(("spin", "off_pole"), [(0.0, (0.0, 0.0)), (0.8, (0.2, -0.1))])
def test_curvature_of_a_standing_touch_in_base_whatever_the_pad_s_attitude(spin, off_pole):
    truth = base_tensor(tensor(27.8, -6.0, 0.5))
    touches = samples(truth, NORMAL, FORCE, exact, 20, spin=spin, off_pole=off_pole)
    estimate = alone(PatchCurvature(model()), touches)
    assert estimate.method == "patch"
    assert estimate.rank == 3
    assert estimate.observed.all()
    np.testing.assert_allclose(estimate.kappa, [27.8, -6.0], atol=0.02)
    P = estimate.T_frame_contact[:3, :2]
    np.testing.assert_allclose(P @ estimate.K @ P.T, truth, atol=0.02)


@pytest.mark.parametrize(("k", "force"), [(20.0, 1.0), (0.0, 3.0)])
def test_regions_hold_what_an_array_of_the_make_with_another_blur_shows(k, force):
    array, other = (model(replace(PARAMETERS, blur=share * PARAMETERS.blur)) for share in (1.15, 1.2))
    touches = samples(k * base_tensor(np.eye(2)), NORMAL, force, lambda q: array.moments(q, force), 20)
    squares = []
    for others in ((), (other,)):
        found = alone(PatchCurvature(model(), others=others), touches)
        error = np.array(entries(found.K)) - [k, 0.0, k]
        squares.append(error @ np.linalg.solve(found.covariance, error))
    assert squares[0] > CHI2_95 > squares[1]


def test_axes_are_carried_along_a_contact_that_rolls_and_spins():
    truth = tensor(27.8, -6.0, 0.5)
    patch = PatchCurvature(model())
    start = tangent_rotation(-NORMAL)
    turn = np.array([0.3, 0.1, 0.0]) @ start.T  # the normal turns about an axis in the tangent plane
    for i in range(64):
        R = Rotation.from_rotvec(turn * i / 63).as_matrix()
        normal = R @ NORMAL
        here = R @ start[:, :2]
        touch = samples(here @ truth @ here.T, normal, FORCE, exact, 1, spin=0.05 * i, off_pole=(0.1, 0.1))[0]
        patch.add(touch)
    found = patch_estimate(touch, patch, 0.02)
    P = found.T_frame_contact[:3, :2]
    np.testing.assert_allclose(P @ found.K @ P.T, here @ truth @ here.T, atol=0.05)


def test_what_the_pad_remembers_is_taken_off():
    """Touches at wandering places of the pad, whose moments hold the model's share of their past ways."""
    K = base_tensor(tensor(27.8, -6.0, 0.5))
    memory, patch = PadMemory(), PatchCurvature(model())
    for i in range(120):
        off = (0.02 * math.sin(0.05 * i), 0.01 * math.sin(0.09 * i))
        touch = replace(samples(K, NORMAL, FORCE, exact, 1, off_pole=off)[0], t_s=0.04 * i)
        d = touch.r_probe / np.linalg.norm(touch.r_probe)
        ways = memory.add(touch.t_s, *direction_to_pad(d, RADIUS))
        patch.add(
            replace(touch, moments=tuple(m + PARAMETERS.memory * w for m, w in zip(touch.moments, ways, strict=True)))
        )
    found = patch_estimate(touch, patch, 0.02)
    np.testing.assert_allclose(found.kappa, [27.8, -6.0], atol=0.02)


def moved_from(away, K, patch):
    """The last answer about a contact that rested 20 s at a place `away` · R from the pole, then 0.2 s at the pole."""
    for off, start, period in ((away, 0.0, 0.5), (0.0, 20.0, 5e-3)):
        for i, touch in enumerate(samples(K, NORMAL, FORCE, exact, 40, off_pole=(off, 0.0))):
            patch.add(replace(touch, t_s=start + period * i))
            found = patch_estimate(touch, patch, 0.02)
    return found


def test_a_place_beyond_the_patch_leaves_no_trace_in_its_moments():
    """It is 4 mm away: an image here shows nothing of it, as its trace is below the level."""
    K = base_tensor(tensor(27.8, -6.0, 0.5))
    patch = PatchCurvature(model())
    found = moved_from(0.1, K, patch)
    P = found.T_frame_contact[:3, :2]
    off = np.array(entries(found.K - P.T @ K @ P))
    assert off @ np.linalg.solve(found.covariance, off) < 3.0  # of χ² of 3
    assert np.abs(off).max() < 0.15 * (1.0 / RADIUS + 27.8)


def test_traces_larger_than_the_image_give_no_answer_and_no_error():
    K, patch = base_tensor(tensor(27.8, -6.0, 0.5)), PatchCurvature(model(replace(PARAMETERS, memory=3.0)))
    assert moved_from(0.1, K, patch) is None


def test_fewer_than_eight_frames_say_nothing_and_a_reset_forgets():
    patch = PatchCurvature(model())
    touches = samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, exact, MIN_FRAMES)
    assert alone(patch, touches[:-1]) is None
    assert alone(patch, touches[-1:]) is not None
    patch.reset()
    assert patch_estimate(touches[-1], patch, 0.02) is None


def test_contacts_without_moments_are_counted_and_change_nothing():
    patch = PatchCurvature(model())
    touches = samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, exact, 10)
    before = alone(patch, touches).K
    without = samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, lambda _: None, 3)
    np.testing.assert_allclose(alone(patch, without).K, before, atol=1e-2)
    assert patch.refused == 3


def test_images_of_a_place_that_the_contact_has_left_say_nothing():
    """A patch that leaves the pad has no moments; 5 mm on, the surface may be another one."""
    patch = PatchCurvature(model())
    touches = samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, exact, 10)
    alone(patch, touches)
    for way, known in ((3e-3, True), (5e-3, False)):
        gone = replace(touches[-1], moments=None, p_base=touches[-1].p_base + np.array([way, 0.0, 0.0]))
        assert (alone(patch, [gone]) is not None) is known


def test_one_image_in_twenty_that_is_far_off_moves_the_answer_by_little():
    touches = samples(base_tensor(tensor(27.8, 0.0, 0.3)), NORMAL, FORCE, exact, 200)
    for i in range(10, 200, 20):
        touches[i] = replace(touches[i], moments=tuple(3.0 * m for m in touches[i].moments))
    assert alone(PatchCurvature(model()), touches).kappa == pytest.approx([27.8, 0.0], abs=2.0)


def test_a_change_of_the_surface_is_followed_within_the_reach_of_the_mean():
    patch = PatchCurvature(model())
    for k1 in (27.8, 5.0):
        touches = samples(base_tensor(tensor(k1, 0.0, 0.3)), NORMAL, FORCE, exact, 400)
        assert alone(patch, touches).kappa == pytest.approx([k1, 0.0], abs=0.3)


def test_outside_the_calibration_the_patch_says_nothing():
    touches = samples(base_tensor(tensor(900.0, 900.0, 0.0)), NORMAL, 1.0, lambda k: model().moments(k, 1.0), 10)
    assert alone(PatchCurvature(model()), touches) is None


def test_regions_of_95_percent_cover_the_truth_and_the_errors_have_the_stated_size():
    """Images with the floor's errors: common to all frames of one touch, drawn anew for each of 250 touches."""
    rng = np.random.default_rng(11)
    K = tensor(27.8, 0.0, 0.0)
    root, inside, errors, stated = np.linalg.cholesky(HERE_FLOOR), 0, [], []
    for _ in range(250):
        e1, e2, shear = root @ rng.standard_normal(3)

        def seen(k, e1=e1, e2=e2, shear=shear):
            xx, _, yy = exact(k)
            return xx * (1 + e1), math.sqrt(xx * yy) * shear, yy * (1 + e2)

        normal = np.array([0.0, 0.0, 1.0])
        touches = samples(base_tensor(K, normal), normal, FORCE, seen, 2 * MIN_FRAMES)
        found = alone(PatchCurvature(model()), touches)
        P = found.T_frame_contact[:3, :2]
        d = np.array(entries(found.K - P.T @ base_tensor(K, normal) @ P))
        inside += d @ np.linalg.solve(found.covariance, d) < 7.815
        errors.append(d)
        stated.append(found.covariance)
    assert 0.92 <= inside / 250 <= 0.985
    spread = np.std(errors, axis=0) / np.sqrt(np.mean(stated, axis=0).diagonal())
    assert spread == pytest.approx(np.ones(3), abs=0.15)


def test_a_thousand_images_know_no_more_than_the_floor():
    touches = samples(base_tensor(tensor(27.8, 0.0, 0.0)), NORMAL, FORCE, exact, 1000)
    patch = PatchCurvature(model())
    sizes = [alone(patch, part).covariance[0, 0] for part in (touches[:64], touches[64:])]
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-3)
    assert math.sqrt(sizes[1]) > 0.5


def test_a_mean_of_moments_takes_a_row_of_far_ones_for_a_change_and_a_single_one_for_wrong():
    mean = _Mean(MAX_RECENT_FRAMES, RECENT_OUTLIER_SHARE)
    for _ in range(20):
        mean.add(1.0, 0.0, 1.0)
    mean.add(5.0, 0.0, 5.0)
    mean.add(1.0, 0.0, 1.0)
    assert mean.moments[0] == pytest.approx(1.0, abs=0.05)
    for _ in range(MIN_FRAMES + 1):
        mean.add(2.0, 0.1, 1.5)
    assert mean.moments == pytest.approx((2.0, 0.1, 1.5))


@pytest.mark.parametrize("ratio", [0.54, 1.85])
def test_a_layer_of_another_stiffness_than_stated_is_found_from_the_touch(ratio):
    """The slope of the touch and its images give stiffness and curvature, and the stiffness lasts."""
    stated = model().with_stiffness(STIFFNESS / ratio)
    slope = Slope(1.0 / indentation_from_force(1.0, STIFFNESS, RADIUS, (27.8, 0.0)), 30.0)
    patch = PatchCurvature(stated, 0.6)
    T = homogeneous(tangent_rotation(-NORMAL), np.zeros(3))
    for kappa in ([27.8, 0.0], [10.0, 10.0]):
        for touch in samples(base_tensor(np.diag(kappa)), NORMAL, FORCE, exact, 64):
            patch.add(replace(touch, slope=slope))
        found = patch.fuse(T)
        off = found.q - np.array([*kappa, 0.0])[[0, 2, 1]]
        assert np.abs(off).max() < 0.7
        assert off @ found.patch @ off < 1.0
        assert found.stiffness == pytest.approx(STIFFNESS, rel=0.04)


def test_a_slope_counts_for_the_place_of_its_touch_alone():
    """Contact is lost and found again where the surface is less curved: the slope there is that of the first touch."""
    slope = Slope(1.0 / indentation_from_force(1.0, STIFFNESS, RADIUS, (27.8, 0.0)), 30.0)
    patch = PatchCurvature(model(), 0.6)
    T = homogeneous(tangent_rotation(-NORMAL), np.zeros(3))
    for kappa in ([27.8, 0.0], [5.0, -5.0]):
        patch.reset()
        for touch in samples(base_tensor(np.diag(kappa)), NORMAL, FORCE, exact, 64):
            patch.add(replace(touch, slope=slope))
        assert patch.fuse(T).stiffness == pytest.approx(STIFFNESS, rel=0.02)
        assert patch.stiffness.value == pytest.approx(STIFFNESS, rel=0.02)


def test_where_the_surface_bends_the_mean_of_the_images_counts_less():
    """κ1 falls by 0.1 1/m a frame: the mean of the last frames is 3 1/m late, and its regions know of it."""
    k1 = np.linspace(40.0, 24.0, 161)
    bending, steady = PatchCurvature(model()), PatchCurvature(model())
    for k in k1:
        bending.add(samples(base_tensor(tensor(k, 0.0, 0.3)), NORMAL, FORCE, exact, 1)[0])
        steady.add(samples(base_tensor(tensor(k1[-1], 0.0, 0.3)), NORMAL, FORCE, exact, 1)[0])
    T = homogeneous(tangent_rotation(-NORMAL), np.zeros(3))
    truth = tensor(k1[-1], 0.0, 0.3)
    q = np.array([truth[0, 0], math.sqrt(2.0) * truth[0, 1], truth[1, 1]])
    late, right = bending.fuse(T), steady.fuse(T)
    assert np.linalg.norm(right.q - q) < 0.1
    off = late.q - q
    assert np.linalg.norm(off) > 1.5
    assert off @ late.patch @ off < 2.0  # two of χ² of 3
    assert off @ right.patch @ off > 2.0 * (off @ late.patch @ off)
