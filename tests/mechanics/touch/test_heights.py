"""Heights over a grid as one smooth surface: against the formulae that they are of, and against brute force."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch import make_object

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", (12, -25, 70), degrees=True).as_matrix()
POSE[:3, 3] = (-0.120, -0.1225, 0.374)
SPACING = 5e-4
BALL = 0.03


def grid(half_x=0.025, half_y=0.022, spacing=SPACING):
    return np.meshgrid(*(np.arange(-half, half + 1e-9, spacing) for half in (half_x, half_y)), indexing="ij")


def heights(z, pose=POSE, spacing=SPACING, origin=(0, 0)):
    return make_object("heights", T_base_object=pose, heights=z, spacing=spacing, origin=origin)


X, Y = grid()
RING = np.hypot(X + 0.06, Y) - 0.06
EXACT = {
    "saddle": ({"radius_x": 0.06, "radius_y": -0.08}, -(X**2) / 0.12 + Y**2 / 0.16),
    "torus": ({"ring_radius": 0.06, "radius": 0.03}, np.sqrt(0.03**2 - RING**2) - 0.03),
}


@pytest.mark.parametrize("kind", EXACT)
def test_heights_of_a_formula_are_its_surface(kind):
    """Every 0.5 mm; a hundred times nearer than the 5 µm, 0.5 mrad and 1 % that are asked for."""
    params, z = EXACT[kind]
    exact, read = make_object(kind, T_base_object=POSE, **params), heights(z)
    for local in np.random.default_rng(1).uniform((-0.01, -0.01, 0.02), (0.01, 0.01, 0.03), (60, 3)):
        at = POSE[:3, :3] @ local + POSE[:3, 3]
        a, b = exact.closest(at), read.closest(at)
        assert b.point == pytest.approx(a.point, abs=5e-8)
        assert b.normal == pytest.approx(a.normal, abs=5e-6)
        assert b.distance == pytest.approx(a.distance, abs=1e-8)
        tensors = [(c.directions.T * c.kappa) @ c.directions for c in (a, b)]
        assert np.linalg.norm(tensors[1] - tensors[0]) < 1e-3 * np.linalg.norm(tensors[0])
        assert np.cross(*b.directions) == pytest.approx(b.normal, abs=1e-12)
        assert b.kappa[0] >= b.kappa[1]


def rough(seed=3):
    """Sharp and tangled: waves of a few millimetres, and a groove."""
    rng = np.random.default_rng(seed)
    z = -(X**2 + Y**2) / 0.12
    for kx, ky, phase in rng.uniform((-900, -900, 0), (900, 900, 6), (6, 3)):
        z = z + 4e-5 * np.cos(kx * X + ky * Y + phase)
    return z - 3e-4 * np.exp(-(((X - 0.3 * Y - 2e-3) / 8e-4) ** 4))


def test_the_foot_is_the_nearest_of_all_points_of_a_rough_surface():
    """Against the spline sampled every 30 µm."""
    shape = heights(rough(), pose=np.eye(4))
    u, v = (axis.ravel() for axis in np.meshgrid(*[np.arange(-0.012, 0.012, 3e-5)] * 2, indexing="ij"))
    surface = np.column_stack((u, v, shape.spline.many(u, v)[0]))
    for at in np.random.default_rng(5).uniform((-0.006, -0.006, 0.0295), (0.006, 0.006, 0.0305), (25, 3)):
        nearest = np.sqrt(np.sum((surface - at) ** 2, axis=1).min())
        foot = shape.closest(at)
        assert nearest - 2e-7 < foot.distance < nearest + 4e-6
        assert at - foot.point == pytest.approx(foot.distance * foot.normal, abs=1e-12)


def test_an_answer_does_not_depend_on_what_was_asked_before():
    ways = np.random.default_rng(2).uniform((-0.008, -0.008, 0.029), (0.008, 0.008, 0.033), (80, 3))
    walked = heights(rough())
    walk = [walked.nearest(tuple(POSE[:3, :3] @ p + POSE[:3, 3])) for p in ways]
    again = [walked.nearest(tuple(POSE[:3, :3] @ p + POSE[:3, 3])) for p in ways[::-1]][::-1]
    assert walk == again


def test_gaps_are_signed_distances_near_the_surface():
    shape = heights(rough())
    for local in np.random.default_rng(4).uniform((-0.01, -0.01, 0), (0.01, 0.01, 0), (20, 3)):
        foot = shape.closest(POSE[:3, :3] @ (local + np.array((0, 0, 1e-3))) + POSE[:3, 3])
        beside = np.array([foot.point + gap * foot.normal for gap in (-2e-6, 0.0, 2e-6)])
        assert shape.gaps(beside) == pytest.approx([-2e-6, 0.0, 2e-6], abs=1e-8)
    assert shape.gaps(POSE[:3, 3] + POSE[:3, 0][None]) > 0  # nothing is beside the grid


def test_a_ball_stands_on_both_edges_of_a_groove_and_presses_less_over_it():
    plain, grooved = np.zeros_like(X), -5e-4 * np.exp(-((X / 8e-4) ** 6))
    groove, plane = heights(grooved, pose=np.eye(4), origin=(4e-3, 0)), heights(plain, pose=np.eye(4))
    over = (-4e-3, 0.0, BALL - 1e-4)
    touches = groove.touches(over, BALL)
    assert touches is not None and len(touches.points) == 2
    left, right = sorted((touches.points[:, 0] + 4e-3).tolist())
    assert left == pytest.approx(-right, abs=1e-9) and 5e-4 < right < 1.5e-3
    assert groove.touches((8e-3, 0.0, BALL - 1e-4), BALL) is None
    there = (BALL**2 * math.pi * 1e-4**2 / BALL) / BALL**2  # plane: pi d^2 R
    assert plane.squeezed((0.0, 0.0, BALL - 1e-4), BALL) == pytest.approx(there * BALL**2, rel=0.01)
    assert groove.squeezed(over, BALL) < 0.6 * plane.squeezed((0.0, 0.0, BALL - 1e-4), BALL)


def test_the_surface_at_the_origin_is_at_height_zero_wherever_it_is():
    z = np.sqrt(0.05**2 - X**2 - Y**2) + 0.65
    shape = heights(z, pose=np.eye(4), origin=(5e-3, -4e-3))
    assert shape.closest((0.0, 0.0, 0.0)).distance == pytest.approx(0.0, abs=1e-15)
    top = math.sqrt(0.05**2 - 0.005**2 - 0.004**2) - 0.05
    centre = np.array((-5e-3, 4e-3, -0.05 - top))
    assert shape.closest((0.0, 0.0, 0.02)).distance == pytest.approx(
        np.linalg.norm(centre - (0, 0, 0.02)) - 0.05, abs=1e-8
    )


def test_beyond_its_border_the_foot_is_on_the_border():
    foot = heights(np.zeros_like(X), pose=np.eye(4)).closest((0.05, 0.0, 0.01))
    assert foot.point == pytest.approx((0.025, 0.0, 0.0), abs=1e-12)
    assert foot.distance == pytest.approx(math.hypot(0.025, 0.01), abs=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"heights": np.zeros((7, 20))}, "grid of 8 × 8 or more, got shape \\(7, 20\\)"),
        ({"heights": np.zeros(20)}, "grid of 8 × 8"),
        ({"heights": np.where(np.indices((9, 9))[0] == 4, np.nan, 0.0)}, "finite, got nan at row 4, column 0"),
        ({"spacing": 0.0}, "spacing must be a positive length"),
        ({"origin": (1.0, 0.0)}, "beside the surface"),
    ],
)
def test_wrong_heights_are_refused_with_what_was_expected(change, message):
    given = {"heights": np.zeros((9, 9)), "spacing": 1e-3, "origin": (0, 0), **change}
    with pytest.raises(ValueError, match=message):
        make_object("heights", T_base_object=np.eye(4), **given)
