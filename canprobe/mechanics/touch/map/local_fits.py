"""Quartics of the nodes round many places at once, with evidence, and the errors that all of them have in common.

Rows of a node at (x, y, z) over the plane, p = c − (R_p − d) n, d = √(2 F √det A / (π k)), A = ½ (I/R_p + K_ref):

    height   z − (d/4) tr(M K_ref) = [φ + Lφ]·a,   L = (d/4) tr(M ∇²),   M = (I/R_p + K_ref)⁻¹
    slopes   −n_xy/n_z = ∇φ·a + D θ,   δn = (1/R_p + H) [v, R_p (n + z_p), −x_p, −y_p] θ

since δ ln d = ¼ tr(M δK) and K = −∇²h: a depth that began with another curvature is right in the end. θ are the lag
along the heading v, the pad's relative scale, and the offsets of the centroid. Each disc gives information about them,
I_θ += s (Λ_θθ − Λ_θa S⁻¹ Λ_aθ), S with the prior, s the share of its nodes that no other disc counts.

A pad shows what lies under its patch: where the curvature changes within it, the centroid of its pressure moves, and
the slopes that it shows are those of h + 2/3 Lh (bare layer). Why is that not in the rows: it makes fine forms better,
and jumps of the curvature, where no quartic is right, overshoot by more. It is stated as an error of slopes and
curvature instead, of the size that the fitted quartic itself gives it.

For each deviation g of third derivatives the evidence is −½ ln|S_g| + ½ ln|P_g| + ½ ηᵀ S_g⁻¹ η, P the prior's
information and η the pull of the data beyond the prior's mean. The answer is the mixture: a smooth surface is taken as
smooth, and one that changes within millimetres is not.

Source: Rasmussen and Williams, "Gaussian processes for machine learning", 2006, 2.7 and 5.4; Johnson, "Contact
mechanics", 1985, 4.3 (layer).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.contact import HOLLOW_LIMIT_SHARE
from canprobe.mechanics.touch.map import nodes as column
from canprobe.mechanics.touch.map.discs import MIN_FACING, Discs
from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.touch.map.quartic import (
    LENGTH_M,
    LOG_HYPERPRIOR,
    PRIOR_INFORMATION,
    SECOND,
    SECOND_DERIVATIVES,
    TERMS,
    THIRD,
    fourth_of,
    terms,
)
from canprobe.mechanics.types import Floats

CHANCE_SIGMAS = 2.0
"""Standard deviations of χ² per degree of freedom by which it must be above 1 to be more than chance."""
PATCH_SHARE = 2.0 / 3.0
"""Share of Lh in the slopes that a bare layer shows."""
COMMON = 4
"""Number of common errors."""
ROWS_AT_ONCE = 60_000
"""Nodes of discs that are solved at once: some 100 MB."""


class PadLayer(NamedTuple):
    """A spherical probe with an elastic layer: radius R_p, m, and stiffness K/h, N/m³."""

    radius: float
    stiffness: float


class CommonErrors(NamedTuple):
    """Errors that a scan has in common: mean (4,) and covariance (4, 4) of lag, scale and offsets (`MapNoise`)."""

    mean: Floats
    covariance: Floats

    @classmethod
    def of(cls, parts: Sequence[tuple[Floats, Floats]], sigma: Floats) -> CommonErrors:
        """The errors by information (4, 4) and pull (4,) of parts of a map, with prior standard deviations (4,)."""
        if not parts:
            return cls(np.zeros(COMMON), np.zeros((COMMON, COMMON)))
        information, pull = (sum(each) for each in zip(*parts, strict=True))
        covariance = np.linalg.inv(information + np.diag(sigma**-2.0))
        return cls(covariance @ pull, covariance)


class Quartics(NamedTuple):
    """Fitted quartics, dimensionless (`quartic.LENGTH_M`).

    Attributes:
        a: (m, 15) derivatives of the height.
        V: (m, 15, 15) their covariance by the noise, that of the common errors included.
        excess: (m,) χ² per degree of freedom above 1; 0 where the noise explains the contacts.
        spread: (m, 2, 2) covariance of the nodes in the plane over the variance of their places.
        patch_error: (m, 15) usual error of slopes and higher derivatives where the curvature changes under the patch.
        roughness: (m,) largest third or fourth derivative over the deviation that the roughest prior gives it.
    """

    a: Floats
    V: Floats
    excess: Floats
    spread: Floats
    patch_error: Floats
    roughness: Floats

    @property
    def K(self) -> Floats:
        """(m, 2, 2) curvature at the origins along x and y, where the planes are tangent, 1/m."""
        xx, xy, yy = -self.a[:, SECOND].T / LENGTH_M
        return np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)

    def covariance(self, excess: Floats) -> Floats:
        """(m, 15, 15) stated covariance of `a`, at an excess of χ² (m,): noise, and the error of the patch."""
        result: Floats = self.V * (1.0 + excess)[:, None, None]
        return result + self.patch_error[:, :, None] * self.patch_error[:, None]


def stiffness_error(rows: Floats, discs: Discs, pad: PadLayer, K: Floats, sigma: float) -> Floats:
    """Error of heights by the layer's stiffness, whose depth is that at the mean √force of the nodes.

    Args:
        rows: (k, COLUMNS) nodes.
        discs: places and their nodes.
        pad: the probe.
        K: (m, 2, 2) curvature of the discs, 1/m.
        sigma: standard deviation of the logarithm of the stiffness.

    Returns:
        (m,) standard deviations, m.
    """
    root_force = (discs.weight * rows[discs.nodes, column.ROOT_FORCE]).sum(axis=1) / discs.weight.sum(axis=1)
    det = np.maximum(np.linalg.det(np.eye(2) / pad.radius + K), 0.0)
    depth: Floats = root_force * np.sqrt(np.sqrt(det) / (math.pi * pad.stiffness))
    return 0.5 * sigma * depth


def fit_discs(
    rows: Floats, discs: Discs, pad: PadLayer | None, noise: MapNoise, *, K_ref: Floats, weight: Floats
) -> tuple[Quartics, CommonErrors, Floats]:
    """Fit every disc, and the common errors to all of them.

    Args:
        rows: (k, COLUMNS) nodes.
        discs: places and their nodes.
        pad: the probe; None where centres are contact points.
        noise: noise of the contacts.
        K_ref: (m, 2, 2) curvature near the right one, 1/m.
        weight: (m, n) weights of the nodes of a disc.

    Returns:
        The fits, the common errors, and (m, n) χ² of the rows of each node.
    """
    if pad is not None:
        K_ref = _followed(K_ref, pad.radius)
    m, n = weight.shape
    step = max(1, ROWS_AT_ONCE // n)
    parts = [slice(i, i + step) for i in range(0, m, step)]

    @lru_cache(maxsize=1)  # a single part is computed once; of many parts only one is in memory
    def part(number: int) -> tuple[_Rows, _Posterior]:
        here = parts[number]
        of_part = _rows(rows, discs.part(here), pad, noise, K_ref[here])
        root = np.sqrt(np.repeat(weight[here], 3, axis=1))
        A = of_part.A * root[..., None]
        weighted = A.transpose(0, 2, 1)
        G, b = weighted @ A, np.einsum("mik,mk->mi", weighted, of_part.y * root)
        return of_part, _Posterior.of(G, b, fourth_of(K_ref[here] * LENGTH_M))

    sigma = np.array(noise.common)
    known = [part(k)[1].about_common(discs.share[here]) for k, here in enumerate(parts)] if sigma.any() else []
    common = CommonErrors.of(known, sigma)
    answers = [_answer(*part(k), weight[here], common, noise.used) for k, here in enumerate(parts)]
    *columns, chi2 = (np.concatenate(values) for values in zip(*answers, strict=True))
    return Quartics(*columns), common, chi2


def _answer(rows: _Rows, posterior: _Posterior, weight: Floats, common: CommonErrors, used: int) -> tuple[Floats, ...]:
    """The columns of `Quartics`, and χ² of each node, of some discs."""
    a, V, held = posterior.mixture(common)
    residual = rows.y - np.einsum("mki,mi->mk", rows.A[..., :TERMS], a) - rows.A[..., TERMS:] @ common.mean
    chi2 = (residual**2).reshape(len(a), -1, 3).sum(axis=2)
    total = weight.sum(axis=1)
    dof = np.maximum(used * total - held, 1.0)
    expected = dof * (weight * rows.usual).sum(axis=1) / np.maximum(used * total, 1e-300)
    excess = (weight * chi2).sum(axis=1) / np.maximum(expected, 1e-300) - 1.0
    excess = np.where(excess > CHANCE_SIGMAS * np.sqrt(2.0 / dof), excess, 0.0)
    share = weight / np.maximum(total, 1e-300)[:, None]
    off = rows.places - np.einsum("mn,mni->mi", share, rows.places)[:, None]
    variance = np.maximum(np.einsum("mn,mn->m", share, rows.variance), 1e-300)
    spread = np.einsum("mn,mni,mnj->mij", share, off, off) / variance[:, None, None]
    patch_error = PATCH_SHARE * np.einsum("mpq,mq->mp", rows.layer, a)
    patch_error[:, 0] = 0.0  # the height is measured beside the slopes
    roughness = np.abs(a * np.sqrt(PRIOR_INFORMATION[-1]))[:, THIRD.start :].max(axis=1)
    return a, V, excess, spread, patch_error, roughness, chi2


def _followed(K: Floats, radius: float) -> Floats:
    """Curvatures (n, 2, 2) no hollower than a pad of a radius can follow."""
    values, axes = np.linalg.eigh(K)
    values = np.maximum(values, -HOLLOW_LIMIT_SHARE / radius)
    result: Floats = np.einsum("nij,nj,nkj->nik", axes, values, axes)
    return result


class _Rows(NamedTuple):
    """Whitened rows A (m, 3n, 15 + 4) of (a, θ) and y (m, 3n); places (m, n, 2), m, and their variances (m, n), m².

    `layer` (m, 15, 15) takes `a` to the derivatives of Lh at the mean depth. `usual` (m, n) is the χ² that is usual for
    a node: below one a row where nodes are shorter than the path of an independent sample, as the noise within a node
    is then that of its neighbours.
    """

    A: Floats
    y: Floats
    places: Floats
    variance: Floats
    layer: Floats
    usual: Floats


def _rows(rows: Floats, discs: Discs, pad: PadLayer | None, noise: MapNoise, K_ref: Floats) -> _Rows:
    """The rows of the nodes (k, COLUMNS) in some discs."""
    node = rows[discs.nodes]
    m, n = node.shape[:2]
    normal = node[..., column.NORMAL] @ discs.R
    at = (node[..., column.CENTRE] - discs.origin[:, None]) @ discs.R
    tilt = 0.5 * np.trace(K_ref, axis1=1, axis2=2)[:, None]  # normal per lateral error
    quarter: Floats = np.zeros((m, n))
    M: Floats = np.zeros_like(K_ref)
    if pad is not None:
        relative = np.eye(2) / pad.radius + K_ref
        root_det = 0.5 * np.sqrt(np.linalg.det(relative))[:, None]
        depth = node[..., column.ROOT_FORCE] * np.sqrt(2.0 * root_det / (math.pi * pad.stiffness))
        at = at - (pad.radius - depth)[..., None] * normal
        quarter, tilt = 0.25 * depth / LENGTH_M, tilt + 1.0 / pad.radius
        M = np.asarray(np.linalg.inv(relative) / LENGTH_M, np.float64)
    x, y, z = np.moveaxis(at, -1, 0) / LENGTH_M
    f, fx, fy = terms(x, y, (0, 0), (1, 0), (0, 1))
    A, values = np.zeros((m, n, 3, TERMS + COMMON)), np.empty((m, n, 3))
    second = np.einsum("mij,ijpq->mpq", M, SECOND_DERIVATIVES)
    A[..., 0, :TERMS] = f + quarter[..., None] * (f @ second)
    A[..., 1, :TERMS], A[..., 2, :TERMS] = fx, fy
    values[..., 0] = z - quarter * np.einsum("mij,mij->m", M, K_ref * LENGTH_M)[:, None]
    values[..., 1:] = -normal[..., :2] / np.maximum(normal[..., 2:], MIN_FACING)
    if pad is not None:
        on_pad = pad.radius * (node[..., column.NORMAL] + node[..., column.Z_PAD])
        for k, way in enumerate(
            (node[..., column.HEADING], on_pad, -node[..., column.X_PAD], -node[..., column.Y_PAD])
        ):
            A[..., 1:, TERMS + k] = -tilt[..., None] * (way @ discs.R)[..., :2]
    heights, normals = noise.independent(node[..., column.COUNT], node[..., column.PATH], column.NODE_M)
    lateral2 = node[..., column.LATERAL2]
    scale = np.empty((m, n, 3))
    scale[..., 0] = np.sqrt(heights / node[..., column.HEIGHT2]) * LENGTH_M
    scale[..., 1:] = np.sqrt(normals / (lateral2 * tilt**2 + node[..., column.NORMAL2]))[..., None]
    usual = math.isfinite(noise.height) * np.minimum(heights, 1.0)
    usual = usual + 2.0 * math.isfinite(noise.normal) * np.minimum(normals, 1.0)
    A *= scale[..., None]
    total = np.maximum(discs.weight.sum(axis=1), 1e-300)
    layer = ((discs.weight * quarter).sum(axis=1) / total)[:, None, None] * second
    y = (values * scale).reshape(m, -1)
    return _Rows(A.reshape(m, -1, TERMS + COMMON), y, at[..., :2], lateral2, layer, usual)


class _Posterior(NamedTuple):
    """Solutions of all discs for every deviation g.

    `inverse` (m, g, 15, 15) is S⁻¹, `log_det` (m, g) ln|S|, `pull` (m, 15) η, `mean` (m, 15) the prior's, and G, b the
    normal equations of (a, θ).
    """

    inverse: Floats
    log_det: Floats
    pull: Floats
    mean: Floats
    G: Floats
    b: Floats

    @classmethod
    def of(cls, G: Floats, b: Floats, mean: Floats) -> _Posterior:
        data = G[:, :TERMS, :TERMS]
        S = data[:, None] + PRIOR_INFORMATION[:, :, None] * np.eye(TERMS)
        root = np.linalg.cholesky(S)
        log_det: Floats = 2.0 * np.log(np.einsum("mgii->mgi", root)).sum(axis=2)
        pull = b[:, :TERMS] - np.einsum("mij,mj->mi", data, mean)
        return cls(np.asarray(np.linalg.inv(S), np.float64), log_det, pull, mean, G, b)

    def shares(self, pull: Floats) -> Floats:
        """(m, g) shares of the deviations in the mixture, by their evidence."""
        fit = np.einsum("mgi,mi->mg", np.einsum("mgij,mj->mgi", self.inverse, pull), pull)
        log = 0.5 * (fit - self.log_det + np.log(PRIOR_INFORMATION).sum(axis=1)) + LOG_HYPERPRIOR
        share = np.exp(log - log.max(axis=1, keepdims=True))
        result: Floats = share / share.sum(axis=1, keepdims=True)
        return result

    def about_common(self, share: Floats) -> tuple[Floats, Floats]:
        """Information (4, 4) and pull (4,) about the common errors, of discs that count by a share (m,) each."""
        best = self.inverse[np.arange(len(share)), self.shares(self.pull).argmax(axis=1)]
        crossed = self.G[:, TERMS:, :TERMS]
        turn = crossed @ best
        information = np.einsum("m,mij->ij", share, self.G[:, TERMS:, TERMS:] - turn @ crossed.transpose(0, 2, 1))
        free = self.b[:, TERMS:] - np.einsum("mij,mj->mi", crossed, self.mean)
        pull: Floats = share @ (free - np.einsum("mij,mj->mi", turn, self.pull))
        return information, pull

    def mixture(self, common: CommonErrors) -> tuple[Floats, Floats, Floats]:
        """Mean (m, 15), covariance (m, 15, 15), and (m,) the number of terms that the data determine."""
        crossed = self.G[:, :TERMS, TERMS:]
        pull = self.pull - crossed @ common.mean
        share = self.shares(pull)
        each = np.einsum("mgij,mj->mgi", self.inverse, pull) + self.mean[:, None]
        turn = self.inverse @ crossed[:, None]
        V = self.inverse + turn @ common.covariance @ turn.transpose(0, 1, 3, 2)
        a = np.einsum("mg,mgi->mi", share, each)
        off = each - a[:, None]
        V = np.einsum("mg,mgij->mij", share, V) + np.einsum("mg,mgi,mgj->mij", share, off, off)
        held = TERMS - np.einsum("mg,mgii,gi->m", share, self.inverse, PRIOR_INFORMATION)
        return a, V, held
