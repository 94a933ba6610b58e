"""Surfaces from contacts, as study `surfaces` compares them: the package's map, and three that libraries give.

The three are heights over the mean plane of the contacts: local quadrics by least squares (numpy), a thin-plate spline
with smoothing (scipy's `RBFInterpolator`), and a Gaussian process whose scale and length have the greatest marginal
likelihood. Each answers for places close to the surface, and ends `REACH_M` from the contacts, as the map does.

Source: Rasmussen and Williams, "Gaussian processes for machine learning", 2006, 2.2 and 5.4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import SIGMA_NORMAL_RAD, centroid_coupling, make_surface_map
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.map.surface_map import REACH_M, SurfaceMap
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

STEP_MM = 0.2
"""Step of the differences that give slopes and curvature of a spline or a process."""
ENOUGH_CONTACTS = 12
"""Least number of contacts for a local quadric."""


class FoundSurface(NamedTuple):
    """A surface as seen from n places near it; NaN where it does not reach.

    Attributes:
        height: (n,) signed distances of the places from it, m.
        normal: (n, 3) outward unit normals there.
        tensor: (n, 3, 3) curvature tensors there, 1/m.
        sigma: (n,) standard deviations of its height, m; NaN where the method states none.
    """

    height: Floats
    normal: Floats
    tensor: Floats
    sigma: Floats


class HeightAnswer(NamedTuple):
    """Heights over a plane at n places: z (n,) mm, slopes (n, 2), Hessians (n, 2, 2) 1/mm, σ (n,) mm."""

    z: Floats
    slope: Floats
    hessian: Floats
    sigma: Floats


class PlaneContacts(NamedTuple):
    """Contacts over their mean plane, in mm: places (n, 2), heights, slopes (n, 2), and σ of heights and slopes."""

    xy: Floats
    z: Floats
    slope: Floats
    sigma_z: Floats
    sigma_slope: Floats


Fit = Callable[[PlaneContacts, float, Floats], HeightAnswer]
"""Contacts, a setting of the method, and places (n, 2), mm, to heights there."""
Method = Callable[[Sequence[ContactSample], Touch, float, Floats], FoundSurface]
"""Contacts, their task, a setting of the method, and points (n, 3), m, near the surface to the surface there."""


def map_of_share(samples: Sequence[ContactSample], task: Touch, percent: float, points: Floats) -> FoundSurface:
    """The package's map of the first contacts, as many as a share of all, at points (n, 3), m, near it."""
    found = make_surface_map(task)
    found.add_samples(samples[: round(0.01 * percent * len(samples))])
    return evaluate_map(found, points)


def evaluate_map(found: SurfaceMap, points: Floats) -> FoundSurface:
    """A map at points (n, 3), m, near it; where tool and arm are is no question of the study."""
    feet = found.closest(points)
    return FoundSurface(feet.height, feet.normal, found.curvature(points).tensor, feet.sigma_relative)


def evaluate_heights(
    fit: Fit, samples: Sequence[ContactSample], task: Touch, setting: float, points: Floats
) -> FoundSurface:
    """Heights over the mean plane of contacts, as a surface at points (n, 3), m, near it."""
    p, n = (np.array([getattr(sample, name) for sample in samples]) for name in ("p_base", "n_base"))
    middle, R = p.mean(axis=0), tangent_rotation(n.mean(axis=0) / np.linalg.norm(n.mean(axis=0)))
    local, up = 1e3 * (p - middle) @ R, n @ R
    along = np.array([math.hypot(s.sigma_point or 0.0, s.sigma_motion) for s in samples])
    height = np.array([a if s.sigma_height is None else s.sigma_height for a, s in zip(along, samples, strict=True)])
    turned = np.hypot(SIGMA_NORMAL_RAD, along * centroid_coupling(task.probe))
    at = 1e3 * (points - middle) @ R
    contacts = PlaneContacts(local[:, :2], local[:, 2], -up[:, :2] / up[:, 2:], 1e3 * height, turned)
    answer = fit(contacts, setting, at[:, :2])
    size = np.sqrt(1.0 + np.sum(answer.slope**2, axis=1))
    normal = np.column_stack([-answer.slope, np.ones(len(at))]) / size[:, None]
    P = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    bent = np.zeros((len(at), 3, 3))
    bent[:, :2, :2] = -1e3 * answer.hessian / size[:, None, None]  # an outward normal: a hill's curvature is positive
    tensor = R @ P @ bent @ P @ R.T
    near = np.less(cKDTree(p).query(points)[0], REACH_M)
    nowhere = np.where(near, 0.0, math.nan)
    return FoundSurface(
        1e-3 * (at[:, 2] - answer.z) / size + nowhere,
        normal @ R.T + nowhere[:, None],
        tensor + nowhere[:, None, None],
        1e-3 * answer.sigma / size + nowhere,
    )


