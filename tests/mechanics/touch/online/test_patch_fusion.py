"""Curvature from second moments: an integrated Winkler patch and rotations of scipy as truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch import (
    ContactSample,
    ImageModel,
    MomentImage,
    OnlineEstimator,
    PatchCalibration,
    PatchCurvature,
    PatchFusion,
    Prior,
    Slope,
    SystematicErrors,
    indentation_from_force,
    make_estimator,
)
from canprobe.mechanics.touch.contact import direction_to_pad
from canprobe.mechanics.touch.estimate.known_curvature import CurvatureInformation
from canprobe.mechanics.touch.image.calibration import ImageParameters, MomentErrors
from canprobe.mechanics.touch.image.image_model import USUAL_LIGHTNESS
from canprobe.mechanics.touch.image.moments import LEVEL_COUNTS, PadMemory
from canprobe.mechanics.touch.online.patch_curvature import MAX_RECENT_FRAMES, MIN_FRAMES, RECENT_OUTLIER_SHARE, _Mean
from canprobe.mechanics.touch.online.patch_fusion import patch_estimate
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation

RADIUS, STIFFNESS, PITCH, COUNT_PA = 0.040, 1.27e8, 1.5875e-3, 100e3 / 255
LEVEL_PA = 6 * COUNT_PA
FORCE = 2.0
PARAMETERS = ImageParameters(stiffness=STIFFNESS, scale=1.05, blur=1.15e-3, crosstalk=0.02, memory=0.03)
ERRORS = MomentErrors(moment=2.0e-4, both=0.7e-4, shear=0.45e-4, frame_sigma=0.002)
FLOOR = ((ERRORS.moment, ERRORS.both, 0.0), (ERRORS.both, ERRORS.moment, 0.0), (0.0, 0.0, ERRORS.shear))
HERE_T = (
    LEVEL_PA / 1.05 / STIFFNESS / math.sqrt(2.0 * FORCE * 0.5 * math.sqrt((25.0 + 27.8) * 25.0) / math.pi / STIFFNESS)
)
"""Level over peak pressure at 2 N on a cylinder of 36 mm."""
HERE_FLOOR = HERE_T / USUAL_LIGHTNESS * np.array(FLOOR)
"""Covariance of the moments' errors there, along both axes and of the shear."""


def model(parameters=PARAMETERS, level=LEVEL_PA, seen=16):
    return ImageModel(parameters, RADIUS, PITCH, level, COUNT_PA, 16, seen, ERRORS)


def entries(K):
    return K[0, 0], K[0, 1], K[1, 1]


def tensor(k1, k2, angle):
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return R @ np.diag([k1, k2]) @ R.T


def shown_by_hand(K, force, parameters, level):
    """Sum (N) and second moments (m²) of k (δ − ½ xᵀ (I/R + K) x)₊, blurred, spread and cut off, on a fine grid."""
    step, n = PITCH / 8, 128
    x, y = np.meshgrid(*(2 * [(np.arange(n) - (n - 1) / 2) * step]))
    A = 0.5 * (np.eye(2) / RADIUS + K)
    depth = math.sqrt(2.0 * force * math.sqrt(np.linalg.det(A)) / (math.pi * STIFFNESS))
    p = STIFFNESS * np.maximum(depth - A[0, 0] * x * x - 2 * A[0, 1] * x * y - A[1, 1] * y * y, 0.0)
    p = parameters.scale * gaussian_filter(p, parameters.blur / step, mode="constant", truncate=6.0)
    c = parameters.crosstalk / 15
    spread = np.eye(n) * (1 - parameters.crosstalk - c) + c * step / PITCH
    p = spread @ p @ spread
    cut = np.maximum(p - level, 0.0)
    total = p[p >= level].sum() * step * step
    return total, [(cut * m).sum() / cut.sum() for m in (x * x, x * y, y * y)]


