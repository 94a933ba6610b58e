"""The shipped calibration is what the procedure finds, and holds on arrays that it never saw."""

import math

import numpy as np
import pytest
from array_calibration import calibrate, fit_moments, pressed_sums, random_presses

from canprobe.emulator.plant.probe import depth_for_force
from canprobe.emulator.plant.taxels import TaxelArray, TaxelConfig
from canprobe.touch.contact import ContactSample
from canprobe.touch.pad import Pad
from canprobe.touch.patch.array_model import FORCE_GAINS, MOMENT_FITS, array_calibration, moment_model
from canprobe.touch.patch.curvature import PatchCurvature, patch_estimate
from canprobe.touch.patch.image import compute_patch
from canprobe.touch.patch.moments import MomentImage, PadMemory


def test_procedure_finds_the_shipped_gains():
    found = calibrate(100e3, seeds=range(3), forces=(0.5, 1.5, 3.0))
    gain, edge = FORCE_GAINS[100e3]
    for force in (0.5, 2.0, 3.0):  # the two numbers trade against each other; what counts is the force
        assert found.force_gain * force + found.edge_gain * np.sqrt(force) == pytest.approx(
            gain * force + edge * np.sqrt(force), rel=0.01
        )


@pytest.mark.parametrize(("full_scale_pa", "spread"), [(100e3, 0.015), (300e3, 0.03)])
def test_bias_on_unseen_arrays_is_within_three_percent(full_scale_pa, spread):
    calibration = array_calibration(Pad(full_scale_pa=full_scale_pa))
    sums, true = map(np.array, zip(*pressed_sums(full_scale_pa, (1.0, 2.0, 3.0), seeds=(77, 78)), strict=True))
    errors = (calibration.force_gain * sums + calibration.edge_gain * np.sqrt(sums)) / true - 1
    assert abs(errors.mean()) < 0.01
    assert errors.std() < spread
    uncalibrated = sums / true - 1
    assert abs(uncalibrated.mean()) > 2 * abs(errors.mean())


# The shipped moment fits are what the procedure finds, and their regions hold on arrays that it never saw.


@pytest.fixture(scope="module")
def unseen():
    """45 presses of arrays that no fit has seen, full pipeline, 8×8 window."""
    return list(random_presses(45, 77, 100e3, windowed=True))


def test_procedure_finds_the_shipped_fit(unseen):
    """The numbers trade against each other; what counts is the moments, within three times the floor's deviation."""
    found = fit_moments(unseen, 100e3, windowed=True)
    shipped = MOMENT_FITS[100e3, True]
    assert found.force_ratio == pytest.approx(shipped.force_ratio, abs=0.01)
    assert np.sqrt(found.floor[0][0]) == pytest.approx(np.sqrt(shipped.floor[0][0]), rel=0.35)
    model = moment_model(array_calibration(Pad()), 1.27e8, windowed=True)
    for k in ((27.8, 0.0, 0.0), (20.0, 0.0, 20.0), (0.0, 0.0, 0.0), (45.0, 0.0, 10.0)):
        again = type(model)(found, model.radius, model.stiffness, model.level_pa, model.pitch)
        assert again.moments(k, 2.0) == pytest.approx(model.moments(k, 2.0), rel=0.026)


def test_regions_of_one_touch_cover_the_truth_on_unseen_arrays(unseen):
    """Patch alone, blur, gains, hysteresis, creep, crosstalk, noise, 8 bits, threshold and window on."""
    model = moment_model(array_calibration(Pad()), 1.27e8, windowed=True)
    inside, errors = [], []
    for press in unseen:
        V = press.moments - model.fit.memory * press.remembered
        T = np.eye(4)
        T[2, 3] = -0.04
        touch = ContactSample(
            0.0, np.zeros(3), np.array([0.0, 0.0, -1.0]), T, np.array([0.0, 0.0, 0.04]), press.measured_force,
            moments=(V[0, 0], V[0, 1], V[1, 1]),
        )  # fmt: skip
        patch = PatchCurvature(model)
        for _ in range(25):
            patch.add(touch)
        found = patch_estimate(touch, patch, 0.02)
        if found is None:  # outside what was calibrated
            continue
        P = found.T_frame_contact[:3, :2]
        D = found.K - P.T @ np.diag([*press.kappa, 0.0]) @ P
        d = np.array([D[0, 0], D[0, 1], D[1, 1]])
        inside.append(d @ np.linalg.solve(found.covariance, d) < 7.815)
        errors.append(D)
    assert len(inside) >= 38
    assert np.mean(inside) >= 0.88
    assert abs(np.mean([np.trace(D) for D in errors])) < 1.5
    assert np.sqrt(np.mean(np.square(errors))) < 5.0


def test_the_pad_s_memory_is_in_the_images_and_the_fit_takes_it_off():
    """Arrays without spread of their gains; rolling across a cylinder against resting on it."""
    memory = MOMENT_FITS[100e3, True].memory
    rest, roll = (np.mean([rolled(way, place) for place in range(5)], axis=0) for way in (0.0, 2.5e-3))
    raw = roll[0] / rest[0] - 1.0
    corrected = (roll[0] - memory * roll[1]) / (rest[0] - memory * rest[1]) - 1.0
    assert raw > 0.015
    assert abs(corrected) < 0.4 * raw


def rolled(amplitude, place):
    """Mean moment across a cylinder of 36 mm at the end of 9 s of rolling, and the mean way remembered, m²."""
    calibration = array_calibration(Pad())
    image_moments, memory = MomentImage(calibration), PadMemory()
    array = TaxelArray(TaxelConfig(gain_error=0.0), np.random.default_rng(place))
    k, axes = (1 / 0.036, 0.0), np.array([[0.8, 0.6], [-0.6, 0.8]])
    depth = depth_for_force(2.0, k, 0.04, 1.27e8)
    u, v = np.random.default_rng(place + 10).uniform(-1e-3, 1e-3, 2)
    found = []
    for t in np.arange(0.0, 9.0, 0.04).tolist():
        at = amplitude * (4.0 * abs((0.4 * t) % 1.0 - 0.5) - 1.0)
        uv = (u + at * axes[0, 0], v + at * axes[0, 1])
        force = min(1.0, t / 0.5) * (1.0 + 0.04 * math.sin(8.0 * t))  # a servo's is as restless
        image = array.image(uv, depth * math.sqrt(force), k, axes, t)
        patch = compute_patch(image, calibration)
        if patch.n_active:
            ways = memory.add(t, patch.u, patch.v)
            if t > 5.0:
                tensors = [np.array([[m[0], m[1]], [m[1], m[2]]]) for m in (image_moments.moments(image), ways)]
                found.append([axes[0] @ m @ axes[0] for m in tensors])
    return np.mean(found, axis=0)
