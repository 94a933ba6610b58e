"""Contact kinematics against finite differences of exactly touching bodies."""

import math

import contact_kinematics
import numpy as np
import pytest
from contact_kinematics import skew
from hypothesis import given
from hypothesis import strategies as st

from canprobe.errors import UsageError
from canprobe.mechanics.touch import SurfaceMatrix, indentation_from_force
from canprobe.mechanics.touch import contact as c
from canprobe.mechanics.touch.layer_stiffness import MIN_PUSH_SAMPLES, PushFit, stiffness_from_slope
from canprobe.mechanics.touch.stops import MIN_REST_SAMPLES, AtRest
from canprobe.mechanics.touch.tangent_frames import homogeneous, rotation_vectors, tangent_rotation

H = 1e-3


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
        R = Ro @ contact_kinematics.facing_rotation(0.2 + self.spin * t).T @ Rf.T
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
            V = contact_kinematics.material_velocity(origin, velocity, omega, x)
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
    assert np.abs(contact_kinematics.velocity_over_object(v_f, V_f, V_o) - v_o).max() < 1e-9
    assert np.abs(contact_kinematics.normal_rate_residual(K_o, v_o, K_f, v_f, w_f, w_o, n_o)).max() < 1e-9
    if motion != "spinning":  # a flipped sign of any term would show
        for K1, K2, sign in ((-K_o, K_f, 1), (K_o, -K_f, 1), (K_o, K_f, -1)):
            wrong = contact_kinematics.normal_rate_residual(K1, v_o, K2, v_f, sign * w_f, sign * w_o, n_o)
            terms = (K_o @ v_o, K_f @ v_f, np.cross(w_f - w_o, n_o))
            flipped = {1: terms[0] if K1 is not K_o else terms[1], -1: terms[2]}[sign]
            assert np.linalg.norm(wrong) == pytest.approx(2 * np.linalg.norm(flipped), abs=1e-8)
    got_o, got_f = contact_kinematics.contact_velocities(K_o, K_f, V_f - V_o, w_f - w_o, n_o)
    assert np.abs(got_o - v_o).max() < 1e-9
    assert np.abs(got_f - v_f).max() < 1e-9


def test_pure_rolling_has_no_slip():
    K_o, K_f = SurfaceMatrix.sphere(0.05).S[:3, :3] * 2, SurfaceMatrix.sphere(0.04).S[:3, :3] * 2
    K_o = np.diag([K_o[0, 0], K_o[1, 1], 0.0])
    K_f = np.diag([K_f[0, 0], K_f[1, 1], 0.0])
    v_o, v_f = contact_kinematics.contact_velocities(
        K_o, K_f, np.zeros(3), np.array([0.0, 0.9, 5.0]), np.array([0.0, 0.0, 1.0])
    )
    assert np.allclose(v_o, v_f)
    assert v_o == pytest.approx([0.9 / 45.0, 0, 0])  # (ω × n)/(1/R_o + 1/R_f)


def test_bodies_that_fit_into_each_other_are_refused():
    n = np.array([0.0, 0.0, 1.0])
    with pytest.raises(UsageError, match="K_o \\+ K_f"):
        contact_kinematics.contact_velocities(
            contact_kinematics.sphere_tensor(-0.04, n),
            contact_kinematics.sphere_tensor(0.04, n),
            np.zeros(3),
            np.zeros(3),
            n,
        )


@given(st.floats(-0.0127, 0.0127), st.floats(-0.0127, 0.0127))
def test_pad_and_direction_are_inverse(u, v):
    d = c.pad_to_direction(u, v, 0.04)
    assert np.linalg.norm(d) == pytest.approx(1.0, abs=1e-15)
    assert math.acos(min(1.0, d[2])) * 0.04 == pytest.approx(math.hypot(u, v), abs=1e-9)  # arc length from the pole
    assert c.direction_to_pad(d, 0.04) == pytest.approx((u, v), abs=1e-14)


def test_the_map_is_not_latitude_and_longitude():
    u = v = 7.5 * 1.5875e-3
    lat_lon = 0.04 * np.array([math.sin(u / 0.04) * math.cos(v / 0.04), math.sin(v / 0.04), 1.0])
    ours = 0.04 * c.pad_to_direction(u, v, 0.04)
    assert 0.2e-3 < np.linalg.norm(ours[:2] - lat_lon[:2]) < 0.6e-3  # at the corner


def test_sample_goes_through_the_squeezed_layer():
    T = homogeneous(turn([1, 2, 3], 0.7), np.array([0.1, -0.2, 0.4]))
    s = c.contact_sample(t_s=1.5, T_base_probe=T, uv=(2e-3, -1e-3), depth=0.3e-3, radius=0.04, force_n=2.0)
    centre = T[:3, 3]
    assert np.linalg.norm(s.p_base - centre) == pytest.approx(0.0397)
    assert np.allclose((s.p_base - centre) / 0.0397, -s.n_base)  # the object's outward normal faces the centre
    assert np.allclose(T[:3, :3] @ s.r_probe + centre, s.p_base)
    frame = contact_kinematics.probe_contact_frame(s.r_probe / 0.0397, 0.04)
    assert np.allclose(T[:3, :3] @ frame[:3, 2], s.n_base)  # inward normal of the probe


