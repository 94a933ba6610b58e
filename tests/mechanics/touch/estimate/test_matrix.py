"""All of S: the ten unknowns lie within their stated covariance in any frame, and what was not observed is NaN."""

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import SurfaceEstimate, SurfaceMatrix, UncertainMatrix, fit_surface

UPPER = np.triu_indices(4)
CURVED = [0, 1, 4]
NOISE = {"sigma_point": 20e-6, "sigma_normal": 1e-3}


def true_in(frame, path, estimate):
    """S of a path's surface in a frame, scaled as the estimate is: c34 = −½ in its contact frame."""
    scale = -0.5 / path.surface.transformed(estimate.T_frame_contact).S[2, 3]
    return (path.surface * scale).transformed(frame).S[UPPER]


@pytest.mark.parametrize("method", ["ml", "recursive"])
def test_the_ten_unknowns_of_an_ellipsoid_in_another_frame_lie_within_their_covariance(truth, method):
    path = truth.path("ellipsoid", T=truth.any_pose(2))
    frame = truth.any_pose(3)
    squares, shares = [], []
    for seed in range(24):
        points, normals = path.noisy(*NOISE.values(), seed=seed)
        estimate = fit_surface(points, normals, **NOISE, method=method, quadric=True)
        S, C = estimate.matrix(frame)
        np.testing.assert_array_equal(C, C.T)
        shares.append((S[UPPER] - true_in(frame, path, estimate)) / np.sqrt(np.diag(C)))
        S, C = estimate.matrix()
        error = np.delete(S[UPPER] - true_in(estimate.T_frame_contact, path, estimate), 8)
        squares.append(error @ np.linalg.solve(np.delete(np.delete(C, 8, 0), 8, 1), error))
    rms = np.sqrt(np.mean(np.square(shares), axis=0))
    assert (rms < 1.3).all() and rms.max() > 0.5, rms
    assert 5.0 < np.mean(squares) < 11.0  # of 9; c13, c23, c33 lie well inside of what the prior says of them


def test_the_contact_frame_is_the_gauge_and_curvature_has_the_covariance_that_is_stated(truth):
    path = truth.path("ellipsoid", T=truth.any_pose(2))
    estimate = fit_surface(*path.noisy(*NOISE.values(), seed=0), **NOISE)
    S, C = estimate.matrix()
    np.testing.assert_array_equal(S, estimate.S)
    assert not C[8].any() and (np.delete(np.diag(C), 8) > 0.0).all()

    def curvature(change):
        """K at the foot of the origin on the surface with another S."""
        moved = np.zeros((4, 4))
        moved[UPPER] = moved.T[UPPER] = S[UPPER] + change
        surface = SurfaceMatrix(moved)
        K, _ = surface.curvature_at(surface.project((0.0, 0.0, 0.0)))
        return K[[0, 0, 1], [0, 1, 1]]

    step = np.diag(1e-4 * np.sqrt(np.diag(C)))
    J = np.array([curvature(h) - curvature(-h) for h in step]).T / np.where(step.any(1), 2e-4, 1.0)
    J[:, 8] = 0.0
    J = J / np.where(np.diag(C) > 0.0, np.sqrt(np.diag(C)), 1.0)
    np.testing.assert_allclose(J @ C @ J.T, estimate.covariance, rtol=1e-4, atol=1e-6)


def test_there_and_back_is_the_identity_and_a_point_of_the_surface_stays_one(truth):
    path = truth.path("hyperboloid", T=truth.any_pose(1))
    estimate = fit_surface(*path.noisy(*NOISE.values(), seed=1), **NOISE)
    at_contact, frame = estimate.matrix(), truth.any_pose(4)
    there = at_contact.transformed(frame)
    back = there.transformed(np.linalg.inv(frame))
    for got, wanted in zip(back, at_contact, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())
    own = estimate.matrix(estimate.T_frame_contact @ frame)
    np.testing.assert_allclose(own.S, there.S, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(own.covariance, there.covariance, rtol=1e-6, atol=1e-9 * np.abs(there.covariance).max())
    place = np.linalg.solve(frame, [0.0, 0.0, 0.0, 1.0])  # the contact
    assert place @ there.S @ place == pytest.approx(0.0, abs=1e-12)
    # the variance of f at the contact is that of c44: the height
    row = np.outer(place, place) * (2.0 - np.eye(4))
    assert row[UPPER] @ there.covariance @ row[UPPER] == pytest.approx(at_contact.covariance[9, 9], rel=1e-4)


@pytest.mark.parametrize("method", ["ml", "chord"])
def test_three_contacts_are_not_a_surface(truth, method):
    path = truth.path("ellipsoid")
    estimate = fit_surface(path.points[-3:], path.normals[-3:], **NOISE, method=method)
    S, C = estimate.matrix()
    hidden = np.isnan(estimate.K[[0, 0, 1], [0, 1, 1]])
    assert hidden.any()
    np.testing.assert_array_equal(np.isnan(S[UPPER][CURVED]), hidden)
    np.testing.assert_array_equal(np.isinf(np.diag(C)[CURVED]), hidden)
    frame = truth.any_pose(0)
    S, C = estimate.matrix(frame)
    found = ~np.isnan(S[UPPER])
    assert found.sum() < 5
    np.testing.assert_array_equal(np.isinf(np.diag(C))[~found], True)
    off = np.abs(S[UPPER] - true_in(frame, path, estimate))
    assert (off[found] < 3.0 * np.sqrt(np.diag(C)[found])).all()


def test_a_straight_path_shows_its_own_curvature_in_axes_along_it_only():
    """At 45° to the axes of the contact frame no entry of K is observed; in a frame along the path two are."""
    rng = np.random.default_rng(0)
    along = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0])
    s = np.linspace(-0.02, 0.0, 160)
    points = np.outer(s, along) + 5e-6 * rng.normal(size=(160, 3))
    points[:, 2] -= 10.0 * s**2
    normals = np.outer(20.0 * s, along) + [0.0, 0.0, 1.0] + 1e-4 * rng.normal(size=(160, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    estimate = fit_surface(points, normals, sigma_point=5e-6, sigma_normal=1e-4)
    assert estimate.rank == 2
    assert np.isnan(estimate.matrix().S[UPPER][CURVED]).all()
    frame = np.eye(4)
    frame[:3, :3] = np.array([along, [along[1], -along[0], 0.0], [0.0, 0.0, -1.0]]).T
    S, C = estimate.matrix(frame)
    assert S[0, 0] == pytest.approx(10.0, abs=4.0 * np.sqrt(C[0, 0])) and np.sqrt(C[0, 0]) < 1.0
    assert np.isnan(S[1, 1]) and np.isinf(C[4, 4]) and np.isfinite(S[0, 1])
    spread = UncertainMatrix(S, C).transformed(frame)
    assert np.isnan(spread.S[UPPER][CURVED]).all() and np.isinf(np.diag(spread.covariance)[CURVED]).all()


def test_an_answer_of_your_own_has_values_and_no_covariance():
    S, C = SurfaceEstimate.of(np.eye(4), [[20.0, 0.0], [0.0, 5.0]]).matrix()
    assert (S[0, 0], S[1, 1], S[2, 3]) == (10.0, 2.5, -0.5)
    assert np.isinf(np.delete(np.diag(C), 8)).all() and C[8, 8] == 0.0
    with pytest.raises(UsageError, match=r"T_base_frame: expected shape \(4, 4\), got \(3, 3\)"):
        SurfaceEstimate.of(np.eye(4), np.eye(2)).matrix(np.eye(3))