@pytest.mark.parametrize("shape", [(27.8, 0.0, 0.4), (20.0, 20.0, 0.0), (16.0, -12.0, 1.1), (45.0, 10.0, 0.0)])
@pytest.mark.parametrize(("crosstalk", "level"), [(0.0, 1e-3), (0.02, LEVEL_PA)])
def test_moments_and_sum_are_those_of_the_blurred_patch_on_a_fine_grid(shape, crosstalk, level):
    K = tensor(*shape[:2], 0.0 if crosstalk else shape[2])  # crosstalk follows rows and columns
    parameters = replace(PARAMETERS, crosstalk=crosstalk)
    m = model(parameters, level)
    total, moments = shown_by_hand(K, FORCE, parameters, level)
    found = m.moments(entries(K), FORCE)
    scale = math.sqrt(moments[0] * moments[2])
    assert found == pytest.approx(moments, rel=6e-3, abs=6e-3 * scale)
    a, b = (0.5 * (1 / RADIUS + k) for k in shape[:2])
    sums = m.sum_of(m.shown(*(np.array([x]) for x in (m.depth(FORCE, a * b), a, b))))
    assert sums[0] == pytest.approx(total, rel=8e-3)


def test_force_gains_undo_what_the_rim_loses():
    m = model()
    gain, edge = m.force_gains((0.5, 1.0, 2.0, 4.0), ((0.0, 0.0), (1.6, 1.6)))
    for force in (0.7, 3.0):
        S, _ = shown_by_hand(tensor(20.0, 0.0, 0.0), force, PARAMETERS, LEVEL_PA)
        assert gain * S + edge * math.sqrt(S) == pytest.approx(force, rel=0.015)


@pytest.mark.parametrize("k", [(27.8, 0.0, 3.0), (20.0, 6.0, -3.0), (15.0, 1e-5, 15.0)])
def test_the_jacobian_is_that_of_the_moments(k):
    m = model()
    v = m.moments(k, FORCE)
    J, residual, _ = m.linearised((v[0], 0.0, v[2]), FORCE, 8, k)
    scale = np.array([1.0 / v[0], 1.0 / math.sqrt(v[0] * v[2]), 1.0 / v[2]])
    assert residual == pytest.approx(scale * [0.0, -v[1], 0.0], abs=1e-12)

    def of(q):
        return np.array(m.moments((q[0], q[1] / math.sqrt(2.0), q[2]), FORCE))

    q, h = np.array([k[0], math.sqrt(2.0) * k[1], k[2]]), 0.05 * np.eye(3)
    numeric = np.stack([(of(q + d) - of(q - d)) / 0.1 for d in h], axis=1) * scale[:, None]
    assert pytest.approx(numeric, rel=0.02, abs=2e-4) == J


def test_hollow_as_tight_as_the_probe_is_no_patch():
    with pytest.raises(ValueError, match="hollower"):
        model().moments((10.0, 0.0, -25.0), FORCE)
    with pytest.raises(ValueError, match="hollower"):
        model().trust((10.0, 0.0, -25.0), FORCE)


def test_trust_ends_softly_where_the_calibration_ends():
    k = np.linspace(0.0, 2000.0, 8001)
    trust = np.array([model().trust((a, 0.0, a), FORCE) for a in k])
    assert trust[0] == model().trust((27.8, 0.0, 0.0), FORCE) == 1.0
    assert trust[-1] == 0.0
    assert np.all(np.diff(trust) <= 0.0)
    assert np.abs(np.diff(trust)).max() < 0.02


# images


def test_moments_of_an_image_by_hand():
    rng = np.random.default_rng(3)
    image = np.zeros((16, 16), np.uint8)
    image[5:11, 4:12] = rng.integers(0, 120, (6, 8))
    calibration = PatchCalibration()
    sums = np.zeros(6)
    for i in range(16):
        for j in range(16):
            v, u = (i - 7.5) * PITCH, (j - 7.5) * PITCH
            rho = math.hypot(u, v) / RADIUS
            p = max(int(image[i, j]) - LEVEL_COUNTS, 0) * math.sin(rho) / rho
            sums += p * np.array([1.0, u, v, u * u, u * v, v * v])
    _, u, v, uu, uv, vv = sums / sums[0]
    expected = (uu - u * u, uv - u * v, vv - v * v)
    assert MomentImage(calibration).moments(image) == pytest.approx(expected, rel=1e-9)