def test_object_frame_position_and_orientation():
    bodies = Touching(OBJECTS["saddle"], PROBES["ball"], v_obj=(0.02, 0.01), v_probe=(0.01, 0.0), spin=0.4)
    p, q = bodies.places(0.3)
    To, Tf = bodies.object_pose(0.3), bodies.probe_pose(0.3)
    assert np.allclose(contact_kinematics.point_in_object(To, Tf[:3, :3] @ q + Tf[:3, 3]), p, atol=1e-14)
    Tcf = homogeneous(tangent_rotation(-bodies.probe.normal(q)), q)
    R = contact_kinematics.contact_orientation_in_object(
        To, Tf, Tcf, contact_kinematics.facing_rotation(0.2 + 0.4 * 0.3)
    )
    assert np.allclose(R, tangent_rotation(-bodies.obj.normal(p)), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 0.3, 2.5, 3.1])
def test_rotation_vectors(angle):
    axis = np.array([0.36, 0.48, 0.8])
    assert np.allclose(rotation_vectors(turn(axis, angle)[None])[0], angle * axis, atol=1e-12)


class TestIndentation:
    """Winkler layer: `F = ∫ k (δ − A x² − B y²)₊`."""

    @pytest.mark.parametrize("kappa", [(0, 0), (27.8, 0), (20, -15), (-12.5, -12.5)])
    def test_against_the_integral(self, kappa):
        k, radius, force = 1.27e8, 0.04, 1.7
        d = c.indentation_from_force(force, k, radius, kappa)
        A, B = (0.5 * (1 / radius + x) for x in kappa)
        x = (np.arange(800) + 0.5) / 800 * 2 - 1
        X, Y = np.meshgrid(x * math.sqrt(d / A), x * math.sqrt(d / B))
        pressure = k * np.maximum(d - A * X**2 - B * Y**2, 0)
        cell = 4 * d / math.sqrt(A * B) / 800**2
        assert pressure.sum() * cell == pytest.approx(force, rel=1e-4)

    def test_published_points(self):
        assert c.indentation_from_force(1.0, 1.27e8, 0.04, (0, 0)) == pytest.approx(0.25e-3, rel=0.01)
        assert c.indentation_from_force(2.0, 1.27e8, 0.04, (1 / 0.036, 0)) == pytest.approx(0.426e-3, rel=0.01)

    def test_no_force_no_depth_and_unobserved_counts_as_flat(self):
        assert c.indentation_from_force(-0.1, 1.27e8, 0.04, (0, 0)) == 0.0
        flat = c.indentation_from_force(1.0, 1.27e8, 0.04, (27.8, 0))
        assert c.indentation_from_force(1.0, 1.27e8, 0.04, (27.8, math.nan)) == flat

    def test_tighter_than_the_probe_is_refused(self):
        with pytest.raises(UsageError, match="kappa"):
            c.indentation_from_force(1.0, 1.27e8, 0.04, (0.0, -25.1))


# The layer's stiffness from a touch, against the elastic law written out.

RADIUS = 0.04


def force_at(depth, stiffness, kappa):
    a, b = (0.5 * (1 / RADIUS + k) for k in kappa)
    return math.pi * stiffness * depth**2 / (2 * math.sqrt(a * b))


def pushed(stiffness, kappa, depths, *, zero=0.0, noise=None):
    fit = PushFit()
    for i, depth in enumerate(depths):
        force = force_at(depth, stiffness, kappa)
        fit.add(zero + depth, force if noise is None else max(force * (1 + noise[i]), 0.0))
    return fit


@pytest.mark.parametrize("kappa", [(0.0, 0.0), (1 / 0.036, 0.0), (20.0, -12.0), (-10.0, -10.0)])
@pytest.mark.parametrize("stiffness", [2.3e7, 1.27e8, 2.3e9])
def test_the_stiffness_that_made_the_force_is_found_whatever_the_zero(stiffness, kappa):
    deepest = indentation_from_force(2.0, stiffness, RADIUS, kappa)
    fit = pushed(stiffness, kappa, np.linspace(0.3, 1.0, 40) * deepest, zero=-0.2)
    assert fit.certain(0.1)
    assert fit.slope == pytest.approx(math.sqrt(2.0) / deepest, rel=1e-9)
    assert fit.start == pytest.approx(-0.2, abs=1e-9 * deepest)
    assert stiffness_from_slope(fit.slope, RADIUS, kappa) == pytest.approx(stiffness, rel=1e-8)


