"""Damped inverse velocity: exact away from singular poses, bounded at them."""

import numpy as np
import pytest

from canprobe.robot.damped import damped_step
from canprobe.robot.kinematics import forward_jacobian, tool_z_offset
from canprobe.robot.puma260 import ELBOW_FORM, UPENN

TOOL = tool_z_offset(80.0)


def jacobian(q):
    return forward_jacobian(UPENN, q, TOOL)[1]


def test_exact_inverse_in_the_scan_pose():
    J = jacobian(ELBOW_FORM)
    twist = np.array((0.025, -0.01, 0.004, 0.3, -0.2, 0.1))
    assert J @ damped_step(J, twist) == pytest.approx(twist, abs=1e-12)


def test_rates_stay_bounded_and_continuous_through_the_wrist_singularity():
    twist = np.array((0.0, 0.0, 0.0, 0.0, 0.5, 0.5))
    before = None
    for q5 in np.radians(np.linspace(-8.0, 8.0, 161)):
        q = ELBOW_FORM.copy()
        q[4] = q5
        qd = damped_step(jacobian(q), twist)
        assert np.abs(qd).max() < 0.71 / 0.05 / 2 * 1.01 + 1.0
        if before is not None:
            assert np.abs(qd - before).max() < 2.0
        before = qd


def test_exactly_singular_gives_a_finite_step():
    q = ELBOW_FORM.copy()
    q[4] = 0.0
    assert np.all(np.isfinite(damped_step(jacobian(q), np.ones(6))))


def test_speed_limit_keeps_the_direction():
    J = jacobian(ELBOW_FORM)
    twist = np.array((1.0, 0.5, -0.4, 0.0, 0.0, 0.0))
    free = damped_step(J, twist)
    limited = damped_step(J, twist, qd_max=UPENN.qd_max / 10)
    assert np.max(np.abs(limited) / UPENN.qd_max) == pytest.approx(0.1)
    assert limited / np.linalg.norm(limited) == pytest.approx(free / np.linalg.norm(free))
    assert damped_step(J, 1e-3 * twist, qd_max=UPENN.qd_max) == pytest.approx(1e-3 * free)


@pytest.mark.parametrize("smallest", [0.07, 0.04, 0.004])
def test_damping_rises_by_its_law_below_the_threshold(smallest):
    """A Jacobian of known singular values: every direction is damped by λ² = 0.05² (1 - (s / 0.08)²)."""
    rng = np.random.default_rng(3)
    U, V = (np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(2))
    s = np.array([2.0, 1.5, 1.0, 0.7, 0.3, smallest])
    lambda2 = 0.05**2 * (1 - (smallest / 0.08) ** 2)
    twist = rng.normal(size=6)
    rates = V @ (s / (s**2 + lambda2) * (U.T @ twist))
    assert damped_step((U * s) @ V.T, twist, length_m=1.0) == pytest.approx(rates, rel=1e-9)