def quadrics(contacts: PlaneContacts, radius: float, xy: Floats) -> HeightAnswer:
    """Least-squares quadrics of heights and slopes of all contacts within a radius of each place, mm."""
    tree = cKDTree(contacts.xy)
    found = np.full((len(xy), 7), math.nan)
    for i, place in enumerate(xy):
        near = np.array(tree.query_ball_point(place, radius), np.intp)
        if len(near) < ENOUGH_CONTACTS:
            continue
        x, y = (contacts.xy[near] - place).T
        one, zero = np.ones_like(x), np.zeros_like(x)
        rows = np.concatenate([
            np.stack([one, x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1),
            np.stack([zero, one, zero, x, y, zero], axis=1),
            np.stack([zero, zero, one, zero, x, y], axis=1),
        ])  # fmt: skip
        values = np.concatenate([contacts.z[near], *contacts.slope[near].T])
        weights = 1.0 / np.concatenate([contacts.sigma_z[near], *2 * [contacts.sigma_slope[near]]])
        c, _, rank, _ = np.linalg.lstsq(rows * weights[:, None], values * weights, rcond=1e-9)
        if rank == 6:
            information = (rows * weights[:, None]).T @ (rows * weights[:, None])
            found[i] = *c, math.sqrt(np.linalg.inv(information)[0, 0])
    return HeightAnswer(found[:, 0], found[:, 1:3], found[:, [3, 4, 4, 5]].reshape(-1, 2, 2), found[:, 6])


def spline(contacts: PlaneContacts, smoothing: float, xy: Floats) -> HeightAnswer:
    """A thin-plate spline of the heights; its smoothing is in mm²."""
    found = RBFInterpolator(contacts.xy, contacts.z, kernel="thin_plate_spline", smoothing=smoothing)
    return _by_differences(found, xy, np.full(len(xy), math.nan))


def process(contacts: PlaneContacts, number: float, xy: Floats) -> HeightAnswer:
    """A Gaussian process of the heights of some contacts at equal steps, with a squared exponential of the distance."""
    i = np.unique(np.linspace(0, len(contacts.z) - 1, int(number)).round().astype(int))
    known, z, noise = contacts.xy[i], contacts.z[i], np.diag(contacts.sigma_z[i] ** 2)
    squares = cdist(known, known, "sqeuclidean")

    def covariance(squares: Floats, x: Floats) -> Floats:
        scale, length = np.exp(x)
        return np.asarray(scale**2 * np.exp(-0.5 * squares / length**2), np.float64)

    def cost(x: Floats) -> float:
        try:
            root = cho_factor(covariance(squares, x) + noise, lower=True)
        except np.linalg.LinAlgError:
            return math.inf
        return float(0.5 * z @ cho_solve(root, z) + np.log(np.diag(root[0])).sum())

    x = minimize(cost, np.log([3.0, 30.0]), method="Nelder-Mead", options={"maxfev": 60}).x
    root = cho_factor(covariance(squares, x) + noise, lower=True)
    weights, c = cho_solve(root, z), covariance(cdist(xy, known, "sqeuclidean"), x)
    variance = np.exp(x[0]) ** 2 - np.einsum("ij,ji->i", c, cho_solve(root, c.T))
    return _by_differences(
        lambda at: covariance(cdist(at, known, "sqeuclidean"), x) @ weights, xy, np.sqrt(np.maximum(variance, 0.0))
    )


def _by_differences(f: Callable[[Floats], Floats], xy: Floats, sigma: Floats) -> HeightAnswer:
    """Heights with slopes and Hessians by central differences."""
    e, g = STEP_MM * np.eye(2)
    z, east, west, north, south = f(xy), f(xy + e), f(xy - e), f(xy + g), f(xy - g)
    slope = np.stack([east - west, north - south], axis=1) / (2.0 * STEP_MM)
    xx, yy = east - 2.0 * z + west, north - 2.0 * z + south
    xy_ = 0.25 * (f(xy + e + g) - f(xy + e - g) - f(xy - e + g) + f(xy - e - g))
    return HeightAnswer(z, slope, np.stack([xx, xy_, xy_, yy], axis=1).reshape(-1, 2, 2) / STEP_MM**2, sigma)


METHODS: Mapping[str, tuple[Method, tuple[float, ...], str]] = {
    "map": (map_of_share, (100.0,), "% of contacts"),
    "quadrics": (partial(evaluate_heights, quadrics), (3.0, 4.0, 6.0, 9.0), "mm radius"),
    "spline": (partial(evaluate_heights, spline), (10.0, 100.0, 1000.0), "mm² smoothing"),
    "process": (partial(evaluate_heights, process), (100, 200, 400), "contacts"),
}
"""Method → how it finds a surface, its settings, and their unit. A new method is a function and a line here."""