def test_pulling_counted_as_pushing_gives_no_stiffness():
    fit = PushFit()
    for depth in np.linspace(0.1e-3, 0.4e-3, 40):
        fit.add(-depth, force_at(depth, 1.27e8, (0.0, 0.0)))
    assert fit.slope < 0
    assert not fit.certain(0.5)


def test_too_little_is_not_certain():
    depths = np.linspace(0.2e-3, 0.4e-3, MIN_PUSH_SAMPLES - 1)
    few = pushed(1.27e8, (0.0, 0.0), depths)
    assert math.isnan(few.slope) and few.sigma == math.inf and not few.certain(0.5)
    still = pushed(1.27e8, (0.0, 0.0), np.full(50, 0.3e-3))
    assert not still.certain(0.5)
    weak = pushed(1.27e8, (0.0, 0.0), np.linspace(0.0, 0.05e-3, 50))  # below the least force
    assert math.isnan(weak.slope)
    fit = PushFit()
    fit.add(math.nan, 1.0)
    fit.add(1e-3, math.nan)
    assert fit.sigma == math.inf


def test_nonsense_has_a_slope_and_is_not_believed():
    rng, fit = np.random.default_rng(3), PushFit()
    for depth in np.linspace(0.1e-3, 0.5e-3, 100):
        fit.add(depth, rng.uniform(0.1, 6.0))
    assert fit.sigma < math.inf and fit.scatter > 0.3
    assert not fit.certain(10.0)


def test_a_stiff_touch_is_believed_as_far_as_the_encoders_tell_the_push():
    """Rounded to counts of 30 µm, the push of a 40 kN/m touch is off by half a newton: less certain, no nonsense."""
    rng = np.random.default_rng(5)
    stiffness, sigma = 18 * 1.27e8, 30e-6 / math.sqrt(12.0)
    depths = np.tile(np.linspace(0.03e-3, 0.1e-3, 30), 3)
    fits = PushFit(), PushFit(push_sigma=sigma)
    for depth in depths:
        force = force_at(depth, stiffness, (1 / 0.036, 0.0))
        measured = depth + rng.uniform(-15e-6, 15e-6)
        for fit in fits:
            fit.add(measured, force)
    exact, rounded = fits
    assert exact.slope == rounded.slope and exact.sigma < rounded.sigma / 3
    assert not exact.certain(0.12) and rounded.certain(0.12)
    true = math.sqrt(force_at(1.0, stiffness, (1 / 0.036, 0.0)))
    flatter = 1.0 / (1.0 + sigma**2 / np.var(depths))
    assert rounded.slope == pytest.approx(flatter * true, rel=0.05)


def test_nonsense_is_none_either_where_the_push_is_rounded():
    rng, fit = np.random.default_rng(3), PushFit(push_sigma=9e-6)
    for depth in np.linspace(0.1e-3, 0.5e-3, 100):
        fit.add(depth, rng.uniform(0.1, 6.0))
    assert not fit.certain(10.0)


def test_its_standard_deviation_covers_a_force_known_to_six_percent():
    depths = np.linspace(0.15e-3, 0.42e-3, 60)
    true = pushed(1.27e8, (0.0, 0.0), depths).slope
    errors = []
    for seed in range(200):
        noise = 0.06 * np.random.default_rng(seed).standard_normal(len(depths))
        fit = pushed(1.27e8, (0.0, 0.0), depths, noise=noise)
        errors.append((fit.slope - true) / fit.sigma)
    assert 0.6 < np.std(errors) < 1.3
    assert abs(np.mean(errors)) < 0.3


# A force that does not settle, and one that the array cannot show, are doubted; noise is not.


def doubt_of(forces, saturated=0.0, target=2.0, felt=True):
    rest = AtRest()
    full = round(saturated * len(forces))
    for i, force in enumerate(forces):
        rest.add(force, i < full)
    return rest.doubt(target, felt)


@pytest.mark.parametrize("swing", [0.1, 0.5, 0.6, 1.5])
def test_spread_is_the_standard_deviation(swing):
    forces = 2.0 + swing * np.sin(np.arange(30))
    doubt = doubt_of(forces)
    sigma = float(np.std(forces, ddof=1))
    assert (doubt is None) is (sigma <= 0.4)
    if doubt is not None:
        assert f"± {sigma:.1f} N where 2.0 N" in doubt


def test_a_saturated_array_shows_a_lower_bound_only():
    steady = [2.0] * 40
    assert doubt_of(steady, saturated=0.7, felt=False) is None
    assert doubt_of(steady, saturated=1.0, felt=True) is None
    assert "saturated in 80 % of the samples" in doubt_of(steady, saturated=0.8, felt=False)


def test_a_few_samples_tell_nothing():
    assert doubt_of([0.0, 4.0] * (MIN_REST_SAMPLES // 2 - 1)) is None
    assert doubt_of([0.0, 4.0] * (MIN_REST_SAMPLES // 2)) is not None