def test_image_without_an_ellipse_has_no_moments():
    image = np.zeros((16, 16), np.uint8)
    moment_image = MomentImage(PatchCalibration())
    assert moment_image.moments(image) is None
    image[4:9, 4:9] = LEVEL_COUNTS
    assert moment_image.moments(image) is None
    image[6, 6] = 90
    assert moment_image.moments(image) is None  # a point


def test_moments_do_not_jump_where_a_taxel_passes_the_threshold():
    """A blurred patch slides by one pitch: its moments wander by less than three quarters of what a plain cut makes of
    them."""
    fine = (np.arange(16 * 9) + 0.5) / 9 - 8.0
    u, v = np.meshgrid(fine, fine)
    moment_image, plain = MomentImage(PatchCalibration()), MomentImage(PatchCalibration(threshold_counts=1), 0)
    found, jumping = [], []
    for shift in np.linspace(0.0, 1.0, 21):
        field = 130.0 * np.maximum(1.0 - ((u - shift) / 2.55) ** 2 - (v / 3.7) ** 2, 0.0)
        blurred = gaussian_filter(field, 0.65 * 9).reshape(16, 9, 16, 9).mean(axis=(1, 3))
        image = np.rint(blurred).astype(np.uint8)
        image[image < LEVEL_COUNTS] = 0
        found.append(moment_image.moments(image)[0])
        jumping.append(plain.moments(image)[0])
    assert np.ptp(found) / np.mean(found) < 0.75 * np.ptp(jumping) / np.mean(jumping)
    assert np.ptp(found) / np.mean(found) < 0.035


# accumulated


def samples(K_base, normal, force, moments_of, n, *, spin=0.0, off_pole=(0.0, 0.0)):
    """n touches of a resting contact whose images have the moments of the model, in the pad's own axes.

    The pad's axes at the contact are the probe's x and y turned there by the shortest rotation from the pole.
    """
    d = np.array([*off_pole, math.sqrt(1.0 - np.dot(off_pole, off_pole))])
    axis = np.cross([0.0, 0.0, 1.0], d)
    sine = np.linalg.norm(axis)
    to_contact = Rotation.from_rotvec(axis / sine * math.asin(sine)) if sine > 0 else Rotation.identity()
    # any probe attitude that brings d onto the inward normal, spun about it
    reach = Rotation.align_vectors([-normal], [d])[0]
    R = (Rotation.from_rotvec(-normal * spin) * reach).as_matrix()
    e = R @ to_contact.as_matrix()[:, :2]
    k = e.T @ K_base @ e
    T = homogeneous(R, -(RADIUS - 0.4e-3) * R @ d)
    return [
        ContactSample(i * 5e-3, np.zeros(3), normal, T, (RADIUS - 0.4e-3) * d, force, moments=moments_of(entries(k)))
        for i in range(n)
    ]


def exact(k):
    return model().moments(k, FORCE)


NORMAL = np.array([0.3, -0.5, 0.8]) / math.sqrt(0.98)


def base_tensor(K, normal=NORMAL):
    B = tangent_rotation(-normal)[:, :2]
    return B @ K @ B.T


@pytest.mark.parametrize("spin", [0.0, 0.8, 2.5])
@pytest.mark.parametrize("off_pole", [(0.0, 0.0), (0.2, -0.1), (-0.05, 0.24)])
def test_curvature_of_a_standing_touch_in_base_whatever_the_pad_s_attitude(spin, off_pole):
    truth = base_tensor(tensor(27.8, -6.0, 0.5))
    patch = PatchCurvature(model())
    touches = samples(truth, NORMAL, FORCE, exact, 20, spin=spin, off_pole=off_pole)
    for touch in touches:
        patch.add(touch)
    estimate = patch_estimate(touches[-1], patch, 0.02)
    assert estimate.method == "patch"
    assert estimate.rank == 3
    assert estimate.observed.all()
    np.testing.assert_allclose(estimate.kappa, [27.8, -6.0], atol=0.02)
    P = estimate.T_frame_contact[:3, :2]
    np.testing.assert_allclose(P @ estimate.K @ P.T, truth, atol=0.02)


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


