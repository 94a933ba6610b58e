"""The servo against exact surfaces: a noise-free sensor and a probe that does as it is told, late."""

import math
from collections import deque

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import Circle, TactileServo, contact_sample, indentation_from_force, make_object
from canprobe.mechanics.touch.contact import direction_to_pad
from canprobe.mechanics.touch.servo import BLIND_S, SETTLE_S, LocalSurface, SurfaceGains
from canprobe.mechanics.touch.strategies import PathFollower, make_strategy

RADIUS_P = 0.040
DEPTH = 0.426e-3
DT = 2.5e-3
AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def surface_of(kind, radius):
    """A surface whose top, or whose bottom where it is a bowl, is the origin; a cylinder lies along x."""
    return make_object(kind, T_base_object=np.eye(4), radius=radius)


def follow(surface, *, know_curvature=True, seconds=3.0):
    """Depth errors (m) and contact points of a closed loop; each command acts ten cycles later."""
    touched = surface.closest((0.0, 0.0, RADIUS_P))
    local = LocalSurface(touched.point, touched.normal, SurfaceGains())
    servo = TactileServo(
        local,
        PathFollower(make_strategy("weave", 0.03, 0.008)),
        axes=AXES,
        origin=touched.point,
        probe_radius=RADIUS_P,
        rolling_share=0.0,
    )
    line = deque([touched.point + touched.normal * (RADIUS_P - DEPTH)] * 10, maxlen=10)
    depths, points = [], []
    for k in range(round(seconds / DT)):
        touched = surface.closest(line[0])
        depths.append(RADIUS_P - touched.distance - DEPTH)
        points.append(touched.point)
        if k % 2 == 0:
            local.correct(touched.point, touched.normal, 2 * DT)
            if know_curvature:
                local.set_curvature((touched.directions.T * touched.kappa) @ touched.directions)
        line.append(servo.next_pose(25e-3, DEPTH, DT).centre)
    return np.array(depths), np.array(points)


@pytest.mark.parametrize(("kind", "radius"), [("sphere", 0.05), ("bowl", 0.12), ("cylinder", 0.036)])
def test_depth_is_kept_while_the_curvature_is_known(kind, radius):
    depths, _ = follow(surface_of(kind, radius))
    assert np.abs(depths).max() < 5e-6  # until it has been taken up
    assert np.abs(depths[200:]).max() < 1e-7


def test_without_curvature_contact_is_kept_all_the_same():
    depths, _ = follow(surface_of("cylinder", 0.036), know_curvature=False)
    assert np.abs(depths).max() < 60e-6  # a seventh of the indentation


def test_a_new_curvature_turns_the_normal_ahead_step_by_step():
    """At once it would turn it by its change times the distance, and a stiff arm with the probe's radius behind it."""
    local = LocalSurface(np.zeros(3), np.array((0.0, 0.0, 1.0)), SurfaceGains(curvature_hz=4.0))
    ahead = np.array((1e-3, 0.0, 0.0))
    local.set_curvature(np.diag((20.0, 0.0, 0.0)))
    assert local.foot(ahead)[1] == pytest.approx((0.0, 0.0, 1.0))
    for _ in range(40):
        local.correct(local.point, local.normal, 1 / (2 * np.pi * 4.0) / 40)
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


@pytest.mark.parametrize(
    ("name", "n"), [("straight", (0, -0.717, 0.697)), ("circle", (0.717, 0, 0.697)), ("weave", (0.5, 0.5, 0.707))]
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


def test_the_contact_keeps_to_the_curve_over_a_steep_crown():
    """Of the true contacts: up to 38 degrees steep."""
    _, points = follow(surface_of("sphere", 0.025), seconds=8.0)
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


@pytest.mark.parametrize("believed", [0.7, 1.4])
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


# Strategies: closed curves from the origin, and where they brake.

SIZES = {"weave": (0.036, 0.009), "circle": (0.02, 0.0), "straight": (0.03, 0.0)}


@pytest.mark.parametrize("name", SIZES)
def test_a_curve_closes_at_the_origin_and_its_tangent_is_its_derivative(name):
    strategy = make_strategy(name, *SIZES[name])
    for phase in np.linspace(0.1, 6.0, 17):
        h = 1e-6
        plus, minus = strategy.point(phase + h), strategy.point(phase - h)
        numeric = [(a - b) / (2 * h) for a, b in zip(plus, minus, strict=True)]
        assert strategy.tangent(phase) == pytest.approx(numeric, abs=1e-7)
    for phase in (0.0, 2 * math.pi):
        assert strategy.point(phase) == pytest.approx((0, 0), abs=1e-12)


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
