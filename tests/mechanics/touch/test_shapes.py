"""Ellipsoid, torus, wave, fillet and bowl: feet against dense sampling and scipy, curvatures against differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch import make_object
from canprobe.mechanics.touch.shapes import LIP_M

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", (12, -25, 70), degrees=True).as_matrix()
POSE[:3, 3] = (-0.120, -0.1225, 0.374)
A, L, R, RING, TUBE, BOWL = 0.004, 0.09, 0.03, 0.08, 0.03, 0.1
HALF = math.radians(30.0)


def torus(u, v):
    out = RING + TUBE * np.sin(v)
    return out * np.cos(u) - RING, out * np.sin(u), TUBE * (np.cos(v) - 1.0)


def fillet(x, s):
    """s: arc length across, 0 in the middle."""
    turn = np.clip(s / R, -HALF, HALF)
    beyond = s - turn * R
    return x, R * np.sin(turn) + beyond * np.cos(turn), R * (np.cos(turn) - 1.0) - beyond * np.sin(turn)


def bowl(u, v):
    """v up to a quarter turn: the hollow; beyond: round the lip, one radian of v a millimetre's turn."""
    lip = np.clip(v - math.pi / 2, 0.0, None)
    inside = np.minimum(v, math.pi / 2)
    out = np.where(lip > 0, BOWL + LIP_M * (1.0 - np.cos(lip)), BOWL * np.sin(inside))
    up = np.where(lip > 0, BOWL + LIP_M * np.sin(lip), BOWL * (1.0 - np.cos(inside)))
    return out * np.cos(u), out * np.sin(u), up


SURFACES = {
    "ellipsoid": ({"radius_x": 0.06, "radius_y": 0.045, "radius_z": 0.035}, lambda u, v: (
        0.06 * np.sin(v) * np.cos(u), 0.045 * np.sin(v) * np.sin(u), 0.035 * (np.cos(v) - 1.0)),
        (-math.pi, math.pi), (0.0, math.pi)),
    "torus": ({"ring_radius": RING, "radius": TUBE}, torus, (-0.8, 0.8), (-math.pi, math.pi)),
    "wave": ({"amplitude": A, "wavelength": L}, lambda x, y: (x, y, A * (np.cos(2 * math.pi * y / L) - 1.0)),
             (-0.08, 0.08), (-0.12, 0.12)),
    "fillet": ({"radius": R, "angle": 2 * HALF}, fillet, (-0.08, 0.08), (-0.12, 0.12)),
    "bowl": ({"radius": BOWL}, bowl, (-math.pi, math.pi), (0.0, math.pi)),
}  # fmt: skip
EACH = pytest.mark.parametrize("name", SURFACES)


def build(name):
    return make_object(name, T_base_object=POSE, **SURFACES[name][0])


def base(local):
    return np.asarray(local) @ POSE[:3, :3].T + POSE[:3, 3]


def least_distance(name, query):
    """Over a dense sampling, then polished: independent of how the shape does it."""
    _, surface, first, second = SURFACES[name]
    u, v = np.meshgrid(np.linspace(*first, 201), np.linspace(*second, 301))
    points = base(np.stack(np.broadcast_arrays(*surface(u, v)), axis=-1))
    nearest = np.unravel_index(np.argmin(np.linalg.norm(points - query, axis=-1)), u.shape)
    place, simplex = np.array((u[nearest], v[nearest])), np.array(((0, 0), (1, 0), (0, 1)))
    for size in (1e-2, 1e-3, 1e-4):  # a simplex that has shrunk too early starts again
        found = minimize(
            lambda s: np.linalg.norm(base(np.array([float(x) for x in surface(*s)])) - query),
            place, method="Nelder-Mead",
            options={"xatol": 1e-9, "fatol": 1e-14, "initial_simplex": place + size * simplex},
        )  # fmt: skip
        place = found.x
    return found.fun


QUERY = st.tuples(st.floats(-0.02, 0.02), st.floats(-0.03, 0.03), st.floats(0.003, 0.045)).map(np.array)


@EACH
@settings(max_examples=12, deadline=None)
@given(local=QUERY)
def test_foot_is_the_nearest_point_of_the_surface(name, local):
    query = base(local)
    c = build(name).closest(query)
    assert query - c.point == pytest.approx(c.distance * c.normal, abs=1e-12)
    assert np.linalg.norm(c.normal) == pytest.approx(1.0, abs=1e-12)
    assert abs(c.distance) == pytest.approx(least_distance(name, query), abs=1e-12)
    assert build(name).closest(c.point).distance == pytest.approx(0.0, abs=1e-12)
    assert np.cross(*c.directions) == pytest.approx(c.normal, abs=1e-12)


