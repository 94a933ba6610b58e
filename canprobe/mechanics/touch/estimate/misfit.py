"""What a quadric leaves out: the cubic and quartic terms of a surface, found in the residuals or allowed for.

A quadric has two of the four cubic terms of a surface's height over its tangent plane; a torus, a fillet or a wave
has the others too. They turn into errors of K that no covariance of a quadric knows. Here the height gets terms `Σ
a_j φ_j(x, y)`, all cubic and quartic monomials about the contact, with `a ~ N(0, τ²)` alike in all directions, and
the answer is averaged over τ: 0 (a quadric), what is usual for a surface of such curvature (`USUAL_CURVATURE_CHANGES`),
and, should the residuals insist, anything (`TAIL_VARIANCES`). The weights are the prior's times the marginal
likelihood of the residuals: a quadric stays one, a misfit that shows is corrected, one that could hide in the noise
widens the covariance.

The correction is one linear step, and higher terms follow where quartic ones matter: their part is taken to be a
third of the correction, and goes into the covariance. A correction of more than a tenth of K is
beyond that: the path has no local quadric, and K is not observed.

Source: Hoeting, Madigan, Raftery and Volinsky, "Bayesian model averaging: a tutorial", 1999, (1)–(3), with the
marginal likelihood of a linear model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.noise import mixed
from canprobe.mechanics.touch.estimate.nonlinear import robust
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, sharpest
from canprobe.mechanics.touch.estimate.residuals import Design, linearise
from canprobe.mechanics.touch.estimate.terms import DEGREE
from canprobe.mechanics.touch.linear_algebra import inverted, upper_root
from canprobe.mechanics.types import Floats

NO_MISFIT_WEIGHT, USUAL_MISFIT_WEIGHT, TAIL_MISFIT_WEIGHT = 0.88, 0.11, 0.01
"""Prior weights of: no misfit; a usual one; one that is only believed when seen.

