"""Object geometry: closest points, normals and curvatures against the quadric, scipy and finite differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from canprobe.mechanics.touch import make_object

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", (12, -25, 70), degrees=True).as_matrix()
POSE[:3, 3] = (-0.120, -0.1225, 0.374)

# Ellipsoid of half-axes 60, 45, 35 mm, origin at its top: (x/60)^2 + (y/45)^2 + ((z + 35)/35)^2 = 1.
ELLIPSOID = np.diag((1 / 0.06**2, 1 / 0.045**2, 1 / 0.035**2, 0.0))
ELLIPSOID[2, 3] = ELLIPSOID[3, 2] = 1 / 0.035
TWISTED = np.array([[6.0, 2.0, 0.5, 0.0], [2.0, -3.0, 1.0, 0.0], [0.5, 1.0, 4.0, 0.5], [0.0, 0.0, 0.5, 0.0]])

# kind, parameters (m), curvatures at the origin (1/m), direction of the larger one in the object's frame
SHAPES = {
    "plane": ("plane", {}, (0.0, 0.0), None),
    "sphere": ("sphere", {"radius": 0.05}, (20.0, 20.0), None),
    "cylinder": ("cylinder", {"radius": 0.036}, (1 / 0.036, 0.0), (0, 1, 0)),
    "saddle": ("saddle", {"radius_x": 0.06, "radius_y": -0.08}, (1 / 0.06, -12.5), (1, 0, 0)),
    "bowl": ("bowl", {"radius": 0.1}, (-10.0, -10.0), None),
    "ellipsoid": ("quadric", {"matrix": ELLIPSOID}, (0.035 / 0.045**2, 0.035 / 0.06**2), (0, 1, 0)),
    "twisted": ("quadric", {"matrix": TWISTED}, (3.0 + math.sqrt(97.0), 3.0 - math.sqrt(97.0)), None),
}
DIAGONALS = {
    "plane": (0.0, 0.0, 0.0),
    "sphere": (10.0, 10.0, 10.0),
    "cylinder": (0.0, 0.5 / 0.036, 0.5 / 0.036),
    "saddle": (0.5 / 0.06, -0.5 / 0.08, 0.0),
    "bowl": (-5.0, -5.0, -5.0),
}
"""Of the surfaces x'Dx + z = 0 in the object's frame."""
EACH = pytest.mark.parametrize("name", SHAPES)


def build(name, pose=POSE):
    kind, params, _, _ = SHAPES[name]
    return make_object(kind, T_base_object=pose, **params)


def quadric_of(name):
    """S of the surface in base, f < 0 inside, |∇f| = 1 at the object's origin."""
    if name in DIAGONALS:
        S = np.diag((*DIAGONALS[name], 0.0))
        S[2, 3] = S[3, 2] = 0.5
    else:
        S = SHAPES[name][1]["matrix"]
    T = np.linalg.inv(POSE)
    return T.T @ (S * 0.5 / S[2, 3]) @ T


def above(local):
    """Base coordinates of a point of the object's frame."""
    return POSE[:3, :3] @ local + POSE[:3, 3]


QUERY = st.tuples(st.floats(-0.015, 0.015), st.floats(-0.015, 0.015), st.floats(-0.004, 0.06)).map(np.array)


@EACH
def test_origin_is_on_the_surface_with_z_outward(name):
    _, _, kappa, direction1 = SHAPES[name]
    for height in (0.04, 1e-4, -1e-4):
        c = build(name).closest(above((0, 0, height)))
        assert c.point == pytest.approx(POSE[:3, 3], abs=1e-15)
        assert c.normal == pytest.approx(POSE[:3, 2], abs=1e-15)
        assert c.distance == pytest.approx(height, abs=1e-15)
        assert c.kappa == pytest.approx(kappa, abs=1e-9)
        if direction1 is not None:
            assert abs(c.directions[0] @ POSE[:3, :3] @ direction1) == pytest.approx(1.0)


@EACH
@settings(max_examples=40)
@given(local=QUERY)
def test_foot_normal_and_curvature_are_those_of_the_surface_matrix(name, local):
    shape, query = build(name), above(local)
    c, S = shape.closest(query), quadric_of(name)
    X = np.append(c.point, 1.0)
    half_gradient = (S @ X)[:3]
    assert abs(X @ S @ X) < 1e-12
    assert c.normal == pytest.approx(half_gradient / np.linalg.norm(half_gradient), abs=1e-9)
    assert query - c.point == pytest.approx(c.distance * c.normal, abs=1e-12)
    d1, d2 = c.directions
    assert np.cross(d1, d2) == pytest.approx(c.normal, abs=1e-12)
    assert (d1 @ d1, d1 @ c.normal) == pytest.approx((1.0, 0.0), abs=1e-12)
    K = c.directions @ S[:3, :3] @ c.directions.T / np.linalg.norm(half_gradient)
    assert pytest.approx(np.diag(c.kappa), abs=1e-8) == K
    assert c.kappa[0] >= c.kappa[1]


@pytest.mark.parametrize("name", ["ellipsoid", "twisted"])
@pytest.mark.parametrize("seed", range(2))
def test_distance_is_the_minimum_found_by_scipy(name, seed):
    rng = np.random.default_rng(seed)
    shape, S = build(name), quadric_of(name)
    query = above(rng.uniform((-0.015, -0.015, 0.001), (0.015, 0.015, 0.05)))
    surface = {
        "type": "eq",
        "fun": lambda p: 1e3 * np.append(p, 1.0) @ S @ np.append(p, 1.0),
        "jac": lambda p: 2e3 * (S @ np.append(p, 1.0))[:3],
    }
    best = min(
        minimize(
            lambda p: 1e4 * np.sum((p - query) ** 2),
            query + rng.normal(0, 0.01, 3),
            jac=lambda p: 2e4 * (p - query),
            constraints=[surface],
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 400},
        ).fun
        for _ in range(5)
    )
    assert shape.closest(query).distance == pytest.approx(math.sqrt(best / 1e4), abs=1e-7)