@EACH
@settings(max_examples=25, deadline=None)
@given(local=QUERY)
def test_normal_and_curvature_are_slopes(name, local):
    """Over a parallel surface the normal turns by kappa / (1 + h kappa) a metre, and distance grows along it."""
    shape, query, h = build(name), base(local), 1e-6
    c = shape.closest(query)
    for kappa, d in zip(c.kappa, c.directions, strict=True):
        ahead, back = shape.closest(query + h * d), shape.closest(query - h * d)
        if ahead.kappa != pytest.approx(back.kappa, abs=1e-2) or 1.0 + c.distance * kappa < 0.05:
            return  # across a jump of curvature, or where every way is as far
        assert (ahead.normal - back.normal) / (2 * h) == pytest.approx(kappa / (1 + c.distance * kappa) * d, abs=1e-3)
        assert (ahead.distance - back.distance) / (2 * h) == pytest.approx(0.0, abs=1e-6)
    assert shape.closest(query + h * c.normal).distance == pytest.approx(c.distance + h, abs=1e-12)


def test_curvatures_at_known_places():
    torus = build("torus")
    outside, inside = torus.closest(base((TUBE + 0.01, 0, -TUBE))), torus.closest(base((-TUBE - 0.01, 0, -TUBE)))
    assert outside.kappa == pytest.approx((1 / TUBE, 1 / (RING + TUBE)))
    assert inside.kappa == pytest.approx((1 / TUBE, -1 / (RING - TUBE)))
    assert torus.tightest_concave_radius() == pytest.approx(RING - TUBE)
    wave, k = build("wave"), 2 * math.pi / L
    assert wave.closest(base((0, 0, 0.01))).kappa == pytest.approx((A * k * k, 0.0))
    assert wave.closest(base((0, L / 2, 0.01))).kappa == pytest.approx((0.0, -A * k * k))
    assert wave.tightest_concave_radius() == pytest.approx(1 / (A * k * k))
    edge = build("fillet")
    assert edge.closest(base((0, 0, 0.02))).kappa == pytest.approx((1 / R, 0.0))
    assert edge.closest(base((0, 0.05, 0.02))).kappa == pytest.approx((0.0, 0.0))
    assert edge.tightest_concave_radius() == math.inf


@pytest.mark.parametrize("name", ["bowl", "wave"])
def test_gaps_are_the_distances(name):
    shape = build(name)
    local = np.random.default_rng(0).uniform((-0.02, -0.03, -0.001), (0.02, 0.03, 0.001), (50, 3))
    if name == "wave":
        local[:, 2] = 1e-5 + A * (np.cos(2 * math.pi * local[:, 1] / L) - 1.0)
    else:
        local[:, 2] += BOWL - np.sqrt(BOWL**2 - local[:, 0] ** 2 - local[:, 1] ** 2)
        local[:20] = np.random.default_rng(1).uniform((-0.11, -0.11, 0.1), (0.11, 0.11, 0.12), (20, 3))
    expected = [shape.closest(p).distance for p in base(local)]
    assert shape.gaps(base(local)) == pytest.approx(expected, abs=1e-8)


def test_a_ball_too_large_for_a_bowl_rests_on_the_lip_all_round():
    shape = make_object("bowl", T_base_object=POSE, radius=0.03)
    height = 0.03 + math.sqrt((0.04 + LIP_M - 3e-4) ** 2 - (0.03 + LIP_M) ** 2)
    found = shape.touches(base((0.0, 0.0, height)), 0.04)
    assert len(found.points) == 360
    assert found.distances == pytest.approx([0.04 - 3e-4] * 360, abs=1e-12)
    assert found.edge_m.sum() == pytest.approx(2 * math.pi * (0.03 + LIP_M))
    assert shape.gaps(found.points) == pytest.approx([0.0] * 360, abs=1e-12)
    one = shape.closest(base((0.0, 0.0, height)))
    assert found.kappa[0] == pytest.approx(one.kappa, rel=1e-9)
    aside = shape.touches(base((1e-3, 0.0, height)), 0.04)
    assert 0 < len(aside.points) < 360
    assert shape.touches(base((0.0, 0.0, 0.02)), 0.04) is None


def test_a_trough_too_tight_for_a_ball_touches_it_on_both_walls():
    tight = make_object("wave", T_base_object=POSE, amplitude=0.01, wavelength=0.06)
    found = tight.touches(base((0.0, 0.03, -0.02 + 0.0425)), 0.045)
    assert len(found.points) == 2
    assert found.distances == pytest.approx([found.distances[0]] * 2, abs=1e-12)
    walls = (found.points - POSE[:3, 3]) @ POSE[:3, :3]
    assert walls[:, 1] - 0.03 == pytest.approx([walls[0, 1] - 0.03, 0.03 - walls[0, 1]], abs=1e-12)
    assert tight.touches(base((0.0, 0.0, 0.0398)), 0.04) is None