Some nine in ten places on what is felt are taken to be like a quadric over a path no longer than a radius: flat, round,
or nearly so. An edge or a seam is one in a hundred; it shows, and then its likelihood outweighs that.
"""
USUAL_CURVATURE_CHANGES = (0.1, 0.5)
"""A usual change of curvature along a surface, dK/ds over ‖K‖²: a torus 2.5 times as wide as its tube has 0.1 on its
outer side and 0.4 on top, a fillet more. Slower ones change K by some percent over a path of a radius."""
BLUR_LIMIT_RAD = 5e-3
"""Largest κσ_p (noise of a point over the least radius), rad, at which `NO_MISFIT_WEIGHT` holds in full; from twice as
much on the prior takes a usual misfit for certain. A path on which points err by so much of the radius says next to
nothing about cubic terms, so the prior alone answers for them, and the cautious one is taken: there a region may hold
the truth too often, not too seldom."""
TAIL_VARIANCES = 10.0 ** np.arange(1.0, 9.0)
"""Variances of the tail over that of the best known of the terms."""
HIGHER_TERMS_SHARE = 0.35
"""Higher terms over what cubic and quartic ones changed; on an edge they are no smaller where the surface is flat."""
MAX_CORRECTION_SHARE = 0.1
"""Largest change of K that is believed, over ‖K‖ or 1/length."""
MENTIONED_PROBABILITY = 0.99
"""Probability of a misfit from which an estimate mentions it."""
_Q_PER_C_SQUARED = C_PER_Q**-2.0
_IS_CUBIC = DEGREE == 3
_MIN_SCALED_CURVATURE = 0.1
"""‖K‖ · length at which the ratio of quartic to cubic terms stops falling."""
_USUAL_VARIANCES = np.concatenate([[0.0], np.square(USUAL_CURVATURE_CHANGES) / 36.0])
_VARIANCES = np.concatenate([_USUAL_VARIANCES, TAIL_VARIANCES])
"""No misfit, usual ones per ‖K‖⁴ (the length being 1), and the tail."""
_PRIOR_WEIGHTS = np.repeat(
    [NO_MISFIT_WEIGHT, USUAL_MISFIT_WEIGHT / len(USUAL_CURVATURE_CHANGES), TAIL_MISFIT_WEIGHT / len(TAIL_VARIANCES)],
    [1, len(USUAL_CURVATURE_CHANGES), len(TAIL_VARIANCES)],
)
_CAUTIOUS_WEIGHTS = np.repeat(
    [
        0.0,
        (NO_MISFIT_WEIGHT + USUAL_MISFIT_WEIGHT) / len(USUAL_CURVATURE_CHANGES),
        TAIL_MISFIT_WEIGHT / len(TAIL_VARIANCES),
    ],
    [1, len(USUAL_CURVATURE_CHANGES), len(TAIL_VARIANCES)],
)


class Corrected(NamedTuple):
    """A fit with what it leaves out: parameters (9,) and the upper triangular root (9, 9) of their information.

    misfit, trusted: as of `Averaged`.
    """

    c: Floats
    root: Floats
    misfit: float
    trusted: bool


class Averaged(NamedTuple):
    """The parameters of a quadric, averaged over what it leaves out.

    Attributes:
        shift: (9,) what to add to them.
        spread: (9, 9) covariance that the terms add to theirs.
        share: (9,) how much of each direction of the terms the data settle: mean variance left.
        terms: (9,) the terms in these directions.
        misfit: probability of a misfit, without the caution of `BLUR_LIMIT_RAD`; `1 − NO_MISFIT_WEIGHT` where the
            residuals show none.
        trusted: the change of K is small enough for a linear step.
    """

    shift: Floats
    spread: Floats
    share: Floats
    terms: Floats
    misfit: float
    trusted: bool


def scales(curvature: float) -> Floats:
    """(9,) usual size of each term over that of the cubic ones, at ‖K‖ · length."""
    return np.where(_IS_CUBIC, 1.0, 0.25 * max(curvature, _MIN_SCALED_CURVATURE))


def averaged(m: Floats, s: Floats, carried: Floats, curvature: float, blur: float = 0.0) -> Averaged:
    """Average over the variance of the terms, given in directions in which the data's information is diagonal.

    Args:
        m: (9,) information about them.
        s: (9,) its score; terms `s / m` fit best.
        carried: (9, 9) what a unit of each puts the parameters off by, with the sign turned.
        curvature: ‖K‖ · length.
        blur: κσ_p, rad.
    """
    variance = _VARIANCES.copy()
    variance[: len(_USUAL_VARIANCES)] *= curvature**4
    variance[len(_USUAL_VARIANCES) :] /= max(float(m.max()), 1e-300)
    wider = 1.0 + variance[:, None] * m
    share = variance[:, None] / wider
    likelihood = 0.5 * (share.dot(s * s) - np.log(wider).sum(axis=1))
    evidence = np.exp(likelihood - likelihood.max())
    weight = _prior(blur) * evidence
    weight /= weight.sum()
    shifts = -(share * s).dot(carried.T)
    mean = weight.dot(shifts)
    apart = shifts - mean
    left = weight.dot(share)
    spread = (carried * left).dot(carried.T) + (apart.T * weight).dot(apart)
    changed = float(weight.dot(np.square(shifts[:, 6:])).dot(_Q_PER_C_SQUARED))
    spread.flat[60::10] += HIGHER_TERMS_SHARE**2 * changed / _Q_PER_C_SQUARED  # of K
    trusted = changed <= (MAX_CORRECTION_SHARE * max(curvature, 1.0)) ** 2
    shown = 1.0 - NO_MISFIT_WEIGHT * float(evidence[0] / _PRIOR_WEIGHTS.dot(evidence))
    return Averaged(mean, spread, left, weight.dot(share * s), shown, trusted)


def _prior(blur: float) -> Floats:
    """Prior weights of no misfit, the usual ones and the tail, at κσ_p (rad)."""
    if blur <= BLUR_LIMIT_RAD:
        return _PRIOR_WEIGHTS
    result: Floats = _PRIOR_WEIGHTS + min(blur / BLUR_LIMIT_RAD - 1.0, 1.0) * (_CAUTIOUS_WEIGHTS - _PRIOR_WEIGHTS)
    return result


def correct(c: Floats, root: Floats, d: Design, independent: Floats | None) -> Corrected:
    """Average a converged fit (c in the frame at the last sample, its root; else as `fit`) over its misfit."""
    J, E, r, slack = _rows(c, d, independent)
    inverse = inverted(root)
    H = inverse @ inverse.T
    curvature = float(np.linalg.norm(c[6:] / C_PER_Q))
    E *= scales(curvature)
    carried = H @ (J.T @ E)  # terms a put the quadric off by −carried a
    m, U = np.linalg.eigh(E.T @ (E - J @ carried))  # what the nine parameters and their prior cannot explain of them
    s = U.T @ (carried.T @ slack - E.T @ r)
    blur = sharpest(c) * math.sqrt(float(d.point_variance.mean()))
    found = averaged(np.maximum(m, 0.0), s, carried @ U, curvature, blur)
    lower = np.asarray(np.linalg.cholesky(H + found.spread), dtype=np.float64)
    return Corrected(c + found.shift, upper_root(inverted(lower)), found.misfit, found.trusted)


def _rows(c: Floats, d: Design, independent: Floats | None) -> tuple[Floats, Floats, Floats, Floats]:
    """Whitened rows of the parameters (3n, 9) and of the terms (3n, 9), residuals (3n,), what is left of Jᵀ r (9,).

    Wrong samples count by the square of their weight: some that still pull at the fit would look like a misfit.
    """
    at = linearise(c, d)
    weight = robust(np.einsum("ij,ij->i", at.r, at.r))[0][:, None, None]
    joined = np.concatenate([at.jacobian(18), at.r[:, :, None]], axis=2)
    rows, fitted = joined * weight, joined[:, :, [*range(9), -1]] * np.sqrt(weight)
    if independent is not None:
        rows, fitted = mixed(independent, rows), mixed(independent, fitted)
    rows, fitted = rows.reshape(-1, rows.shape[2]), fitted.reshape(-1, 10)
    J, E, r = rows[:, :9], rows[:, 9:-1], rows[:, -1]
    return J, E, r, J.T @ r - fitted[:, :9].T @ fitted[:, 9]


def misfit_notes(misfit: float, *, trusted: bool) -> tuple[str, ...]:
    """What a reader should know about a misfit."""
    if not trusted:
        return ("no quadric: K varies too much along the path to be observed",)
    return ("no quadric: corrected for cubic and quartic terms",) if misfit > MENTIONED_PROBABILITY else ()
