"""Joints at the taxel frame's instant, and a hollow as tight as the probe."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.tasks.sensing import JointHistory, is_too_hollow
from canprobe.touch.estimate.fit import fit_surface
from canprobe.touch.surface import SurfaceMatrix

PERIOD = 2_500_000
SPEED = np.array([0.3, -0.5, 0.8, 0.1, -1.2, 0.4])


def line(t_ns):
    """Joints (6,) rad on a path of constant speed."""
    return 0.1 + SPEED * t_ns * 1e-9


def history(path, cycles=20, jitter=0):
    h = JointHistory()
    for k in range(cycles):
        t = k * PERIOD + (jitter if k % 2 else 0)
        h.add(t, path(t))
    return h


@pytest.mark.parametrize("jitter", [0, 180_000])
@pytest.mark.parametrize("age_ns", [0, 1, 400_000, 1_250_000, 2_499_999, 2_500_000, 5_300_001])
def test_joints_are_those_of_the_samples_instant(age_ns, jitter):
    h = history(line, jitter=jitter)
    t = 15 * PERIOD + jitter - age_ns
    assert h.at(t) == pytest.approx(line(t), abs=1e-13)


def test_a_curved_path_is_followed_to_second_order():
    """Linear between SYNCs: the error is at most a·dt²/8; joints of the last SYNC alone would be 500 times worse."""
    h = history(lambda t: np.sin(line(t)))
    for age in np.linspace(0, PERIOD, 11).astype(int):
        t = int(12 * PERIOD - age)
        bound = (SPEED * PERIOD * 1e-9) ** 2 / 8
        assert (np.abs(h.at(t) - np.sin(line(t))) <= bound + 1e-15).all()
    middle = 12 * PERIOD - PERIOD // 2
    held = np.abs(np.sin(line(11 * PERIOD)) - np.sin(line(middle)))
    assert (held > 100 * np.abs(h.at(middle) - np.sin(line(middle)))).all()


def test_outside_the_history_nothing_is_made_up():
    h = history(line, cycles=100)
    assert JointHistory().at(0) is None
    assert h.at(99 * PERIOD + 1) is None
    assert h.at(35 * PERIOD) is None  # older than the 64 that are kept
    assert h.at(36 * PERIOD) == pytest.approx(line(36 * PERIOD))


@pytest.mark.parametrize(("radius", "found"), [(-0.030, True), (-0.040, True), (-0.055, False), (0.040, False)])
def test_a_hollow_as_tight_as_the_probe_is_detected(radius, found):
    surface = SurfaceMatrix.sphere(radius)
    s = np.arange(160) * 0.125e-3
    x, y = 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3)
    points = np.stack([x, y, surface.height(x, y)], axis=1)
    rng = np.random.default_rng(0)
    normals = surface.normal(points) + 1e-3 * rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = points + 2e-5 * rng.normal(size=points.shape)
    assert is_too_hollow(fit_surface(points, normals, sigma_point=2e-5, sigma_normal=1e-3), 0.04) is found
    doubtful = fit_surface(points[-12:], normals[-12:], sigma_point=1e-4, sigma_normal=2e-2)
    assert not is_too_hollow(doubtful, 0.04)  # never on a guess