@pytest.mark.parametrize("away", [0.1, 0.2, 0.3])
def test_a_place_beyond_the_patch_leaves_no_trace_in_its_moments(away):
    """It is 4 to 12 mm away: an image here shows nothing of it, as its trace is below the level."""
    K = base_tensor(tensor(27.8, -6.0, 0.5))
    patch = PatchCurvature(model())
    found = moved_from(away, K, patch)
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
    for touch in touches[:-1]:
        patch.add(touch)
    assert patch_estimate(touches[-1], patch, 0.02) is None
    patch.add(touches[-1])
    assert patch_estimate(touches[-1], patch, 0.02) is not None
    patch.reset()
    assert patch_estimate(touches[-1], patch, 0.02) is None


def test_contacts_without_moments_are_counted_and_change_nothing():
    patch = PatchCurvature(model())
    touches = samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, exact, 10)
    for touch in touches:
        patch.add(touch)
    before = patch_estimate(touches[-1], patch, 0.02).K
    for touch in samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, lambda _: None, 3):
        patch.add(touch)
    assert patch.refused == 3
    np.testing.assert_allclose(patch_estimate(touches[-1], patch, 0.02).K, before, atol=1e-2)


def test_images_of_a_place_that_the_contact_has_left_say_nothing():
    """A patch that leaves the pad has no moments; 5 mm on, the surface may be another one."""
    patch = PatchCurvature(model())
    touches = samples(base_tensor(tensor(20.0, 0.0, 0.0)), NORMAL, FORCE, exact, 10)
    for touch in touches:
        patch.add(touch)
    gone = replace(touches[-1], moments=None, p_base=touches[-1].p_base + np.array([3e-3, 0.0, 0.0]))
    patch.add(gone)
    assert patch_estimate(gone, patch, 0.02) is not None
    gone = replace(gone, p_base=touches[-1].p_base + np.array([5e-3, 0.0, 0.0]))
    patch.add(gone)
    assert patch_estimate(gone, patch, 0.02) is None


def test_one_image_in_twenty_that_is_far_off_moves_the_answer_by_little():
    touches = samples(base_tensor(tensor(27.8, 0.0, 0.3)), NORMAL, FORCE, exact, 200)
    patch = PatchCurvature(model())
    for i, touch in enumerate(touches):
        far_off = tuple(3.0 * m for m in touch.moments)
        patch.add(replace(touch, moments=far_off) if i % 20 == 10 else touch)
    assert patch_estimate(touches[-1], patch, 0.02).kappa == pytest.approx([27.8, 0.0], abs=2.0)


def test_a_change_of_the_surface_is_followed_within_the_reach_of_the_mean():
    patch = PatchCurvature(model())
    for k1 in (27.8, 5.0):
        touches = samples(base_tensor(tensor(k1, 0.0, 0.3)), NORMAL, FORCE, exact, 400)
        for touch in touches:
            patch.add(touch)
        assert patch_estimate(touches[-1], patch, 0.02).kappa == pytest.approx([k1, 0.0], abs=0.3)


def test_outside_the_calibration_the_patch_says_nothing():
    patch = PatchCurvature(model())
    touches = samples(base_tensor(tensor(900.0, 900.0, 0.0)), NORMAL, 1.0, lambda k: model().moments(k, 1.0), 10)
    for touch in touches:
        patch.add(touch)
    assert patch_estimate(touches[-1], patch, 0.02) is None


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
        patch = PatchCurvature(model())
        for touch in touches:
            patch.add(touch)
        found = patch_estimate(touches[-1], patch, 0.02)
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
    sizes = []
    for i, touch in enumerate(touches, start=1):
        patch.add(touch)
        if i in (64, 1000):
            sizes.append(patch_estimate(touch, patch, 0.02).covariance[0, 0])
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


