"""(13)–(23) of Chen, Rink and Zhang with the signs of the package, against finite differences of touching bodies."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import SurfaceMatrix
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation

H = 1e-3


def point_in_object(T_base_object, p_base):
    """The contact point in the object's frame (21), (22)."""
    T = np.linalg.inv(T_base_object)
    return T[:3, :3] @ p_base + T[:3, 3]


def contact_orientation_in_object(T_base_object, T_base_probe, T_probe_cf, R_cf_co):
    """Axes of the object's contact frame in the object's frame, `R_o_c = R_bᵀ R_s R_cf R_cf_co` (23)."""
    return T_base_object[:3, :3].T @ T_base_probe[:3, :3] @ T_probe_cf[:3, :3] @ R_cf_co


def facing_rotation(spin=0.0):
    """R (3, 3) from the object's to the probe's contact frame: z opposed, x turned by `spin` rad."""
    c, s = math.cos(spin), math.sin(spin)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def material_velocity(origin, origin_velocity, omega, point):
    """V: velocity of the point of a rigid body that is now at `point`."""
    return origin_velocity + np.cross(omega, point - origin)


def velocity_over_object(v_f, V_f, V_o):
    """v_o = v_f + V_f − V_o (17)–(19): how the contact point moves over the object."""
    return v_f + V_f - V_o


def normal_rate_residual(K_o, v_o, K_f, v_f, omega_f, omega_o, n_o):  # noqa: PLR0917 - the equation's own symbols
    """`K_o v_o + K_f v_f − (ω_f − ω_o) × n_o` (16), K as (3, 3) tensors: zero in a motion that keeps contact."""
    return K_o @ v_o + K_f @ v_f - np.cross(omega_f - omega_o, n_o)


def contact_velocities(K_o, K_f, V_rel, omega_rel, n_o):
    """How the contact moves over both bodies, v_o and v_f, when the motion is given: (16) and (19) solved together."""
    P = tangent_rotation(-n_o)[:, :2]
    slide = V_rel - n_o * float(n_o @ V_rel)
    v_f = P @ np.linalg.solve(P.T @ (K_o + K_f) @ P, P.T @ (np.cross(omega_rel, n_o) - K_o @ slide))
    return v_f + slide, v_f


def skew(w):
    """The (3, 3) matrix of `w ×`."""
    x, y, z = float(w[0]), float(w[1]), float(w[2])
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def derivative(f, t=0.0):
    """Five-point central difference."""
    return (f(t - 2 * H) - 8 * f(t - H) + 8 * f(t + H) - f(t + 2 * H)) / (12 * H)


def turn(axis, angle):
    """Rodrigues' formula."""
    k = skew(np.asarray(axis) / np.linalg.norm(axis))
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


class Touching:
    """Two bodies in exact contact: each contact point moves over its own body as it likes, the poses follow.

    motion: "rolling" keeps the contact points' speeds equal, "sliding" keeps one fixed, "spinning" fixes both.
    """

    def __init__(self, obj, probe, *, v_obj, v_probe, spin, object_moves=True):
        self.obj, self.probe = obj, probe
        self.v_obj, self.v_probe, self.spin = np.asarray(v_obj), np.asarray(v_probe), spin
        self.moves = float(object_moves)

    def places(self, t):
        p = self.obj.project([*(self.v_obj * t), float(self.obj.height(*(self.v_obj * t)))])
        q = self.probe.project([*(self.v_probe * t), float(self.probe.height(*(self.v_probe * t)))])
        return p, q

    def object_pose(self, t):
        s = self.moves
        R = turn([0.3, -0.5, 0.8], 0.4 + 0.7 * s * t)
        return homogeneous(R, np.array([0.1, 0.2, 0.3]) + s * t * np.array([0.02, -0.03, 0.01]))

    def probe_pose(self, t):
        """T so that the contact frames face each other: (13), (14)."""
        p, q = self.places(t)
        To = self.object_pose(t)
        Ro = To[:3, :3] @ tangent_rotation(-self.obj.normal(p))
        Rf = tangent_rotation(-self.probe.normal(q))
        R = Ro @ facing_rotation(0.2 + self.spin * t).T @ Rf.T
        return homogeneous(R, To[:3, :3] @ p + To[:3, 3] - R @ q)

    def rates(self):
        """(ω, V, v) of both bodies by finite differences, n_o and both shape tensors, at t = 0."""
        out = []
        contact = lambda t: self.object_pose(t)[:3, :3] @ self.places(t)[0] + self.object_pose(t)[:3, 3]  # noqa: E731
        x = contact(0.0)
        for pose, which in ((self.object_pose, 0), (self.probe_pose, 1)):
            R = pose(0.0)[:3, :3]
            W = derivative(lambda t, pose=pose: pose(t)[:3, :3]) @ R.T
            omega = np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2
            origin = pose(0.0)[:3, 3]
            velocity = derivative(lambda t, pose=pose: pose(t)[:3, 3])
            V = material_velocity(origin, velocity, omega, x)
            v = R @ derivative(lambda t, which=which: self.places(t)[which])
            out.append((omega, V, v))
        p, q = self.places(0.0)
        tensors = []
        for body, place, pose in ((self.obj, p, self.object_pose), (self.probe, q, self.probe_pose)):
            K, B = body.curvature_at(place)
            B = pose(0.0)[:3, :3] @ B
            tensors.append(B @ K @ B.T)
        n_o = self.object_pose(0.0)[:3, :3] @ self.obj.normal(p)
        return out, tensors, n_o


