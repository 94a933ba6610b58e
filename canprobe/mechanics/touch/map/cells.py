"""Solved cells of a map: the fits of all discs, the errors that they have in common, and what of them was observed.

What was observed is decided on the covariance that is stated: where contacts scatter more than their noise explains,
curvature that a fit of their noise would have shown is not observed. Nor is it where a quartic had to be rougher than
its prior allows: such are the sheets of a step that a disc took for one.

Two solutions: the first as if the surface were flat, the second with the curvature that the first has found, with the
stiffness of the pad's layer that follows from it, and with less weight for nodes that do not fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from canprobe.mechanics.touch.contact import HOLLOW_LIMIT_SHARE, Slope
from canprobe.mechanics.touch.estimate.observed import MIN_SPREAD
from canprobe.mechanics.touch.image.image_model import ImageModel
from canprobe.mechanics.touch.layer_stiffness import stiffness_from_slope
from canprobe.mechanics.touch.map import nodes as column
from canprobe.mechanics.touch.map.discs import Discs
from canprobe.mechanics.touch.map.local_fits import CommonErrors, PadLayer, Quartics, fit_discs, stiffness_error
from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.touch.map.quartic import LENGTH_M, SECOND
from canprobe.mechanics.touch.map.stiffness import MAX_IMAGES, Stiffness, fused_stiffness, log_of_images
from canprobe.mechanics.types import Floats

ROBUST_CHI2 = 6.0
"""χ² of the rows of a node beyond which it counts less."""
EXCESS_REACH_M = 4e-3
"""Distance within which the largest excess of χ² counts, m: about the size of the contact patch."""
MAX_HEIGHT_SIGMA_M, MAX_SLOPE_SIGMA, MAX_CURVATURE_SIGMA = 1e-3, 0.1, 15.0
"""Standard deviations of height (m), slope and a combination of curvature (1/m) above which it was not observed; the
last is compared with 0.3 times the curvature, too."""
MAX_RELATIVE_SIGMA = 0.3
MAX_ROUGHNESS = 2.0
"""Roughness of a quartic above which it says nothing of the curvature: sheets that mix, or a surface that is not smooth
over a disc. Over fillets and edges of 10° of the development shapes it is at most 1.6."""
STATED_STIFFNESS_SIGMA = 0.2
"""Standard deviation of ln k where neither a slope nor an image shows it."""


@dataclass(slots=True)
class LayerEvidence:
    """What is known of the stiffness of the pad's layer.

    Attributes:
        model: calibrated model of the probe's array, for its images; None: without.
        touch: slope of the first touch, and its place (3,), m; None: not measured.
        found: stiffness that was found before, as a map that is read has it; None: it is to be found.
    """

    model: ImageModel | None = None
    touch: tuple[Slope, Floats] | None = None
    found: Stiffness | None = None

    def stiffness(self, rows: Floats, points: Floats, pad: PadLayer, discs: Discs, K: Floats) -> Stiffness:
        """The stiffness by touch and images at the curvature K (m, 2, 2) of the discs; that of `pad` without both."""
        if self.found is not None:
            return self.found
        tree, kappa = cKDTree(discs.origin), np.linalg.eigvalsh(K)
        kappa = np.maximum(kappa, -HOLLOW_LIMIT_SHARE / pad.radius)
        slope = images = None
        if self.touch is not None:
            of_touch, place = self.touch
            slope = math.log(stiffness_from_slope(of_touch.value, pad.radius, kappa[tree.query(place)[1]]))
        shown = np.flatnonzero(np.isfinite(rows[:, column.PATCH]))
        if self.model is not None and len(shown):
            shown = shown[np.linspace(0, len(shown) - 1, min(len(shown), MAX_IMAGES)).round().astype(int)]
            force = rows[shown, column.ROOT_FORCE] ** 2
            cell = tree.query(points[shown])[1]
            images = log_of_images(self.model, rows[shown, column.PATCH], force, kappa[cell])
        return fused_stiffness(slope, images, Stiffness(pad.stiffness, STATED_STIFFNESS_SIGMA))


class Cells(NamedTuple):
    """Solved cells of a map.

    Attributes:
        discs: places of the cells, and the nodes round each.
        fits: quartic of each.
        covariance: (m, 15, 15) stated covariance of the quartics, with the largest excess of χ² within the size of a
            patch.
        height2: (m,) variance of the height beside that of the quartic, m²: the scatter of contacts that noise does not
            explain, and the error of the layer's stiffness.
        known: (m, 3) whether height, slopes and all of the curvature were observed.
        rank: (m,) number of combinations of curvature that were observed.
        tree, contacts: search trees of the places of the cells, and of the points of the nodes.
        common: errors that the whole scan has in common.
        stiffness: stiffness of the pad's layer; None without a pad.
    """

    discs: Discs
    fits: Quartics
    covariance: Floats
    height2: Floats
    known: NDArray[np.bool_]
    rank: NDArray[np.intp]
    tree: cKDTree
    contacts: cKDTree
    common: CommonErrors
    stiffness: Stiffness | None


def solve_cells(rows: Floats, points: Floats, pad: PadLayer | None, noise: MapNoise, evidence: LayerEvidence) -> Cells:
    """Solve the cells of a map.

    Args:
        rows: (n, COLUMNS) nodes.
        points: (n, 3) their contact points, m.
        pad: probe with the stated stiffness of its layer; None where the nodes are points.
        noise: noise of the contacts.
        evidence: evidence of the layer's stiffness.
    """
    discs = Discs.of(points, rows)
    weight, m = discs.weight, len(discs.origin)
    fits, _, chi2 = fit_discs(rows, discs, pad, noise, K_ref=np.zeros((m, 2, 2)), weight=weight)
    stiffness = None
    if pad is not None:
        stiffness = evidence.stiffness(rows, points, pad, discs, fits.K)
        pad = pad._replace(stiffness=stiffness.value)
    weight = robust(weight, chi2)
    fits, common, _ = fit_discs(rows, discs, pad, noise, K_ref=fits.K, weight=weight)
    tree = cKDTree(discs.origin)
    excess = np.array([fits.excess[near].max() for near in tree.query_ball_point(discs.origin, EXCESS_REACH_M)])
    covariance, height2 = fits.covariance(excess), noise.scatter2(excess)
    if pad is not None and stiffness is not None:
        height2 += stiffness_error(rows, discs, pad, fits.K, stiffness.sigma) ** 2
    seen = observed_of(fits, covariance)
    return Cells(discs, fits, covariance, height2, *seen, tree, cKDTree(points), common, stiffness)


def robust(weight: Floats, chi2: Floats) -> Floats:
    """Weights (m, n) of nodes, less where their χ² is large."""
    return weight * np.minimum(1.0, ROBUST_CHI2 / np.maximum(chi2, 1e-300))


def observed_of(fits: Quartics, V: Floats) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Whether height, slopes and all of K were observed (m, 3), and the rank of K (m,), at a stated covariance V."""
    height = V[:, 0, 0] * LENGTH_M**2 < MAX_HEIGHT_SIGMA_M**2
    slopes = np.maximum(V[:, 1, 1], V[:, 2, 2]) < MAX_SLOPE_SIGMA**2
    to_q = np.array([1.0, math.sqrt(2.0), 1.0])
    of_K = V[:, SECOND, SECOND] * np.outer(to_q, to_q) / LENGTH_M**2
    limit = np.maximum(MAX_CURVATURE_SIGMA, MAX_RELATIVE_SIGMA * np.linalg.norm(fits.K, axis=(1, 2)))
    certain = (np.linalg.eigvalsh(of_K) < limit[:, None] ** 2).sum(axis=1)
    low, high = np.linalg.eigvalsh(fits.spread).T
    spread = (np.stack([low, 0.5 * (low + high), high]) >= MIN_SPREAD).sum(axis=0)
    rank = np.where(fits.roughness < MAX_ROUGHNESS, np.minimum(certain, spread), 0)
    return np.stack([height, slopes, rank == 3], axis=1), rank