# fused


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
        one.add(
            ContactSample(
                touch.t_s,
                touch.p_base + 1e-5 * rng.standard_normal(3),
                touch.n_base,
                touch.T_base_probe,
                touch.r_probe,
                FORCE,
                moments=touch.moments,
            )
        )
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


def test_curvature_known_along_the_path_sharpens_that_across():
    touches = [cylinder_touch(x, 0.0, 0.0, True) for x, _ in AXIAL[:20]]
    patch = PatchCurvature(model())
    for touch in touches:
        patch.add(touch)
    alone = patch_estimate(touches[-1], patch, 0.02)
    both = after_path(AXIAL).estimate()
    assert across(both) < 0.75 * across(alone)


def test_along_a_straight_path_over_a_torus_both_are_right_or_say_so(torus_line):
    """Diagonally over its tube. Taken for a quadric's, the motion's curvature is 1 1/m off and said to be ±0.1."""
    held, answers = [], 0
    for end in (-0.9, 0.9, 1.3):
        line = torus_line(0.11, 0.04, end, 0.8, length=0.04, samples=320)
        rng = np.random.default_rng(1)
        one = estimator("recursive", SystematicErrors(0.02))  # as in the loop
        for i, (point, normal) in enumerate(zip(*line.felt(2e-5, 1e-3, rng), strict=True)):
            T = homogeneous(tangent_rotation(-normal), point + (RADIUS - 0.4e-3) * normal)
            k = T[:3, :2].T @ line.tensor(point) @ T[:3, :2]
            inner = np.array([0.0, 0.0, RADIUS - 0.4e-3])
            one.add(ContactSample(5e-3 * i, point, normal, T, inner, FORCE, moments=exact(entries(k))))
            if i < 160 or i % 10:
                continue
            answers += 1
            e = one.estimate()
            if e.rank == 3:
                P = e.T_frame_contact[:3, :2]
                d = (e.K - P.T @ line.tensor(e.point) @ P)[[0, 0, 1], [0, 1, 1]]
                held.append(d @ np.linalg.solve(e.covariance, d) < 7.815)
    assert len(held) > 0.5 * answers
    assert np.mean(held) > 0.9


def across(estimate):
    """Standard deviation of the curvature across the axis, 1/m."""
    y = estimate.T_frame_contact[:3, :2].T @ [0.0, 1.0, 0.0]
    weights = np.array([y[0] ** 2, 2 * y[0] * y[1], y[1] ** 2])
    return math.sqrt(weights @ estimate.covariance @ weights)