OBJECTS = {
    "plane": SurfaceMatrix.plane(),
    "sphere": SurfaceMatrix.sphere(0.05),
    "cylinder": SurfaceMatrix.cylinder(0.036, 0.4),
    "saddle": SurfaceMatrix.from_curvature([[20, 3], [3, -15]], 1.0, -2.0, 4.0),
    "bowl": SurfaceMatrix.sphere(-0.08),
}
PROBES = {"ball": SurfaceMatrix.sphere(0.04), "egg": SurfaceMatrix.from_curvature([[30, 2], [2, 40]], 1.0, 2.0, 15.0)}
MOTIONS = {
    "sliding": {"v_obj": (0.02, 0.01), "v_probe": (0.0, 0.0), "spin": 0.0},
    "over the pad": {"v_obj": (0.0, 0.0), "v_probe": (0.015, -0.02), "spin": 0.0},
    "spinning": {"v_obj": (0.0, 0.0), "v_probe": (0.0, 0.0), "spin": 1.3},
    "mixed": {"v_obj": (0.02, -0.015), "v_probe": (-0.01, 0.02), "spin": 0.8},
}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("probe", PROBES)
@pytest.mark.parametrize("name", OBJECTS)
def test_common_position_and_normal_hold_on_exact_contact(name, probe, motion):
    bodies = Touching(OBJECTS[name], PROBES[probe], **MOTIONS[motion])
    ((w_o, V_o, v_o), (w_f, V_f, v_f)), (K_o, K_f), n_o = bodies.rates()
    assert np.abs(velocity_over_object(v_f, V_f, V_o) - v_o).max() < 1e-9
    assert np.abs(normal_rate_residual(K_o, v_o, K_f, v_f, w_f, w_o, n_o)).max() < 1e-9
    if motion != "spinning":  # a flipped sign of any term would show
        for K1, K2, sign in ((-K_o, K_f, 1), (K_o, -K_f, 1), (K_o, K_f, -1)):
            wrong = normal_rate_residual(K1, v_o, K2, v_f, sign * w_f, sign * w_o, n_o)
            terms = (K_o @ v_o, K_f @ v_f, np.cross(w_f - w_o, n_o))
            flipped = {1: terms[0] if K1 is not K_o else terms[1], -1: terms[2]}[sign]
            assert np.linalg.norm(wrong) == pytest.approx(2 * np.linalg.norm(flipped), abs=1e-8)
    got_o, got_f = contact_velocities(K_o, K_f, V_f - V_o, w_f - w_o, n_o)
    assert np.abs(got_o - v_o).max() < 1e-9
    assert np.abs(got_f - v_f).max() < 1e-9


def test_pure_rolling_has_no_slip():
    K_o, K_f = SurfaceMatrix.sphere(0.05).S[:3, :3] * 2, SurfaceMatrix.sphere(0.04).S[:3, :3] * 2
    K_o = np.diag([K_o[0, 0], K_o[1, 1], 0.0])
    K_f = np.diag([K_f[0, 0], K_f[1, 1], 0.0])
    v_o, v_f = contact_velocities(K_o, K_f, np.zeros(3), np.array([0.0, 0.9, 5.0]), np.array([0.0, 0.0, 1.0]))
    assert np.allclose(v_o, v_f)
    assert v_o == pytest.approx([0.9 / 45.0, 0, 0])  # (ω × n)/(1/R_o + 1/R_f)


def test_object_frame_position_and_orientation():
    bodies = Touching(OBJECTS["saddle"], PROBES["ball"], v_obj=(0.02, 0.01), v_probe=(0.01, 0.0), spin=0.4)
    p, q = bodies.places(0.3)
    To, Tf = bodies.object_pose(0.3), bodies.probe_pose(0.3)
    assert np.allclose(point_in_object(To, Tf[:3, :3] @ q + Tf[:3, 3]), p, atol=1e-14)
    Tcf = homogeneous(tangent_rotation(-bodies.probe.normal(q)), q)
    R = contact_orientation_in_object(To, Tf, Tcf, facing_rotation(0.2 + 0.4 * 0.3))
    assert np.allclose(R, tangent_rotation(-bodies.obj.normal(p)), atol=1e-12)
