"""The servo against exact surfaces: a delayed, noise-free sensor and a probe that does as it is told, late."""

import math
from collections import deque

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import Circle, TactileServo, contact_sample, indentation_from_force
from canprobe.mechanics.touch.contact import direction_to_pad
from canprobe.mechanics.touch.servo import BLIND_S, SETTLE_S, LocalSurface, SurfaceGains
from canprobe.mechanics.touch.strategies import PathFollower, make_strategy

RADIUS_P = 0.040
DEPTH = 0.426e-3
DT = 2.5e-3
AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Sphere:
    """A sphere of radius ``r``, or a bowl for negative ``r``, touching z = 0 from below at the origin."""

    def __init__(self, r: float) -> None:
        self.r = r
        self.centre = np.array((0.0, 0.0, -r))

    def closest(self, x):
        d = x - self.centre
        n = d / np.linalg.norm(d) * np.sign(self.r)
        return self.centre + n * self.r, n


class Cylinder:
    """A cylinder along base x, its crown at the origin."""

    def __init__(self, r: float) -> None:
        self.r = r

    def closest(self, x):
        axis = np.array((x[0], 0.0, -self.r))
        d = x - axis
        n = d / np.linalg.norm(d)
        return axis + n * self.r, n


def curvature_of(surface, n):
    if isinstance(surface, Cylinder):
        t = np.cross(n, (1.0, 0.0, 0.0))
        return np.outer(t, t) / surface.r
    return (np.eye(3) - np.outer(n, n)) / surface.r


def follow(surface, *, know_curvature=True, seconds=3.0, delay=10, stiffness_error=0.0, gains=None):
    """Depth errors (m) and contact points of a closed loop; each command acts ``delay`` cycles later."""
    p, n = surface.closest(np.array((0.0, 0.0, RADIUS_P)))
    local = LocalSurface(p, n, gains or SurfaceGains())
    servo = TactileServo(
        local,
        PathFollower(make_strategy("weave", 0.03, 0.008)),
        axes=AXES,
        origin=p,
        probe_radius=RADIUS_P,
        rolling_share=0.0,
    )
    first = p + n * (RADIUS_P - DEPTH)
    line = deque([first] * delay, maxlen=delay)
    depths, points = [], []
    for k in range(round(seconds / DT)):
        centre = line[0]
        p, n = surface.closest(centre)
        depth = RADIUS_P - float(n @ (centre - p))
        depths.append(depth - DEPTH)
        points.append(p)
        if k % 2 == 0:
            felt = DEPTH + (depth - DEPTH) * (1 + stiffness_error)
            local.correct(centre - n * (RADIUS_P - felt), n, 2 * DT)
            if know_curvature:
                local.set_curvature(curvature_of(surface, n))
        line.append(servo.next_pose(25e-3, DEPTH, DT).centre)
    return np.array(depths), np.array(points)


@pytest.mark.parametrize("surface", [Sphere(0.05), Sphere(-0.12), Cylinder(0.036), Sphere(10.0)])
def test_depth_is_kept_while_the_curvature_is_known(surface):
    depths, _ = follow(surface)
    assert np.abs(depths).max() < 5e-6  # until it has been taken up
    assert np.abs(depths[200:]).max() < 1e-7


@pytest.mark.parametrize("surface", [Sphere(0.05), Cylinder(0.036)])
def test_without_curvature_contact_is_kept_all_the_same(surface):
    depths, _ = follow(surface, know_curvature=False)
    assert np.abs(depths).max() < 60e-6  # a seventh of the indentation


@pytest.mark.parametrize("surface", [Sphere(0.05), Cylinder(0.036)])
def test_contact_speed_is_the_asked_one(surface):
    _, points = follow(surface)
    travelled = np.linalg.norm(np.diff(points[100:], axis=0), axis=1).sum()
    assert travelled / (DT * (len(points) - 101)) == pytest.approx(25e-3, rel=0.01)


@pytest.mark.parametrize("error", [-0.4, 0.4])
def test_a_wrong_stiffness_leaves_no_steady_error(error):
    surface = Sphere(0.05)
    p, n = surface.closest(np.array((0.0, 0.0, RADIUS_P)))
    local = LocalSurface(p + n * 50e-6, n, SurfaceGains())  # starts 50 µm wrong
    servo = TactileServo(local, None, axes=AXES, origin=p, probe_radius=RADIUS_P, rolling_share=0.0)
    line = deque([p + n * (RADIUS_P - DEPTH)] * 10, maxlen=10)
    depth = DEPTH
    for k in range(800):
        depth = RADIUS_P - float(n @ (line[0] - p))
        if k % 2 == 0:
            felt = DEPTH + (depth - DEPTH) * (1 + error)
            local.correct(line[0] - n * (RADIUS_P - felt), n, 2 * DT)
        line.append(servo.next_pose(0.0, DEPTH, DT).centre)
    assert depth == pytest.approx(DEPTH, abs=1e-7)


