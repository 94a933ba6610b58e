"""The stated noise of points and normals: standard deviations or covariances, coupling, correlation along the path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import MAX_LENGTH, MAX_MAGNITUDE, checked, positive, real_numbers
from canprobe.mechanics.touch.linear_algebra import inverted_upper, lower_root
from canprobe.mechanics.types import Floats

CHI2_MEDIAN, CHI2_95, CHI2_99, CHI2_999 = 2.366, 7.815, 11.34, 16.27
"""Median, 95 %, 99 % and 99.9 % points of χ² with three degrees of freedom, which a sample has."""


@dataclass(frozen=True, slots=True)
class Correlation:
    """Noise that is correlated from sample to sample: hysteresis, aliasing of a moving centroid, an arm that bends.

    Between samples a path of s apart the noise of points and normals, whitened to unit variance, has the correlation
    `share · exp(−s / length)`; the rest of the variance, 1 − share, is independent (a first-order autoregression over
    the path plus white noise). A contact that comes back to the same place has an independent error there.

    The centroids of an array err beside this by a part that changes only as the contact moves over the pad
    (`ContactSample.sigma_slow`): hysteresis, gains of taxels. It is correlated by `exp(−w / pad_length)`, w the way of
    the contact over the pad between two samples. Where the pad rests it is one error for all samples, which bends no
    surface. `share` is then that of the variance which these slow errors leave.

    Attributes:
        length: correlation length, m (the unit of the points).
        share: share of the variance that is correlated, 0 to 1.
        point_share: the same share of the points along the normal, where it differs from that of the normals.
        pad_length: correlation length of the slow errors along the way over the pad, m; infinite: they are one error.
    """

    length: float
    share: float = 1.0
    point_share: float | None = None
    pad_length: float = math.inf

    def __post_init__(self) -> None:
        positive("correlation.length", self.length)
        if not self.pad_length > 0.0:
            raise UsageError(f"correlation.pad_length: expected a number above 0, got {self.pad_length}")
        others = {} if self.point_share is None else {"point_share": self.point_share}
        for name, value in {"share": self.share, **others}.items():
            share = float(checked(f"correlation.{name}", value, ()))
            if not 0.0 <= share <= 1.0:
                raise UsageError(f"correlation.{name}: expected a number from 0 to 1, got {share}")

    @property
    def shares(self) -> Floats:
        """(3,) correlated shares of a sample's three rows: height, and the two parts of the normal."""
        return np.array([self.share if self.point_share is None else self.point_share, self.share, self.share])

    def height_inflation(self, spacing: float) -> float:
        """Variance of a mean of many heights this far apart along the path, m, over that of independent ones."""
        # Σ exp(−k s / length) over k ≥ 1, of a spacing s far below the length
        return 1.0 + 2.0 * float(self.shares[0]) * self.length / spacing

    def matrix(self, path: Floats, slow: SlowErrors | None = None) -> Floats:
        """Correlations (3, n, n) of the rows of samples at places (n,) along the path, m, with their slow errors."""
        R: Floats = self.shares[:, None, None] * np.exp(-np.abs(path[:, None] - path) / self.length)
        if slow is not None:
            R[1:] *= np.outer(slow.rest, slow.rest)
            R[1:] += np.outer(slow.share, slow.share) * np.exp(-np.abs(slow.way[:, None] - slow.way) / self.pad_length)
        here = np.arange(len(path))
        R[:, here, here] = 1.0
        return R

    def whitener(self, path: Floats, slow: SlowErrors | None = None) -> Floats:
        """(3, n, n) inverse lower Cholesky factors of `matrix`, which 1e-9 keeps regular for samples at one place."""
        R = self.matrix(path, slow) + 1e-9 * np.eye(len(path))
        # why not np.linalg.inv of all three: with triangular factors, and one for equal shares, 0.3 instead of 4.0 ms
        tilt = inverted_upper(lower_root(R[1]).T).T  # of both tilts
        alike = slow is None and self.point_share is None
        return np.array([tilt if alike else inverted_upper(lower_root(R[0]).T).T, tilt, tilt])


class SlowErrors(NamedTuple):
    """Errors of n contacts along the surface that change only as the contact moves over the pad.

    Attributes:
        share: (n,) their standard deviation over that of the whole error.
        way: (n,) way of the contact over the pad up to each of them, m.
    """

    share: Floats
    way: Floats

    @property
    def rest(self) -> Floats:
        """(n,) standard deviation of all other errors over that of the whole."""
        return np.sqrt(1.0 - self.share**2)


