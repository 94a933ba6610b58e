"""The depth of a probe in what it touched before, against spheres and planes whose depth is known."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch.depth_witness import CONTRADICTED_S, WANDER, DepthWitness, sigma_ahead

R, D1, LIMIT, STEP_S = 40e-3, 0.25e-3, 5.0, 5e-3
OBJECT = 60e-3
"""Radius of the touched ball, m; its top is the origin."""
rng = np.random.default_rng(7)


def touch_ball(witness, x, depth, shown, t):
    """Show the witness the contact over a place x of the ball, at a depth, with a force that the array shows."""
    angle = x / OBJECT
    normal = np.array([math.sin(angle), 0.0, math.cos(angle)])
    normal[:2] += rng.normal(0.0, 2e-3, 2)
    centre = np.array([0.0, 0.0, -OBJECT]) + (OBJECT + R - depth) * np.array([math.sin(angle), 0.0, math.cos(angle)])
    centre = centre + rng.normal(0.0, 5e-6, 3)
    witness.step(t, centre, normal / np.linalg.norm(normal), shown, d1=D1, force_max=LIMIT)


def scan(witness, seconds, speed, depth_of, shown_of):
    """Times at which the witness contradicts, in a scan at constant speed."""
    times = []
    for k in range(round(seconds / STEP_S)):
        t = k * STEP_S
        touch_ball(witness, speed * t, depth_of(t), shown_of(t), t)
        if witness.contradicts or (witness.fall is not None and witness.fall.lasts_s >= CONTRADICTED_S):
            times.append(t)
    return times


def depth(force):
    return D1 * math.sqrt(force)


def sinking(t, rate=0.1e-3):
    """Depth of a probe that sinks from 0.5 s on, m."""
    return depth(2.0) + rate * max(t - 0.5, 0.0)


def off(t):
    """Depth of a probe that moves off from 1 s on, m."""
    return max(depth(2.0) - 40e-3 * max(t - 1.0, 0.0), 0.0)


TRUE = {
    "at rest": (2.0, 0.0, lambda t: depth(2.0), lambda t: 2.0 + 0.05 * math.sin(40 * t)),
    "slow": (2.0, 3e-3, lambda t: depth(2.0), lambda t: 2.0 + 0.05 * math.sin(40 * t)),
    "fast": (2.0, 100e-3, lambda t: depth(2.0), lambda t: 2.0 + 0.05 * math.sin(40 * t)),
    "it moves out": (2.0, 0.0, lambda t: depth(2.0) - 0.05e-3 * t, lambda t: 2.0),
    "it moves off and the force falls": (1.1, 0.0, off, lambda t: (off(t) / D1) ** 2),
    "it goes in as far as its force says": (2.5, 5e-3, sinking, lambda t: (sinking(t, 0.07e-3) / D1) ** 2),
    "one bad image": (1.2, 25e-3, lambda t: depth(2.0), lambda t: 0.5 if t == 200 * STEP_S else 2.0),
}
"""Seconds, speed over the ball, depth and shown force of scans in which nothing is wrong."""


@pytest.mark.parametrize("name", TRUE)
def test_a_true_scan_is_never_contradicted(name):
    seconds, speed, depth_of, shown_of = TRUE[name]
    witness = DepthWitness(R, holds=speed == 0.0)
    assert not scan(witness, seconds, speed, depth_of, shown_of)
    assert witness.fall is None


def test_the_depth_is_that_of_the_probe():
    witness = DepthWitness(R)
    scan(witness, 1.0, 10e-3, lambda t: depth(2.0), lambda t: 2.0)
    touch_ball(witness, 10e-3, depth(4.0), 2.0, 1.0)
    assert witness.depth == pytest.approx(depth(4.0), abs=3 * witness.sigma)
    assert witness.force == pytest.approx(4.0, rel=0.2)
    assert witness.sigma < 40e-6


@pytest.mark.parametrize(("speed", "inward"), [(0.0, 0.2e-3), (10e-3, 1.5e-3)])
def test_a_force_that_does_not_grow_with_the_depth_is_contradicted_before_half_the_limit_more(speed, inward):
    """The probe goes in slowly from one second on; the array shows 2 N all the time."""
    witness = DepthWitness(R, holds=speed == 0.0)

    def sunk(t):
        return depth(2.0) + inward * max(t - 1.0, 0.0)

    times = scan(witness, 2.0, speed, sunk, lambda t: 2.0)
    assert times, "never noticed"
    true_force = (sunk(times[0]) / D1) ** 2
    assert true_force < 1.5 * LIMIT
    assert times[0] - 1.0 >= CONTRADICTED_S


def test_a_better_depth_at_1_n_places_all_contacts_anew():
    witness = DepthWitness(R, holds=True)
    scan(witness, 1.0, 0.0, lambda t: 1.3 * depth(2.0), lambda t: 2.0)
    centre = np.array([0.0, 0.0, R - 1.3 * depth(2.0)])
    witness.step(1.0, centre, np.array([0.0, 0.0, 1.0]), 2.0, d1=1.3 * D1, force_max=LIMIT)
    assert witness.depth == pytest.approx(1.3 * depth(2.0), abs=20e-6)


@pytest.mark.parametrize("gain", [0.0, 0.3])
def test_a_force_that_falls_at_once_is_told_after_its_time(gain):
    witness = DepthWitness(R)
    shown = {False: 2.0, True: 2.0 * gain}
    times = scan(witness, 1.0 + CONTRADICTED_S + 2 * STEP_S, 25e-3, lambda t: depth(2.0), lambda t: shown[t >= 1.0])
    assert times[0] == pytest.approx(1.0 + CONTRADICTED_S, abs=2 * STEP_S)
    assert witness.fall.before == pytest.approx(2.0)
    assert witness.fall.within_s == pytest.approx(STEP_S)


def test_a_hold_that_wanders_aside_is_told():
    witness = DepthWitness(R, holds=True)
    scan(witness, 0.6, 0.0, lambda t: depth(2.0), lambda t: 2.0)
    for k in range(300):
        touch_ball(witness, 5e-3 * k * STEP_S, depth(2.0), 2.0, 0.6 + k * STEP_S)
        if witness.contradicts:
            break
    assert WANDER < witness.wandered < 2 * WANDER


def test_new_ground_is_known_the_less_the_farther_it_is():
    assert sigma_ahead(0.0) < sigma_ahead(2e-3) < sigma_ahead(10e-3)
    witness = DepthWitness(R)
    scan(witness, 0.5, 25e-3, lambda t: depth(2.0), lambda t: 2.0)
    near = witness.sigma
    touch_ball(witness, 0.5 * 25e-3 + 8e-3, depth(2.0), 2.0, 0.8)
    assert witness.sigma > 5 * near


def test_a_new_touch_begins_without_the_old_surface():
    witness = DepthWitness(R)
    scan(witness, 0.5, 25e-3, lambda t: depth(2.0), lambda t: 2.0)
    witness.restart()
    touch_ball(witness, 0.0, depth(2.0), 2.0, 1.0)
    assert math.isnan(witness.depth) and not witness.contradicts


def test_a_way_aside_may_lower_the_force_by_the_steepest_slope():
    """From 2 N the probe goes aside over ground that falls away: by 0.29 of its way it does what it may, by 0.5 not."""
    for slope, falls in ((0.29, False), (0.5, True)):
        witness, way, up = DepthWitness(R), 0.4e-3, np.array([0.0, 0.0, 1.0])
        for k in range(60):
            witness.step(k * STEP_S, np.array([2e-5 * k, 0.0, R]), up, 2.0, d1=D1, force_max=LIMIT)
        left = max(depth(2.0) - slope * way, 0.0)
        aside = np.array([2e-5 * 59 + way, 0.0, R])
        witness.step(60 * STEP_S, aside, up, (left / D1) ** 2, d1=D1, force_max=LIMIT)
        assert (witness.fall is not None) == falls, slope


@pytest.mark.parametrize(("radius", "known"), [(2.0 * R, True), (0.5 * R, False)])
def test_in_a_hollow_that_is_narrower_than_the_probe_no_depth_is_known(radius, known):
    """The probe goes round in a bowl."""
    witness = DepthWitness(R)
    for k in range(200):
        x, y = 2e-3 * math.cos(0.05 * k), 2e-3 * math.sin(0.05 * k)
        outward = np.array([-x, -y, math.sqrt(radius**2 - x * x - y * y)]) / radius
        centre = np.array([0.0, 0.0, radius]) + (R - depth(2.0) - radius) * outward
        witness.step(k * STEP_S, centre, outward, 2.0, d1=D1, force_max=LIMIT)
    assert math.isfinite(witness.sigma) == known


def test_a_contact_on_a_flank_does_not_show_the_top():
    """A contact on a wall close by changes nothing of the depth."""
    depths = []
    for flank in (False, True):
        witness = DepthWitness(R)
        for k in range(300):
            if flank and k == 150:
                wall = np.array([1.0, 0.0, 1e-6])
                witness.step(k * STEP_S, np.array([10e-3, 0.0, R]), wall, 2.0, d1=D1, force_max=LIMIT)
            centre = np.array([2e-3 * math.sin(0.01 * k), 0.0, R - depth(2.0)])
            witness.step(k * STEP_S, centre, np.array([0.0, 0.0, 1.0]), 2.0, d1=D1, force_max=LIMIT)
        depths.append(witness.depth)
    assert depths[1] == pytest.approx(depths[0], abs=1e-6)


@pytest.mark.parametrize("speed", [2e-3, 5e-3])
def test_a_probe_that_sinks_with_its_contacts_is_told_before_the_limit(speed):
    """The array fades, the servo holds what it shows, and each contact lies a little deeper than the last one."""
    witness = DepthWitness(R)
    times = scan(witness, 5.0, speed, sinking, lambda t: 2.0)
    assert times, "never noticed"
    assert 0.8 * LIMIT < (sinking(times[0]) / D1) ** 2 < LIMIT
    assert witness.force > 0.8 * LIMIT


def over_plane(witness, *, tilt=0.0, rate=0.0):
    """The first time at which a scan to and fro over 20 mm of a plane, at 14 mm/s, is contradicted; None: never.

    The arm's ways are off by an angle, rad; the probe sinks, m/s.
    """
    for k in range(1200):
        t, x = k * STEP_S, 20e-3 * (1.0 - abs(1.0 - (k % 600) / 300))
        centre = np.array([x, 0.0, R - depth(2.0) - tilt * x - rate * t])
        witness.step(t, centre, np.array([0.0, 0.0, 1.0]), 2.0, d1=D1, force_max=LIMIT)
        if witness.contradicts:
            return t
    return None


def test_a_path_that_comes_back_shows_how_far_the_probe_has_sunk():
    told = over_plane(DepthWitness(R), rate=0.06e-3)
    assert told is not None
    assert 3.0 < ((depth(2.0) + 0.06e-3 * told) / D1) ** 2 < LIMIT


def test_an_arm_that_is_not_where_it_says_goes_ways_at_an_angle():
    """Between two new places nothing else tells the sinking of a probe from ways that are off."""
    assert over_plane(DepthWitness(R), tilt=4e-3) is None
    assert over_plane(DepthWitness(R), tilt=30e-3) is not None
    assert over_plane(DepthWitness(R, slope_sigma=30e-3), tilt=30e-3) is None


def test_a_pose_that_is_wrong_once_is_no_place_to_sink_from():
    """Behind a lost PDO the probe seems to stand 0.2 mm off, for one image."""
    witness, up = DepthWitness(R), np.array([0.0, 0.0, 1.0])
    for k in range(300):
        centre = np.array([25e-3 * k * STEP_S, 0.0, R - depth(2.0) + 0.2e-3 * (k == 100)])
        witness.step(k * STEP_S, centre, up, 2.0, d1=D1, force_max=LIMIT)
        assert not witness.contradicts, k
