"""The tool centre from touches of a ball: against exact geometry, finite differences, and its own covariance."""

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.robot.tool_calibration import BallModel, BallTouch, ball_approaches, calibrate_tool, residual

UP = np.array([0.0, 0.0, 1.0])
CENTRE = np.array([-0.12, -0.13, 0.35])
TRUE_TOOL = np.array([0.4e-3, -0.3e-3, 80.5e-3])
RADII, DEPTH = 0.065, 0.3e-3
MODEL = BallModel(np.array([0.0, 0.0, 0.08]), CENTRE + np.array([1.5e-3, -1.0e-3, 0.8e-3]), RADII)


def frame(pole):
    x = np.array([1.0, 0.2, 0.0])
    x -= pole * (x @ pole)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(pole, x), pole], axis=1)


def felt(approaches, rng=None, tilt=(0.0, 0.0)):
    """Touches of the true ball by the true tool; with a generator noisy as the model says."""
    touches = []
    for one in approaches:
        R = frame(one.pole_base)
        centre, d = CENTRE + (RADII - DEPTH) * one.n_base, R.T @ -one.n_base
        if rng is not None:
            away = rng.normal(0, MODEL.sigma_along, 3)
            centre = centre + one.n_base * (away @ one.n_base)
            d = d + rng.normal(0, MODEL.sigma_across / RADII, 3)
        d = d - np.cross([*tilt, 0.0], d)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, centre - R @ TRUE_TOOL
        touches.append(BallTouch(T, d / np.linalg.norm(d), DEPTH))
    return touches


def approaches(count=13, tilt=22.0, beside=9.0):
    return ball_approaches(count, np.radians(tilt), np.radians(beside), UP)


def test_exact_touches_give_the_tool_and_the_ball():
    estimate = calibrate_tool(felt(approaches()), MODEL)
    assert estimate.observed.all()
    np.testing.assert_allclose(estimate.t_flange, TRUE_TOOL, atol=15e-6)  # the prior draws the ball by its share
    np.testing.assert_allclose(estimate.c_base, CENTRE, atol=15e-6)
    free = BallModel(MODEL.t_flange, MODEL.c_base, RADII, sigma_c=10.0)
    estimate = calibrate_tool(felt(approaches()), free)
    np.testing.assert_allclose(estimate.t_flange, TRUE_TOOL, atol=1e-9)
    np.testing.assert_allclose(estimate.c_base, CENTRE, atol=1e-9)


def test_derivative_is_that_of_finite_differences():
    rng = np.random.default_rng(3)
    (touch,) = felt(approaches()[4:5], rng)
    x = np.concatenate([TRUE_TOOL, CENTRE, rng.normal(0, 1e-4, 1), rng.normal(0, 1e-2, 2)])
    _, J = residual(touch, MODEL, x)
    for k in range(9):
        step = np.zeros(9)
        step[k] = 1e-6
        slope = (residual(touch, MODEL, x + step)[0] - residual(touch, MODEL, x - step)[0]) / 2e-6
        np.testing.assert_allclose(J[:, k], slope, atol=1e-9)


def test_a_tilted_array_is_told_from_an_offset_of_the_tool():
    tilt = (4e-3, -3e-3)
    estimate = calibrate_tool(felt(approaches(), tilt=tilt), MODEL)
    np.testing.assert_allclose(estimate.tilt, tilt, atol=1e-3)
    np.testing.assert_allclose(estimate.t_flange, TRUE_TOOL, atol=0.05e-3)
    blind = calibrate_tool(felt(approaches(beside=0.0), tilt=tilt), MODEL)
    assert not blind.observed[:2].any(), "with the pole turned to the ball the two look alike"
    assert np.isnan(blind.t_flange[:2]).all()


def test_the_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(11)
    errors, sigmas, chi2 = [], [], []
    for _ in range(120):
        believed = CENTRE + rng.normal(0, MODEL.sigma_c, 3)
        model = BallModel(MODEL.t_flange, believed, RADII + rng.normal(0, MODEL.sigma_radii))
        tilt = rng.normal(0, MODEL.sigma_tilt, 2)
        estimate = calibrate_tool(felt(approaches(), rng, tuple(tilt)), model)
        errors.append(estimate.t_flange - TRUE_TOOL)
        sigmas.append(estimate.sigma)
        chi2.append(estimate.chi2_per_dof)
    spread = np.sqrt(np.mean(np.square(errors), axis=0)) / np.mean(sigmas, axis=0)
    np.testing.assert_allclose(spread, 1.0, atol=0.2)  # 120 runs: 6 % (1σ)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("beside", [0.0, 9.0])
def test_one_orientation_tells_nothing(beside):
    same = felt(approaches(beside=beside)[:1]) * 8
    estimate = calibrate_tool(same, MODEL)
    assert not estimate.observed.any()
    assert np.isnan(estimate.t_flange).all()
    assert (estimate.sigma > 1e-3).all()
    everywhere = calibrate_tool(same, BallModel(MODEL.t_flange, MODEL.c_base, RADII, sigma_c=1e6))
    assert not everywhere.observed.any()


def test_what_is_no_calibration_is_refused():
    with pytest.raises(UsageError, match="expected 2 or more, got 1"):
        calibrate_tool(felt(approaches()[:1]), MODEL)
    bad = felt(approaches())
    bad[3].T_base_flange[0, 3] = np.nan
    with pytest.raises(UsageError, match="touch 4 is not finite"):
        calibrate_tool(bad, MODEL)


def test_touches_are_where_they_were_asked_for():
    for k, one in enumerate(approaches(9, 20.0, 7.0)):
        assert np.linalg.norm(one.n_base) == pytest.approx(1.0)
        assert np.degrees(np.arccos(one.n_base @ UP)) == pytest.approx(20.0 if k else 0.0, abs=1e-5)
        assert np.degrees(np.arccos(-one.n_base @ one.pole_base)) == pytest.approx(7.0)