def test_local_surface_bends_away_from_the_outward_normal_where_convex():
    local = LocalSurface(np.zeros(3), np.array((0.0, 0.0, 1.0)), SurfaceGains())
    local.set_curvature(np.diag((20.0, 0.0, 0.0)))
    local.correct(local.point, local.normal, dt=1e6)
    foot, normal = local.foot((1e-3, 0.0, 5.0))
    assert foot == pytest.approx((1e-3, 0.0, -10e-6))
    assert normal[0] == pytest.approx(0.02, rel=1e-3)


@pytest.mark.parametrize("steps", [1, 40])
def test_a_new_curvature_turns_the_normal_ahead_step_by_step(steps):
    """At once it would turn it by its change times the distance, and a stiff arm with the probe's radius behind it."""
    local = LocalSurface(np.zeros(3), np.array((0.0, 0.0, 1.0)), SurfaceGains(curvature_hz=4.0))
    ahead = np.array((1e-3, 0.0, 0.0))
    local.set_curvature(np.diag((20.0, 0.0, 0.0)))
    assert local.foot(ahead)[1] == pytest.approx((0.0, 0.0, 1.0))
    for _ in range(steps):
        local.correct(local.point, local.normal, 1 / (2 * np.pi * 4.0) / steps)
    assert local.foot(ahead)[1][0] == pytest.approx(0.02 * (1 - np.exp(-1)), rel=1e-3)


@pytest.mark.parametrize(("share", "tilt"), [(0.0, 0.1), (1.0, 0.0)])
def test_rolling_share_turns_the_pole_with_the_normal_or_not(share, tilt):
    local = LocalSurface(np.zeros(3), np.array((0.0, 0.0, 1.0)), SurfaceGains())
    servo = TactileServo(local, None, axes=AXES, origin=np.zeros(3), probe_radius=RADIUS_P, rolling_share=share)
    local.correct(np.zeros(3), np.array((np.sin(0.1), 0.0, np.cos(0.1))), dt=1e6)
    pole = servo.next_pose(0.0, DEPTH, DT).pole
    assert pole == pytest.approx((-np.sin(tilt), 0.0, -np.cos(tilt)))


@pytest.mark.parametrize("steps", [1, 40])
def test_a_correction_leaves_one_in_e_after_the_time_constant_of_its_bandwidth(steps):
    """Bandwidth f is a first-order low pass of the time constant 1 / (2 π f), in however many samples."""
    gains = SurfaceGains(height_hz=8.0, tilt_hz=6.0)
    local = LocalSurface(np.zeros(3), np.array((0.0, 0.0, 1.0)), gains)
    for _ in range(steps):
        local.correct(np.array((0.0, 0.0, 1e-3)), np.array((0.0, 0.0, 1.0)), 1 / (2 * np.pi * 8.0) / steps)
    assert local.point[2] == pytest.approx(1e-3 * (1 - np.exp(-1)), rel=1e-9)
    tilted = np.array((1e-4, 0.0, np.sqrt(1 - 1e-8)))
    for _ in range(steps):
        local.correct(local.point, tilted, 1 / (2 * np.pi * 6.0) / steps)
    assert local.normal[0] == pytest.approx(1e-4 * (1 - np.exp(-1)), rel=1e-6)


def off_curve(contacts, strategy):
    """Greatest distance (m) of contacts from a strategy's curve in the scan plane."""
    curve = np.array([strategy.point(phase) for phase in np.linspace(0, 2 * np.pi, 4000)])
    seen = np.stack([contacts @ AXES[0], contacts @ AXES[1]], axis=1)
    return max(np.linalg.norm(curve - one, axis=1).min() for one in seen[::7])


@pytest.mark.parametrize("name", ["weave", "circle", "straight"])
@pytest.mark.parametrize(
    "n", [(0, -0.717, 0.697), (0.717, 0, 0.697), (0.5, 0.5, 0.707)], ids=["along", "across", "both"]
)
def test_a_path_over_a_slope_is_the_one_in_the_scan_plane(name, n):
    """A step is shorter in the plane by what it climbs itself: 46 degrees uphill, nothing along the slope."""
    n = np.array(n) / np.linalg.norm(n)
    strategy = make_strategy(name, 0.03, 0.008)
    servo = TactileServo(
        LocalSurface(np.zeros(3), n, SurfaceGains()),
        PathFollower(strategy),
        axes=AXES,
        origin=np.zeros(3),
        probe_radius=RADIUS_P,
        rolling_share=0.0,
    )
    contacts = np.array([servo.next_pose(0.025, 0.0, DT).centre - RADIUS_P * n for _ in range(3000)])
    assert off_curve(contacts, strategy) < 0.15e-3
    along = contacts @ AXES[0]
    assert (along.max(), along.min()) == pytest.approx((0.015, -0.015), abs=0.15e-3) or name == "circle"
    assert np.linalg.norm(np.diff(contacts, axis=0), axis=1) == pytest.approx(0.025 * DT, rel=1e-9)


