"""The methods that the benchmark compares: a class each, and a line in `METHODS`.

A method makes a surface from the contacts of a shape within a budget: the path that a local estimate remembers, the
radius of a local fit, the number of contacts. All get the same contacts and the same stated noise. A method finds its
settings on the development shapes (`develop`), before it sees a test shape.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from canprobe.cell.tasks.from_plan import make_shape_estimator, make_surface_map
from canprobe.cell.tasks.shape import replay_samples
from canprobe.lab.studies.shapes.contacts_file import ShapeContacts
from canprobe.lab.studies.shapes.implicit import ImplicitSurface, Kernel, fit_quadric, rbf, thin_plate
from canprobe.lab.studies.shapes.patches import SPACING_M, LocalPatch, PatchSurface, patch_of, spaced
from canprobe.mechanics.touch.map.surface_map import REACH_M, SurfaceMap
from canprobe.mechanics.touch.meshing import Feet
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.types import Floats

Settings = Mapping[str, float]


class FittedSurface(Protocol):
    """The surface of a method; NaN farther than `REACH_M` from every contact, where there is no surface."""

    def closest(self, points: Floats) -> Feet:
        """Closest points of the surface to points (n, 3) near it; its σ may be left NaN."""

    def sigma(self, points: Floats) -> Floats:
        """Standard deviation of the surface's height at points (n,), m."""

    def curvature(self, points: Floats) -> Floats:
        """Curvature tensors at points (n, 3, 3), base frame, 1/m."""


class Method(Protocol):
    """A method of the benchmark.

    Attributes:
        name: name in the table.
        budgets: its budgets in `unit`, the least first.
    """

    @property
    def name(self) -> str: ...

    @property
    def budgets(self) -> Sequence[float]: ...

    @property
    def unit(self) -> str: ...

    def develop(self, shapes: Sequence[ShapeContacts]) -> Settings:
        """Settings from the contacts of the development shapes."""

    def fit(self, contacts: ShapeContacts, budget: float, settings: Settings) -> FittedSurface:
        """The surface of a shape."""


@dataclass(frozen=True, slots=True)
class Online:
    """An estimator of the package along the path, as it runs in the loop; its answers every 2 mm make a map."""

    method: str
    patch: bool = False
    budgets: Sequence[float] = (5.0, 10.0, 20.0, 40.0)
    unit: str = "mm of path"

    @property
    def name(self) -> str:
        """Name in the table."""
        return f"{self.method} + patch" if self.patch else self.method

    def develop(self, shapes: Sequence[ShapeContacts]) -> Settings:
        """Set nothing: the packaged estimator is used."""
        return {}

    def fit(self, contacts: ShapeContacts, budget: float, settings: Settings) -> PatchSurface:
        """See `Method`."""
        task = contacts.task
        assert task.shape is not None
        task = replace(task, shape=replace(task.shape, memory=1e-3 * budget, patch=self.patch))
        assert task.scan is not None
        every = max(1, round(SPACING_M / task.scan.speed * task.array.rate_hz))
        records = replay_samples(make_shape_estimator(task, self.method), contacts.samples, every)
        return PatchSurface([patch_of(record.estimate) for record in spaced(records)])


class MapSurface:
    """The surface of a map of all contacts."""

    def __init__(self, surface_map: SurfaceMap) -> None:
        self.map = surface_map

    def closest(self, points: Floats) -> Feet:
        """See `FittedSurface`."""
        return self.map.closest(points)

    def sigma(self, points: Floats) -> Floats:
        """See `FittedSurface`."""
        return self.map.distance(points)[1]

    def curvature(self, points: Floats) -> Floats:
        """See `FittedSurface`."""
        return self.map.curvature(points).tensor


@dataclass(frozen=True, slots=True)
class WholeMap:
    """The map of the package: quartics of all passes with evidence, and the errors that a scan has in common."""

    name: str = "map"
    budgets: Sequence[float] = (100.0,)
    unit: str = "% of contacts"

    def develop(self, shapes: Sequence[ShapeContacts]) -> Settings:
        """Set nothing: its settings were found on the development shapes before."""
        return {}

    def fit(self, contacts: ShapeContacts, budget: float, settings: Settings) -> MapSurface:
        """See `Method`."""
        found = make_surface_map(contacts.task)
        found.add_samples(contacts.samples)
        return MapSurface(found)