def mixed(matrices: Floats, rows: Floats) -> Floats:
    """Rows (n, 3, k) mixed among the samples by the matrices (3, n, n) of their kinds."""
    return (matrices @ rows.transpose(1, 0, 2)).transpose(1, 0, 2)


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Noise of n samples.

    Attributes:
        point: (n,) standard deviation per axis, m, or (n, 3, 3) covariances, m².
        normal: (n,) standard deviation per tangent axis, rad, or (n, 3, 3) covariances.
        coupling: error of the outward normal, with its sign turned, over the error of the point along the surface, 1/m:
            0 for independent errors, 1/R_p where both come from one centroid on a probe of that radius. An error e of
            the point then turns the normal by `(K + coupling) e` against the surface.
        height: (n,) standard deviation of the point along the normal, m; `point` is then that along the surface, per
            axis. None: the points' noise is the same along all axes, or as its covariances.
    """

    point: Floats
    normal: Floats
    coupling: float = 0.0
    height: Floats | None = None

    @property
    def isotropic(self) -> bool:
        """Whether both are plain standard deviations."""
        return self.point.ndim == 1 and self.normal.ndim == 1

    @property
    def point_variance(self) -> Floats:
        """(n,) variance of the points per axis, the mean one where axes differ, m²."""
        return _mean_variance(self.point)

    @property
    def height_variance(self) -> Floats:
        """(n,) variance of the points along the normal, m²; `point_variance` where no `height` is stated."""
        return self.point_variance if self.height is None else self.height**2

    @property
    def normal_variance(self) -> Floats:
        """(n,) variance of the normals per axis, the mean one where axes differ, rad²."""
        return _mean_variance(self.normal)

    def tangential_and_height(self, normals: Floats) -> tuple[Floats, Floats]:
        """(n,) variances of the points along the surface, per axis, and along the normals (n, 3), m²."""
        if self.point.ndim == 1:
            return self.point_variance, self.height_variance
        height = np.einsum("ni,nij,nj->n", normals, self.point, normals)
        return 0.5 * (np.trace(self.point, axis1=1, axis2=2) - height), height

    def scaled(self, length: float, R: Floats) -> Noise:
        """The same noise in units of a length and in the frame whose axes are the columns of R (3, 3)."""
        point = self.point / length if self.point.ndim == 1 else R.T @ self.point @ R / length**2
        normal = self.normal if self.normal.ndim == 1 else R.T @ self.normal @ R
        return Noise(point, normal, self.coupling * length, None if self.height is None else self.height / length)

    def covariances(self) -> tuple[Floats, Floats]:
        """Covariances (n, 3, 3) of the points, m², and of the normals, rad²."""
        return _as_covariance(self.point), _as_covariance(self.normal)


def make_noise(n: int, sigma_point: ArrayLike, sigma_normal: ArrayLike, coupling: float = 0.0) -> Noise:
    """Checked noise of n samples, each sigma a number, (n,), or covariances (3, 3) or (n, 3, 3).

    Raises:
        UsageError: a sigma has another shape, or is not finite and above 0 (definite); the message names the field.
    """
    alike = float(checked("coupling", coupling, ()))
    return Noise(_one(n, "sigma_point", sigma_point), _one(n, "sigma_normal", sigma_normal), alike)


def _one(n: int, name: str, value: ArrayLike) -> Floats:
    wanted = f"{name}: expected a number above 0, ({n},) of them, or definite covariances (3, 3) or ({n}, 3, 3)"
    try:
        sigma = real_numbers(value)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{wanted}, got {value!r}") from error
    if not np.isfinite(sigma).all():
        raise UsageError(f"{wanted}, got a value that is not finite")
    if sigma.shape in ((), (n,)):
        if not (sigma > 0.0).all():
            raise UsageError(f"{wanted}, got {sigma.min()}")
        _refuse_extremes(name, sigma)
        return np.ascontiguousarray(np.broadcast_to(sigma, (n,)))
    if sigma.shape in ((3, 3), (n, 3, 3)):
        if not np.abs(sigma).max() <= MAX_MAGNITUDE**2:
            raise UsageError(f"{wanted}, got a variance of {np.abs(sigma).max():g}")
        variances = np.linalg.eigvalsh(sigma)
        if not (variances > 0.0).all() or np.abs(sigma - sigma.mT).max() > 1e-9 * np.abs(sigma).max():
            raise UsageError(f"{wanted}, got one that is not symmetric and definite")
        _refuse_extremes(name, np.sqrt(variances))
        return np.ascontiguousarray(np.broadcast_to(sigma, (n, 3, 3)))
    raise UsageError(f"{wanted}, got shape {sigma.shape}")


def _refuse_extremes(name: str, deviations: Floats) -> None:
    """Refuse deviations with which an estimate would be rounding error, or its information would overflow."""
    for one in (float(deviations.min()), float(deviations.max())):
        if not 1.0 / MAX_MAGNITUDE <= one <= MAX_LENGTH:
            limits = f"from {1.0 / MAX_MAGNITUDE:g} to {MAX_LENGTH:g}"
            raise UsageError(f"{name}: expected a standard deviation {limits}, got {one:g}")


def _mean_variance(sigma: Floats) -> Floats:
    return sigma**2 if sigma.ndim == 1 else np.trace(sigma, axis1=1, axis2=2) / 3.0


def _as_covariance(sigma: Floats) -> Floats:
    return sigma if sigma.ndim == 3 else (sigma**2)[:, None, None] * np.eye(3)