@pytest.mark.parametrize("surface", [Cylinder(0.036), Sphere(0.025)])
def test_the_contact_keeps_to_the_curve_over_a_steep_crown(surface):
    """Of the true contacts: up to 26 degrees steep on the cylinder, 38 on the sphere."""
    _, points = follow(surface, seconds=8.0)
    across = points @ AXES[1]
    assert (across.max(), across.min()) == pytest.approx((0.004, -0.004), abs=0.15e-3)
    assert off_curve(points, make_strategy("weave", 0.03, 0.008)) < 0.15e-3


def test_raising_the_model_moves_it_outward_and_leaves_its_normal():
    n = np.array((0.6, 0.0, 0.8))
    surface = LocalSurface(np.array((0.01, 0.02, 0.03)), n, SurfaceGains())
    surface.raise_by(1e-3)
    np.testing.assert_allclose(surface.point, (0.0106, 0.02, 0.0308), atol=1e-12)
    np.testing.assert_allclose(surface.normal, n, atol=1e-12)


def test_time_does_not_run_backwards():
    """A negative time would turn the correction round, and the more so the longer it is."""
    local = LocalSurface(np.zeros(3), np.array([0.0, 0.0, 1.0]), SurfaceGains())
    with pytest.raises(UsageError, match=r"dt: expected a time that has passed, got -0\.06 s"):
        local.correct(np.array([0.0, 0.0, 1e-3]), np.array([0.0, 0.0, 1.0]), -0.06)
    assert local.point.tolist() == [0.0, 0.0, 0.0]


class Layer:
    """A flat plate under a probe with an elastic layer (Winkler), felt with another stiffness than it has."""

    def __init__(self, normal, stiffness, believed):
        self.n, self.stiffness, self.believed = np.array(normal) / np.linalg.norm(normal), stiffness, believed

    def force(self, T):
        depth = RADIUS_P - float(self.n @ T[:3, 3])
        return math.pi * self.stiffness * RADIUS_P * max(depth, 0.0) ** 2

    def felt(self, T, t_s):
        force = self.force(T)
        if force == 0.0:
            return contact_sample(t_s=t_s, T_base_probe=T, uv=(math.nan,) * 2, depth=0.0, radius=RADIUS_P, force_n=0.0)
        uv = direction_to_pad(T[:3, :3].T @ -self.n, RADIUS_P)
        return contact_sample(
            t_s=t_s, T_base_probe=T, uv=uv, depth=depth_of(force, self.believed), radius=RADIUS_P, force_n=force
        )


def depth_of(force, stiffness):
    return indentation_from_force(force, stiffness, RADIUS_P, (0.0, 0.0))