def test_bowl_is_hollow_above_its_origin_and_has_a_rim():
    bowl = build("bowl")
    side = bowl.closest(above((0.09, 0.0, 0.1)))
    assert side.distance == pytest.approx(0.01)
    assert side.normal == pytest.approx(-POSE[:3, 0], abs=1e-12)
    over = bowl.closest(above((0.1, 0.0, 0.15)))  # the lip is rounded by 1 mm about (0.101, 0.1)
    assert over.distance == pytest.approx(math.hypot(0.001, 0.05) - 0.001)
    assert over.normal == pytest.approx(POSE[:3, :3] @ (-0.001, 0.0, 0.05) / math.hypot(0.001, 0.05))
    assert bowl.closest(above((0.15, 0.0, 0.11))).distance == pytest.approx(0.009)


@pytest.mark.parametrize(
    ("name", "radius"),
    [
        ("plane", math.inf),
        ("ellipsoid", math.inf),
        ("bowl", 0.1),
        ("saddle", 0.08),
        ("twisted", 1 / (math.sqrt(97.0) - 3.0)),
    ],
)
def test_tightest_hollow(name, radius):
    tightest = build(name).tightest_concave_radius()
    if name == "twisted":  # sampled round the origin, where it is known
        assert build(name).tightest_concave_radius(POSE[:3, 3]) == pytest.approx(radius)
        assert tightest <= radius
    else:
        assert tightest == pytest.approx(radius)


def test_tightest_hollow_of_a_region_is_milder_than_at_the_origin():
    far = [above((x, 0.05, 0.02)) for x in (-0.01, 0.0, 0.01)]
    assert build("saddle").tightest_concave_radius(far) > 0.1


@pytest.mark.parametrize("local", [(0.0, 0.0, -0.035), (1e-9, 0.0, -0.03)])
def test_from_the_middle_of_an_ellipsoid(local):
    """Two feet are equally near on the plane of symmetry; one of them is returned, at the right distance."""
    c, S = build("ellipsoid").closest(above(local)), quadric_of("ellipsoid")
    X = np.append(c.point, 1.0)
    assert abs(X @ S @ X) < 1e-9
    assert abs(c.distance) <= 0.035 + local[2] + 0.035 + 1e-12
    assert abs(c.distance) == pytest.approx(np.linalg.norm(c.point - above(local)), abs=1e-9)
    assert np.all(np.isfinite(c.kappa))


def test_on_the_axis_of_a_hollow_beyond_its_centre():
    """Above the centre of curvature the foot leaves the bottom; the two nearest feet lie on the hollow section."""
    c = build("saddle").closest(above((0.0, 0.0, 0.2)))
    assert c.distance < 0.2
    z = 0.2 - 0.08  # foot of a parabola y^2 = 2 R z seen from height h: z = h - R
    feet = [above((0.0, side * math.sqrt(2 * 0.08 * z), z)) for side in (1, -1)]
    assert min(np.abs(c.point - foot).max() for foot in feet) < 1e-9


@pytest.mark.parametrize("name", ["sphere", "cylinder", "bowl"])
def test_centre_of_a_round_body_gives_a_finite_answer(name):
    centre = {"sphere": (0, 0, -0.05), "cylinder": (0, 0, -0.036), "bowl": (0, 0, 0.1)}[name]
    c = build(name).closest(above(centre))
    assert np.all(np.isfinite(np.concatenate((c.point, c.normal, c.kappa, c.directions.ravel()))))


@pytest.mark.parametrize(
    ("kind", "params", "message"),
    [
        ("cone", {}, "unknown object kind 'cone'; one of plane, sphere"),
        ("sphere", {}, "takes radius; got none"),
        ("plane", {"radius": 1.0}, "takes no parameters; got radius"),
        ("sphere", {"radius": -0.05}, "radius must be a positive length"),
        ("saddle", {"radius_x": 0.06, "radius_y": 0.08}, "opposite sign"),
        ("quadric", {"matrix": np.triu(TWISTED)}, "symmetric"),
        ("quadric", {"matrix": np.diag((1.0, 1.0, 1.0, -1.0))}, "through the origin"),
        ("quadric", {"matrix": -ELLIPSOID}, "gradient along"),
        ("torus", {"ring_radius": 0.03, "radius": 0.03}, "ring_radius > radius"),
        ("fillet", {"radius": 0.03, "angle": 4.0}, "angle must be between 0 and pi"),
        ("wave", {"amplitude": 0.0, "wavelength": 0.05}, "amplitude must be a positive length"),
        ("ellipsoid", {"radius_x": 0.1, "radius_y": -0.1, "radius_z": 0.1}, "radius_y must be a positive length"),
    ],
)
def test_wrong_objects_are_refused_with_what_was_expected(kind, params, message):
    with pytest.raises(ValueError, match=message):
        make_object(kind, T_base_object=POSE, **params)


@pytest.mark.parametrize("bad", [2.0 * np.eye(4), np.diag((1.0, 1.0, -1.0, 1.0)), np.full((4, 4), np.nan), np.eye(3)])
def test_a_pose_that_is_not_rigid_is_refused(bad):
    with pytest.raises(ValueError, match="T_base_object"):
        make_object("plane", T_base_object=bad)