@dataclass(frozen=True, slots=True)
class LocalFits:
    """Least-squares quadrics of all contacts within a radius, whenever they were touched, every 2 mm of path."""

    name: str = "quadrics"
    budgets: Sequence[float] = (3.0, 4.0, 6.0, 9.0)
    unit: str = "mm radius"

    def develop(self, shapes: Sequence[ShapeContacts]) -> Settings:
        """Set nothing."""
        return {}

    def fit(self, contacts: ShapeContacts, budget: float, settings: Settings) -> PatchSurface:
        """See `Method`."""
        p, n, _, _ = contacts.touched
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        places = np.unique(np.searchsorted(travelled, np.arange(0.0, travelled[-1], SPACING_M)))
        patches = []
        for i, near in zip(places, cKDTree(p).query_ball_point(p[places], 1e-3 * budget), strict=True):
            j = np.array(near)[n[near] @ n[i] > 0.5]
            found = fit_quadric(p[i], n[i], contacts.touched.some(j))
            if found is not None:
                patches.append(_patch(*found))
        return PatchSurface(patches)


def _patch(T: Floats, K: Floats, covariance: Floats) -> LocalPatch:
    """A patch of a fitted quadric; c13, c23, c33 are 0 and taken as known."""
    of = [2, 0, 1, 6, 7, 8]  # height, slopes and K among the entries of S
    to_S = np.array([1.0, 0.5, 0.5, 0.5, 0.5, 0.5])
    P = np.zeros((9, 9))
    P[np.ix_(of, of)] = covariance * np.outer(to_S, to_S)
    return LocalPatch(T, SurfaceMatrix.from_curvature(K).S, P)


class ProcessSurface:
    """The zero of a Gaussian process within reach of the contacts."""

    def __init__(self, process: ImplicitSurface, contacts: Floats) -> None:
        self._process = process
        self._tree = cKDTree(contacts)

    def closest(self, points: Floats) -> Feet:
        """See `FittedSurface`."""
        f, g = self._process.value(points)
        size = np.linalg.norm(g, axis=1)
        height, normal = f / size, g / size[:, None]
        foot = points - height[:, None] * normal
        near = np.less(self._tree.query(foot)[0], REACH_M)
        nowhere = np.where(near, 0.0, math.nan)
        return Feet(
            foot + nowhere[:, None],
            normal + nowhere[:, None],
            height + nowhere,
            np.full(len(points), math.nan),
            near.astype(int),
        )

    def sigma(self, points: Floats) -> Floats:
        """See `FittedSurface`."""
        sigma: Floats = self._process.sigma(points) / np.linalg.norm(self._process.value(points)[1], axis=1)
        return sigma

    def curvature(self, points: Floats) -> Floats:
        """See `FittedSurface`."""
        return self._process.curvature(points)


@dataclass(frozen=True, slots=True)
class Process:
    """A Gaussian-process implicit surface with normals, of contacts at equal steps along the path.

    Its parameters have the greatest marginal likelihood on the development shapes, together.
    """

    name: str
    kernel: Kernel
    length: float | None
    """Held, m; None: found with the scale."""
    budgets: Sequence[float] = (50, 100, 200, 400)
    unit: str = "contacts"

    def develop(self, shapes: Sequence[ShapeContacts]) -> Settings:
        """Find scale and length."""

        def cost(x: Floats) -> float:
            settings = dict(zip(("scale", "length"), np.exp(x).tolist(), strict=False))
            try:
                return -sum(self._process(shape, 80, settings).log_likelihood for shape in shapes)
            except np.linalg.LinAlgError:
                return math.inf

        start = np.log([3e-3, 30e-3][: 2 if self.length is None else 1])
        found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.5, "maxfev": 80})
        return dict(zip(("scale", "length"), np.exp(found.x).tolist(), strict=False))

    def fit(self, contacts: ShapeContacts, budget: float, settings: Settings) -> ProcessSurface:
        """See `Method`."""
        return ProcessSurface(self._process(contacts, int(budget), settings), contacts.touched.points)

    def _process(self, contacts: ShapeContacts, count: int, settings: Settings) -> ImplicitSurface:
        i = np.unique(np.linspace(0, len(contacts.samples) - 1, count).round().astype(int))
        length = settings["length"] if self.length is None else self.length
        return ImplicitSurface(self.kernel, settings["scale"], length, contacts.touched.some(i))


METHODS: tuple[Method, ...] = (
    WholeMap(),
    Online("chen1996"),
    Online("chord"),
    Online("ml"),
    Online("ml", patch=True),
    Online("recursive"),
    Online("recursive", patch=True),
    LocalFits(),
    Process("process, RBF", rbf, None),
    Process("process, thin plate", thin_plate, 0.1),
)
"""Every method. `chen1996` and `chord` state no information that could be fused with the patch: they stand alone."""
