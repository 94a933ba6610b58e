"""(13)–(19) on every pair of surfaces that touch in a point: the contact is solved exactly, then differenced."""

from __future__ import annotations

import math

import contact_kinematics
import numpy as np
import pytest
from contact_kinematics import skew

H = 5e-4
NAMES = ("plane", "sphere", "small sphere", "cylinder", "ellipsoid", "hyperboloid", "saddle", "bowl")
FACING = contact_kinematics.facing_rotation(0.3)
# slip in the tangent plane (m/s), turning about the tangent axes and about the normal (rad/s)
MOTIONS = {
    "rolling": ((0.0, 0.0), (0.5, -0.3, 0.0)),
    "sliding": ((0.02, -0.01), (0.0, 0.0, 0.0)),
    "spinning": ((0.0, 0.0), (0.0, 0.0, 1.2)),
    "mixed": ((-0.015, 0.02), (0.4, 0.3, -0.9)),
}


def relative_curvature(obj, probe):
    """K_o + K_f (2, 2) in the object's contact frame when the frames face each other."""
    return 2 * obj.S[:2, :2] + FACING[:2, :2].T @ (2 * probe.S[:2, :2]) @ FACING[:2, :2]


def turn(w):
    angle = math.sqrt(float(w @ w))
    k = skew(w / angle) if angle else np.zeros((3, 3))
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def gradient(S, x):
    return 2 * (S[:3, :3] @ x + S[:3, 3])


def equations(z, S_o, S_f, R, origin):
    """Both points on their surfaces, in one place, normals opposed; z = p, q, height of the probe along z."""
    p, q = z[:3], z[3:6]
    g_o, g_f = gradient(S_o, p), R @ gradient(S_f, q)
    level = [x @ (S[:3, :3] @ x + 2 * S[:3, 3]) for x, S in ((p, S_o), (q, S_f))]
    # parallel gradients: two independent parts of the cross product, near the z axis
    opposed = [g_o[1] * g_f[2] - g_o[2] * g_f[1], g_o[2] * g_f[0] - g_o[0] * g_f[2]]
    return np.array([*level, *opposed, *(R @ q + origin + z[6] * np.array([0, 0, 1]) - p)])


def solve(S_o, S_f, R, origin):
    """Newton with complex-step derivatives, to rounding."""
    z = np.zeros(7)
    for _ in range(8):
        J = np.stack([equations(z + 1e-30j * e, S_o, S_f, R, origin).imag / 1e-30 for e in np.eye(7)], axis=1)
        z = z - np.linalg.solve(J, equations(z, S_o, S_f, R, origin))
    assert np.abs(equations(z, S_o, S_f, R, origin)).max() < 1e-15
    return z


def derivative(values):
    """Seven-point central difference of samples at −3H … 3H."""
    return np.tensordot([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60], values, axes=1) / H


def touch_in_one_point(obj, probe):
    return bool((np.linalg.eigvalsh(relative_curvature(obj, probe)) > 1.0).all())


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("name", NAMES)
def test_rates_of_the_exact_contact(name, motion, truth):
    obj = truth.surface(name)
    partners = [probe for probe in map(truth.surface, NAMES) if touch_in_one_point(obj, probe)]
    assert partners
    for probe in partners:
        check(obj, probe, motion)


def check(obj, probe, motion):
    slide, omega = np.array([*MOTIONS[motion][0], 0.0]), np.array(MOTIONS[motion][1])
    R0 = FACING.T  # the probe's contact frame is its frame, the object's is the base
    places = [solve(obj.S, probe.S, turn(omega * t) @ R0, slide * t) for t in np.arange(-3, 4) * H]
    p, q, height = np.array(places)[:, :3], np.array(places)[:, 3:6], np.array(places)[:, 6]
    v_o, v_f = derivative(p), R0 @ derivative(q)
    n_o = np.array([0.0, 0.0, -1.0])
    V_f = contact_kinematics.material_velocity(np.zeros(3), slide, omega, np.zeros(3))
    assert abs(derivative(height)) < 1e-9  # a motion in the tangent plane keeps contact
    K_o, K_f = np.zeros((3, 3)), np.zeros((3, 3))
    K_o[:2, :2] = 2 * obj.S[:2, :2]
    K_f[:2, :2] = 2 * probe.S[:2, :2]
    K_f = R0 @ K_f @ R0.T
    rest = np.zeros(3)
    assert np.abs(contact_kinematics.velocity_over_object(v_f, V_f, rest) - v_o).max() < 1e-9
    assert np.abs(contact_kinematics.normal_rate_residual(K_o, v_o, K_f, v_f, omega, rest, n_o)).max() < 1e-9
    got_o, got_f = contact_kinematics.contact_velocities(K_o, K_f, V_f, omega, n_o)
    assert np.abs(np.concatenate([got_o - v_o, got_f - v_f])).max() < 1e-9
    if motion == "spinning":
        assert np.abs(np.concatenate([v_o, v_f])).max() < 1e-9
    else:
        wrong = contact_kinematics.normal_rate_residual(-K_o, v_o, -K_f, v_f, omega, rest, n_o)
        assert np.linalg.norm(wrong) == pytest.approx(2 * np.linalg.norm(np.cross(omega, n_o)), abs=1e-8)
        assert np.abs(np.concatenate([v_o, v_f])).max() > 1e-3