@pytest.mark.parametrize("believed", [0.7, 1.0, 1.4])
def test_a_step_from_contact_to_pose_holds_the_force_on_a_flat_layer(believed):
    """Poses 20 ms late, a plate 9° off the pole, and a stiffness that is not known: no cell, no arm."""
    layer = Layer((0.15, 0.0, 1.0), 1.2e8, believed * 1.2e8)
    T = np.diag((1.0, -1.0, -1.0, 1.0))
    T[:3, 3] = layer.n * (RADIUS_P - 0.05e-3)
    servo = TactileServo.on(
        layer.felt(T, 0.0), Circle(0.02), (0.0, 1.0, 0.0), radius=RADIUS_P, depth=depth_of(2.0, layer.believed)
    )
    line, forces, places, poses = deque([T] * 8, maxlen=8), [], [], []
    servo.speed = 0.02
    for k in range(1, 1200):
        contact = layer.felt(line[0], DT * k) if k % 2 else None
        forces.append(layer.force(line[0]))
        places.append(line[0][:3, 3] @ (np.eye(3) - np.outer(layer.n, layer.n)))
        line.append(servo.step(contact, DT))
        poses.append(line[-1])
    assert forces[-600:] == pytest.approx([2.0] * 600, rel=0.01)
    assert max(forces) < 2.2
    still, moving = np.diff(places, axis=0)[: round(SETTLE_S / DT) - 2], np.diff(places, axis=0)[300:]
    assert np.linalg.norm(moving, axis=1) == pytest.approx(0.02 * DT, rel=0.02)
    assert np.linalg.norm(still, axis=1).max() < 1e-5
    R = np.array(poses)[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    turns = np.arccos(np.clip((np.trace(R[1:] @ R[:-1].transpose(0, 2, 1), axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert turns.max() < 0.02  # without a jump from the pole of the first touch to the normal


def test_without_contacts_a_step_holds_still_and_what_is_no_contact_counts_as_none():
    layer = Layer((0.0, 0.0, 1.0), 1.2e8, 1.2e8)
    T = np.diag((1.0, -1.0, -1.0, 1.0))
    T[2, 3] = RADIUS_P - 0.3e-3
    first = layer.felt(T, 0.0)
    servo = TactileServo.on(first, Circle(0.02), (1.0, 0.0, 0.0), radius=RADIUS_P, depth=0.3e-3)
    servo.speed = 0.02
    for k in range(1, 400):
        T = servo.step(layer.felt(T, DT * k), DT)
    at_loss = T
    lifted = np.array(T)
    lifted[2, 3] += 1e-3
    for k in range(400):
        old = layer.felt(T, 0.1)
        T = servo.step((None, old, layer.felt(lifted, 1.0 + DT * k))[k % 3], DT)
    assert np.isfinite(T).all()
    assert 0.9 * BLIND_S * 0.02 < np.linalg.norm((T - at_loss)[:3, 3]) < 1.1 * BLIND_S * 0.02
    with pytest.raises(UsageError, match="dt: expected a number above 0, got 0"):
        servo.step(None, 0.0)
    with pytest.raises(UsageError, match=r"depth: expected finite numbers.*got nan"):
        TactileServo.on(first, None, (1.0, 0.0, 0.0), radius=RADIUS_P, depth=math.nan)


# Strategies: constant speed along the curve, inside their region, from the origin.

SIZES = {"weave": (0.036, 0.009), "circle": (0.02, 0.0), "straight": (0.03, 0.0)}


@pytest.mark.parametrize("name", SIZES)
def test_tangent_is_the_derivative_of_the_point(name):
    strategy = make_strategy(name, *SIZES[name])
    for phase in np.linspace(0.1, 6.0, 17):
        h = 1e-6
        plus, minus = strategy.point(phase + h), strategy.point(phase - h)
        numeric = [(a - b) / (2 * h) for a, b in zip(plus, minus, strict=True)]
        assert strategy.tangent(phase) == pytest.approx(numeric, abs=1e-7)


@pytest.mark.parametrize("name", SIZES)
def test_starts_at_the_origin_and_closes(name):
    strategy = make_strategy(name, *SIZES[name])
    assert strategy.point(0.0) == pytest.approx((0, 0), abs=1e-12)
    assert strategy.point(2 * math.pi) == pytest.approx((0, 0), abs=1e-12)


@pytest.mark.parametrize("name", SIZES)
def test_follower_stays_on_the_curve_at_the_asked_step(name):
    strategy = make_strategy(name, *SIZES[name])
    follower = PathFollower(strategy)
    x = y = 0.0
    step = 25e-3 / 400
    seen = []
    for _ in range(4000):
        hx, hy = follower.step(x, y, step)
        assert math.hypot(hx, hy) == pytest.approx(1.0)
        x, y = x + hx * step, y + hy * step
        seen.append((x, y))
    path = np.array(seen)
    curve = np.array([strategy.point(p) for p in np.linspace(0, 2 * math.pi, 4000)])
    distance = np.min(np.linalg.norm(path[::20, None] - curve[None], axis=2), axis=1)
    assert distance.max() < 0.5e-3
    assert path.min(axis=0) == pytest.approx(curve.min(axis=0), abs=0.7e-3)
    assert path.max(axis=0) == pytest.approx(curve.max(axis=0), abs=0.7e-3)


def test_a_straight_path_brakes_before_it_turns_back_and_the_others_keep_their_speed():
    speed, ramp_s, dt = 25e-3, 0.05, 1.0 / 400
    for name, sizes in SIZES.items():
        follower = PathFollower(make_strategy(name, *sizes), speed * ramp_s / 2)
        x = y = 0.0
        velocities = []
        for _ in range(2000):
            pace = follower.pace
            hx, hy = follower.step(x, y, pace * speed * dt)
            x, y = x + hx * pace * speed * dt, y + hy * pace * speed * dt
            velocities.append((hx * pace, hy * pace))
        v = np.array(velocities)
        if name == "straight":
            jumps = np.linalg.norm(np.diff(v, axis=0), axis=1)
            assert jumps.max() < 3.0 * dt / ramp_s  # at once it would be 2
            assert (np.diff(np.sign(v[:, 0])) != 0.0).sum() == 4  # it turns back at each end
            assert np.mean(np.linalg.norm(v, axis=1)) > 0.9
        else:
            assert np.linalg.norm(v, axis=1) == pytest.approx(1.0)


def test_unknown_strategy_is_refused():
    with pytest.raises(KeyError):
        make_strategy("spiral", 0.01, 0.01)