def test_where_the_path_shows_all_curvature_the_patch_hardly_counts():
    alone, both = (after_path(WEAVE, moments=moments).estimate() for moments in (False, True))
    assert alone.method == "recursive"
    assert both.rank == 3
    assert any(note.endswith("% of the curvature from the patch") for note in both.notes)
    assert 0.9 * across(alone) < across(both) < across(alone)
    assert np.linalg.norm(both.K - alone.K) < 0.5 * across(alone)


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
        weights = np.array([ex[0] ** 2, 2.0 * ex[0] * ex[1], ex[1] ** 2])
        sigma = math.sqrt(weights @ answer.covariance @ weights)
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

    def test_more_of_the_motion_moves_the_answer_over_without_a_jump(self, touches):
        patch = self.patch(touches)
        own = patch.fuse(self.T)
        q = own.q + np.array([1.5, -1.0, 1.0])
        answers = [
            patch.fuse(self.T, CurvatureInformation(q, size * np.diag([1.0, 0.5, 2.0]))).q
            for size in np.geomspace(1e-4, 1e4, 401)
        ]
        assert answers[0] == pytest.approx(own.q, abs=0.01)
        assert answers[-1] == pytest.approx(q, abs=0.01)
        assert np.abs(np.diff(answers, axis=0)).max() < 0.05
        assert np.all(np.diff([np.linalg.norm(a - q) for a in answers]) < 1e-3)

    def test_no_jump_where_images_leave_what_the_motion_believes_and_the_calibration(self, touches):
        motion = CurvatureInformation(np.array([-5.0, 0.0, 26.0]), np.diag([4.0, 4.0, 0.5]))
        scales = np.linspace(0.6, 1.6, 401)
        found = [one for s in scales if (one := self.patch(touches, s).fuse(self.T, motion))]
        assert len(found) > 380
        believed = [one.q for one in found if not one.contradicted]
        assert len(believed) > 30
        assert np.abs(np.diff(believed, axis=0)).max() < 0.4
        assert found[-1].contradicted  # nobody believes moments that are 60 % too large

    def test_estimates_along_a_path_that_begins_to_weave_do_not_jump(self):
        """Axial, then ever wider: motion takes over from the patch within its standard deviation."""
        x = np.arange(0.0, 0.06, 1.25e-4)
        line = [(a, max(a - 0.03, 0.0) * 0.15 * math.sin((a - 0.03) / 1e-3)) for a in x]
        one, K, sigma = estimator(), [], []
        for i, (a, y) in enumerate(line):
            one.add(cylinder_touch(a, y, i * 5e-3, True))
            if i > 160:
                answer = one.estimate()
                assert answer.rank == 3
                ey = answer.T_frame_contact[:3, :2].T @ [0.0, 1.0, 0.0]
                K.append(ey @ answer.K @ ey)
                sigma.append(across(answer))
        assert sigma[-1] < 0.65 * sigma[0]
        assert np.abs(np.diff(K)).max() < 0.25 * max(sigma)
        assert np.asarray(K) == pytest.approx(1 / 0.036, abs=1.0)

    def test_regions_of_both_together_cover_the_truth(self):
        """Motion and floor drawn anew 200 times: 95 % regions, and never worse than either alone."""
        rng = np.random.default_rng(12)
        K = tensor(27.8, 0.0, 0.0)
        T = homogeneous(tangent_rotation(-np.array([0.0, 0.0, 1.0])), np.zeros(3))
        P = T[:3, :2]
        k = P.T @ base_tensor(K, np.array([0.0, 0.0, 1.0])) @ P
        true = np.array([k[0, 0], math.sqrt(2.0) * k[0, 1], k[1, 1]])
        information = np.array([[1.5, 0.4, 0.0], [0.4, 0.5, 0.1], [0.0, 0.1, 0.25]])
        root, floor, inside, errors = (
            np.linalg.inv(np.linalg.cholesky(information)).T,
            np.linalg.cholesky(HERE_FLOOR),
            0,
            [],
        )
        for _ in range(200):
            e1, e2, shear = floor @ rng.standard_normal(3)

            def seen(k, e1=e1, e2=e2, shear=shear):
                xx, _, yy = exact(k)
                return xx * (1 + e1), math.sqrt(xx * yy) * shear, yy * (1 + e2)

            patch = PatchCurvature(model())
            for touch in samples(base_tensor(K, np.array([0.0, 0.0, 1.0])), np.array([0.0, 0.0, 1.0]),
                                 FORCE, seen, 2 * MIN_FRAMES):  # fmt: skip
                patch.add(touch)
            motion = CurvatureInformation(true + root @ rng.standard_normal(3), information)
            found = patch.fuse(T, motion)
            off = found.q - true
            inside += off @ (information + found.patch) @ off < 7.815
            errors.append([off, motion.q - true, patch.fuse(T).q - true])
        assert 0.915 <= inside / 200 <= 0.985
        both, motion_alone, patch_alone = np.sqrt(np.mean(np.square(errors), axis=0))
        assert np.all(both < 1.02 * motion_alone)
        assert np.all(both < 1.02 * patch_alone)


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


@pytest.mark.parametrize("ratio", [0.54, 1.0, 1.85])
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
