"""Joints at the taxel frame's instant, and a hollow as tight as the probe."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.tactile_frame import TactileFrame, TactileSample
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks.from_plan import make_sensing
from canprobe.cell.tasks.sensing import JointHistory, is_too_hollow
from canprobe.fieldbus.protocol.tactile import TactileHeader, TactileMode
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.touch.estimate.fit import fit_surface
from canprobe.mechanics.touch.estimate.gate import Gate
from canprobe.mechanics.touch.image.patch import Patch
from canprobe.mechanics.touch.surface import SurfaceMatrix

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


def moving(task, t_sigma_s):
    """A contact of an arm whose joints turn at constant speed, at an instant that is known so well."""
    sensing = make_sensing(task)
    for k in range(12):
        sensing.step(Measurement(k, k * PERIOD, q=task.arm.q_start + SPEED * k * PERIOD * 1e-9, enabled=True))
    header = TactileHeader(0, 0, 0, 0, TactileMode.IMAGE, False, 0)
    frame = TactileFrame(header, np.full((16, 16), 20, np.uint8), (0, 0, 16, 16), None, 0)
    patch = Patch(2.0, 1e-3, -2e-3, 60, 5e4, False, False, False, False)
    return sensing.contact(TactileSample(frame, 9 * PERIOD + 700_000, 9, t_sigma_s), patch)


def test_an_uncertain_instant_widens_the_contact_by_the_way_of_the_probe():
    task, sigma_s = resolve(load_scene("plane")).task, 1e-3
    known, guessed = moving(task, 0.0), moving(task, sigma_s)
    assert known.sigma_motion == 0.0 and guessed.p_base.tolist() == known.p_base.tolist()
    t_s, r = 1e-9 * (9 * PERIOD + 700_000), np.append(known.r_probe, 1.0)
    at = [forward(task.arm.model.chain, task.arm.q_start + SPEED * t) for t in (t_s - sigma_s, t_s)]
    way = np.linalg.norm(((at[1] - at[0]) @ task.probe.T_flange_probe @ r)[:3])
    assert guessed.sigma_motion == pytest.approx(way, rel=0.03)
    gate = Gate(30e-6, 1e-3)
    assert gate.sigmas(known) == (known.sigma_point, known.sigma_height, 1e-3)
    wider = np.hypot(known.sigma_point, way), known.sigma_height, 1e-3  # the height stays: the probe moves along
    assert gate.sigmas(guessed) == pytest.approx(wider, rel=0.03)
