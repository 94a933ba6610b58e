"""The cell at one instant, made from live or recorded samples, and its curves over time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from canprobe.lab.bridge.sample import ContactFrame, Sample, SurfacePatch
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

SILENT_NS = 250_000_000
"""Longest time that a contact is shown after its tactile frame, ns."""


@dataclass(frozen=True, slots=True, eq=False)
class JudgedAnswer:
    """An answer of the estimator, compared with the truth.

    Attributes:
        patch: the answer.
        error: ‖K − K_true‖ (Frobenius, 1/m) at its contact point; NaN without a true object, or where not all curvature
            was observed.
        kappa_true: principal curvatures of the true object there, 1/m, larger first; NaN without a true object.
        sigma: root of the expected squared error of K as the estimator states it, 1/m; infinite where a part of it was
            not observed.
    """

    patch: SurfacePatch
    error: float
    kappa_true: tuple[float, float]
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """The cell at one instant.

    Attributes:
        t_s: time on the clock of the samples, s.
        phase: phase of the task.
        q: joint positions (n,), rad or m; None without an arm.
        contact: place of the contact; None without contact.
        answer: newest answer of the estimator; None before the first.
        taxels: counts (rows, columns) of the newest frame; None before the first.
        force: contact force of the newest frame, N; NaN before the first.
        dropped: number of samples lost so far.
        T_base_carrier: frame (4, 4) of the object's carrier in base, m; None without one.
    """

    t_s: float = 0.0
    phase: str | None = None
    q: Floats | None = None
    contact: ContactFrame | None = None
    answer: JudgedAnswer | None = None
    taxels: NDArray[np.uint8] | None = None
    force: float = math.nan
    dropped: int = 0
    T_base_carrier: Floats | None = None


def judge(patch: SurfacePatch, shape: PlacedShape | None) -> JudgedAnswer:
    """An answer beside the true object; None where that is not known."""
    C = patch.covariance
    variance = float(C[0, 0] + 2.0 * C[1, 1] + C[2, 2])
    sigma = math.sqrt(max(variance, 0.0)) if math.isfinite(variance) else math.inf
    if shape is None:
        return JudgedAnswer(patch, math.nan, (math.nan, math.nan), sigma)
    true = shape.closest(patch.T_base_contact[:3, 3])
    error = math.nan
    if all(patch.observed) and np.isfinite(patch.K).all():
        axes = patch.T_base_contact[:3, :2]
        tensor = (true.directions.T * true.kappa) @ true.directions
        error = float(np.linalg.norm(patch.K - axes.T @ tensor @ axes))
    first, second = true.kappa.tolist()
    return JudgedAnswer(patch, error, (first, second), sigma)


class Follower:
    """Keeps the newest state of the cell while samples come in.

    Args:
        shape: the true object, for the error; None where it is not known.
    """

    def __init__(self, shape: PlacedShape | None = None) -> None:
        self.shape = shape
        self.moment = Moment()
        self._felt_ns = -SILENT_NS

    def take(self, sample: Sample) -> Moment:
        """The moment with what was new in a sample."""
        now = replace(self.moment, t_s=sample.t_ns * 1e-9, phase=sample.phase, dropped=sample.dropped)
        if sample.q is not None:
            now = replace(now, q=sample.q)
        if sample.T_base_carrier is not None:
            now = replace(now, T_base_carrier=sample.T_base_carrier)
        if (touch := sample.touch) is not None:
            self._felt_ns = sample.t_ns
            taxels = now.taxels if touch.counts is None else touch.counts
            now = replace(now, taxels=taxels, force=float(np.linalg.norm(touch.force)), contact=touch.contact)
        elif sample.t_ns - self._felt_ns > SILENT_NS:
            now = replace(now, contact=None)
        if sample.patch is not None:
            now = replace(now, answer=judge(sample.patch, self.shape))
        self.moment = now
        return now


NAMES = ("t_s", "force", "kappa1", "low1", "high1", "kappa2", "low2", "high2", "true1", "true2", "error", "sigma")
Curves = dict[str, Floats]
"""Columns by the names of `NAMES`; s, N, 1/m; low and high are the ends of the 95 % bands; NaN: nothing to plot."""


def kappa_sigmas(patch: SurfacePatch) -> tuple[float, float]:
    """Stated standard deviations of κ1 ≥ κ2, 1/m; infinite where not observed."""
    if not np.isfinite(patch.covariance).all() or not np.isfinite(patch.K).all():
        return math.inf, math.inf
    _, vectors = np.linalg.eigh(patch.K)
    out = []
    for u, v in vectors.T[::-1]:
        g = np.array((u * u, 2.0 * u * v, v * v))
        out.append(math.sqrt(max(float(g @ patch.covariance @ g), 0.0)))
    return out[0], out[1]


def row_of(moment: Moment) -> tuple[float, ...]:
    """One row of the plots, in the order of `NAMES`."""
    nan, answer = math.nan, moment.answer
    if answer is None:
        return (moment.t_s, moment.force, *(nan,) * (len(NAMES) - 2))
    kappa, sigmas = np.array(answer.patch.kappa), np.array(kappa_sigmas(answer.patch))
    half = np.where(np.isfinite(sigmas), 1.96 * sigmas, nan)
    bands = np.column_stack([kappa, kappa - half, kappa + half]).ravel().tolist()
    sigma = answer.sigma if math.isfinite(answer.sigma) else nan
    return (moment.t_s, moment.force, *bands, *answer.kappa_true, answer.error, sigma)


def curves_of(rows: Iterable[tuple[float, ...]]) -> Curves:
    """Columns of rows from `row_of`."""
    columns = np.array(list(rows), dtype=np.float64).reshape(-1, len(NAMES)).T
    return dict(zip(NAMES, columns, strict=True))
