"""SurfaceMatrix: gauge, signs, frame changes, against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.errors import UsageError
from canprobe.mechanics.touch import SurfaceMatrix

NAMES = ["cylinder", "small sphere", "saddle", "ellipsoid"]


def height_hessian(surface: SurfaceMatrix, h: float = 1e-4) -> np.ndarray:
    """Second derivatives of z(x, y) at the contact: K for unit gradient and z inward."""
    z = lambda x, y: float(surface.height(x, y))  # noqa: E731
    xx = (z(h, 0) - 2 * z(0, 0) + z(-h, 0)) / h**2
    yy = (z(0, h) - 2 * z(0, 0) + z(0, -h)) / h**2
    xy = (z(h, h) - z(h, -h) - z(-h, h) + z(-h, -h)) / (4 * h**2)
    return np.array([[xx, xy], [xy, yy]])


@pytest.mark.parametrize("name", NAMES)
def test_in_its_contact_frame_a_surface_has_the_gauge_and_its_curvature(name, truth):
    surface = truth.surface(name)
    assert np.allclose(surface.S[:, 3], [0, 0, -0.5, 0], atol=1e-14)
    assert np.allclose(surface.gradient([0, 0, 0]), [0, 0, -1], atol=1e-14)
    K, basis = surface.curvature_at([0, 0, 0])
    assert np.allclose(K, 2 * surface.S[:2, :2], atol=1e-12)
    assert np.allclose(basis, np.eye(3)[:, :2], atol=1e-12)
    assert np.allclose(height_hessian(surface), K, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("surface", "kappa"),
    [
        (SurfaceMatrix.plane(), (0, 0)),
        (SurfaceMatrix.sphere(0.05), (20, 20)),
        (SurfaceMatrix.sphere(-0.08), (-12.5, -12.5)),
        (SurfaceMatrix.cylinder(0.04, "y"), (25, 0)),
        (SurfaceMatrix.cylinder(0.04, "x"), (0, 25)),
    ],
)
def test_curvature_is_positive_where_convex(surface, kappa):
    K, _ = surface.curvature_at([0, 0, 0])
    assert np.allclose(np.diag(K), kappa)
    assert surface.value([0, 0, 1e-3]) < 0 < surface.value([0, 0, -1e-3])  # z is inward


def test_linear_terms_count_twice():
    S = SurfaceMatrix.from_curvature([[3, 1], [1, -2]], c13=0.5, c23=-0.7, c33=0.3).S
    x, y, z = 0.3, -0.2, 0.1
    by_hand = 1.5 * x * x + 2 * 0.5 * x * y - 1.0 * y * y + 2 * 0.5 * x * z - 2 * 0.7 * y * z + 0.3 * z * z
    assert SurfaceMatrix(S).value([x, y, z]) == pytest.approx(by_hand + 2 * (-0.5) * z, abs=1e-15)


def test_sphere_and_cylinder_are_round():
    a = np.linspace(0, 1, 7)
    on_sphere = 0.05 * np.stack([np.sin(a) * 0.6, np.sin(a) * 0.8, 1 - np.cos(a)], axis=1)
    assert np.abs(SurfaceMatrix.sphere(0.05).value(on_sphere)).max() < 1e-16
    along = np.stack([0.04 * np.sin(a), np.full(7, 0.3), 0.04 * (1 - np.cos(a))], axis=1)
    assert np.abs(SurfaceMatrix.cylinder(0.04, "y").value(along)).max() < 1e-16
    turned = SurfaceMatrix.cylinder(0.04, 0.3)
    line = np.array([np.cos(0.3), np.sin(0.3), 0.0])
    assert abs(turned.value(line)) < 1e-15


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_transform_is_exact_and_moves_value_and_normal(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 4))
    surface = SurfaceMatrix(A + A.T)
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Q, rng.normal(size=3)
    new = surface.transformed(T)
    assert np.allclose(new.S, T.T @ surface.S @ T, atol=1e-14)
    p = rng.normal(size=(5, 3))
    old = p @ Q.T + T[:3, 3]
    assert np.allclose(new.value(p), surface.value(old), atol=1e-12)
    assert np.allclose(new.normal(p) @ Q.T, surface.normal(old), atol=1e-10)
    assert np.allclose(new.transformed(np.linalg.inv(T)).S, surface.S, atol=1e-12)


def test_gradient_is_the_derivative_of_value():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(4, 4))
    surface, p, h = SurfaceMatrix(A + A.T), rng.normal(size=3), 1e-6
    numeric = [(surface.value(p + h * e) - surface.value(p - h * e)) / (2 * h) for e in np.eye(3)]
    assert np.allclose(surface.gradient(p), numeric, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_contact_frame_anywhere_gives_the_same_curvature(name, truth):
    surface = truth.surface(name)
    p = np.array([2e-3, 1e-3, float(surface.height(2e-3, 1e-3))]) * (0.3 if name == "small sphere" else 1.0)
    p = surface.project(p)
    T = surface.contact_frame(p)
    assert np.allclose(T[:3, 2], -surface.normal(p))
    assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-14)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    local = surface.normalised_at(p).transformed(T)
    assert np.allclose(local.S[:, 3], [0, 0, -0.5, 0], atol=1e-12)
    assert np.allclose(2 * local.S[:2, :2], surface.curvature_at(p)[0], atol=1e-9)


def test_ellipsoid_curvature_against_the_closed_form():
    a, b, c = 0.060, 0.045, 0.035
    surface = SurfaceMatrix(np.diag([a**-2, b**-2, c**-2, -1.0]))
    x, y, z = p = surface.project([0.03, 0.02, 0.03])
    gauss = 1 / (a * b * c) ** 2 / (x**2 / a**4 + y**2 / b**4 + z**2 / c**4) ** 2
    K, _ = surface.curvature_at(p)
    assert np.linalg.det(K) == pytest.approx(gauss, rel=1e-12)
    assert (np.linalg.eigvalsh(K) > 0).all()


def test_height_takes_the_root_at_the_contact_and_keeps_digits():
    sphere = SurfaceMatrix.sphere(0.05)
    x = np.array([0.0, 1e-9, 1e-3, 0.049])
    exact = x**2 / (0.05 + np.sqrt(0.05**2 - x**2))
    assert np.allclose(sphere.height(x, 0.0), exact, rtol=1e-12, atol=0)
    assert np.isnan(sphere.height(0.051, 0.0))
    assert SurfaceMatrix.plane().height(0.3, -0.2) == 0.0
    assert SurfaceMatrix.from_curvature([[20, 0], [0, -15]]).height(1e-3, 2e-3) == pytest.approx(1e-5 - 3e-5)


def test_project_finds_the_foot():
    foot = SurfaceMatrix.sphere(0.05).project([0.01, 0.02, -0.01])
    centre = np.array([0, 0, 0.05])
    away = np.array([0.01, 0.02, -0.01]) - centre
    assert np.allclose(foot, centre + 0.05 * away / np.linalg.norm(away), atol=1e-15)
    with pytest.raises(UsageError, match="point"):
        SurfaceMatrix.sphere(0.05).project(centre)


def test_a_sum_blends_two_surfaces_of_one_contact_frame():
    both = SurfaceMatrix.sphere(0.05) + SurfaceMatrix.plane()
    assert np.allclose(both.curvature_at([0, 0, 0])[0], 10 * np.eye(2))
    mix = 0.25 * SurfaceMatrix.sphere(0.05) + 0.75 * SurfaceMatrix.cylinder(0.025)
    assert np.allclose(mix.curvature_at([0, 0, 0])[0], np.diag([0.25 * 20 + 0.75 * 40, 5]))
    assert np.allclose((both - SurfaceMatrix.plane()).S, SurfaceMatrix.sphere(0.05).S)


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: SurfaceMatrix(np.eye(3)), "S"),
        (lambda: SurfaceMatrix([]), "S"),
        (lambda: SurfaceMatrix(np.triu(np.ones((4, 4)))), "S"),
        (lambda: SurfaceMatrix(np.full((4, 4), np.nan)), "S"),
        (lambda: SurfaceMatrix.sphere(0.0), "radius"),
        (lambda: SurfaceMatrix.cylinder(0.1, "z"), "axis"),
        (lambda: SurfaceMatrix.cylinder(0.1, axis=[1, 0, 0]), "axis"),
        (lambda: SurfaceMatrix.from_curvature([1, 2]), "K"),
        (lambda: SurfaceMatrix.from_curvature(np.eye(2), c13="1"), "c13, c23, c33"),
        (lambda: SurfaceMatrix.plane() + 1.0, "sum"),
        (lambda: "2" * SurfaceMatrix.plane(), "factor"),
        (lambda: SurfaceMatrix.plane().value([1j, 0, 0]), "points"),
        (lambda: SurfaceMatrix.plane().normal([0, 0]), "points"),
        (lambda: SurfaceMatrix.plane().height("0", 0.0), "x"),
        (lambda: SurfaceMatrix.plane().transformed(np.eye(3)), "T"),
        (lambda: SurfaceMatrix.sphere(1.0).contact_frame([0, 0, 1]), "point"),
    ],
)
def test_errors_name_the_field(build, field):
    with pytest.raises(UsageError, match=f"^{field}: expected"):
        build()
