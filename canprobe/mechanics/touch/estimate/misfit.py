"""What a quadric leaves out: the cubic and quartic terms of a surface, found in the residuals or allowed for.

A quadric has two of the four cubic terms of a surface's height over its tangent plane; a torus, a fillet or a wave
has the others too. They turn into errors of K that no covariance of a quadric knows. Here the height gets terms `Σ
a_j φ_j(x, y)`, all cubic and quartic monomials about the contact, with `a ~ N(0, τ²)` alike in all directions, and
the answer is averaged over τ: 0 (a quadric), what is usual for a surface of such curvature (`USUAL_CURVATURE_CHANGES`),
and, should the residuals insist, anything (`TAIL_VARIANCES`). The weights are the prior's times the marginal
likelihood of the residuals: a quadric stays one, a misfit that shows is corrected, one that could hide in the noise
widens the covariance.

The correction is one linear step. Where quartic terms matter, still higher ones do too: they are taken to be a third of
the correction (`HIGHER_TERMS_SHARE`), which goes into the covariance. A correction of more than a tenth of K is too
large for a linear step: then the path has no local quadric, and K is not observed. Both are measured on the
combinations of K that were observed, of a straight path the curvature along it and the twist: the rest of a fit is
noise, and so is its correction.

Why not fit all eighteen terms: noise alone would fill the nine additional ones on a short path, and the covariance of K
would grow also where the surface is a quadric.

Source: Hoeting, Madigan, Raftery and Volinsky, "Bayesian model averaging: a tutorial", 1999, (1)–(3), with the
marginal likelihood of a linear model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.noise import mixed
from canprobe.mechanics.touch.estimate.nonlinear import robust
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, DEGREE, sharpest
from canprobe.mechanics.touch.estimate.residuals import Design, linearise
from canprobe.mechanics.touch.linear_algebra import inverted, upper_root
from canprobe.mechanics.types import Floats

NO_MISFIT_WEIGHT, USUAL_MISFIT_WEIGHT, TAIL_MISFIT_WEIGHT = 0.88, 0.11, 0.01
"""Prior weights of no misfit, of a usual one, and of one of any size that counts only when the residuals show it.

Some nine in ten places on real objects are taken to be like a quadric over a path no longer than a radius: flat, round,
or nearly so. An edge or a seam is one in a hundred; it shows, and then its likelihood outweighs the prior.
"""
USUAL_CURVATURE_CHANGES = (0.1, 0.5)
"""Usual changes of curvature along a surface, dK/ds over ‖K‖²: a torus 2.5 times as wide as its tube has 0.1 on its
outer side and 0.4 on top, a fillet more. Slower changes are some percent of K over a path of a radius."""
BLUR_LIMIT_RAD = 5e-3
"""Largest κσ_p (noise of a point over the least radius), rad, at which `NO_MISFIT_WEIGHT` holds in full; from twice as
much on the prior takes a usual misfit for certain. A path on which points err by so much of the radius says next to
nothing about cubic terms, so the prior alone answers for them, and the cautious one is taken: there a region may hold
the truth too often, not too seldom."""
TAIL_VARIANCES = 10.0 ** np.arange(1.0, 9.0)
"""Variances of the terms in the tail, over the variance to which the data know the best known term."""
HIGHER_TERMS_SHARE = 0.35
"""Standard deviation that higher terms add, over the change by cubic and quartic ones. It follows the change and not K:
on an edge higher terms are no smaller where the surface is flat."""
MAX_CORRECTION_SHARE = 0.1
"""Largest change of K by a correction that is used, over the larger of ‖K‖ and 1/length."""
MENTIONED_PROBABILITY = 0.99
"""Least probability of a misfit that an estimate mentions."""
_ALL = np.eye(3)
_IS_CUBIC = DEGREE == 3
_MIN_SCALED_CURVATURE = 0.1
"""Least ‖K‖ · length by which the usual size of quartic terms over cubic ones falls."""
# a term a x³ of the height changes the curvature by 6 a
_USUAL_VARIANCES = np.concatenate([[0.0], np.square(USUAL_CURVATURE_CHANGES) / 36.0])
_VARIANCES = np.concatenate([_USUAL_VARIANCES, TAIL_VARIANCES])
"""Variances of the terms: without a misfit, usual ones over ‖K‖⁴ (in units of the length), and the tail's."""
_COUNTS = np.array([1, len(USUAL_CURVATURE_CHANGES), len(TAIL_VARIANCES)])
_PRIOR_WEIGHTS, _CAUTIOUS_WEIGHTS = (
    np.repeat(np.array([none, usual, TAIL_MISFIT_WEIGHT]) / _COUNTS, _COUNTS)
    for none, usual in ((NO_MISFIT_WEIGHT, USUAL_MISFIT_WEIGHT), (0.0, NO_MISFIT_WEIGHT + USUAL_MISFIT_WEIGHT))
)


class Averaged(NamedTuple):
    """The parameters of a quadric, averaged over what it leaves out.

    Attributes:
        shift: (9,) correction to add to the parameters.
        spread: (9, 9) covariance that the terms add to that of the parameters.
        share: (9,) mean variance that the data leave to the terms, in each of their directions.
        terms: (9,) mean of the terms in these directions.
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
    """(9,) usual size of each term over that of the cubic ones, for a curvature ‖K‖ · length."""
    return np.where(_IS_CUBIC, 1.0, 0.25 * max(curvature, _MIN_SCALED_CURVATURE))


def averaged(  # noqa: PLR0917 - what the terms are known by, and what is assumed of the surface
    m: Floats, s: Floats, carried: Floats, curvature: float, blur: float = 0.0, observed: Floats = _ALL
) -> Averaged:
    """Average over the variance of the terms, given in directions in which the data's information is diagonal.

    Args:
        m: (9,) information about the terms.
        s: (9,) score of the residuals; the terms `s / m` fit best.
        carried: (9, 9) change of the fitted parameters by a unit of each term, with the sign turned.
        curvature: curvature ‖K‖ · length.
        blur: noise of a point over the least radius, κσ_p, rad.
        observed: (3, k) columns: the observed combinations of q, whose change is measured. That of the others is noise.
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
    changed = float(weight.dot(np.square((shifts[:, 6:] / C_PER_Q).dot(observed)).sum(axis=1)))
    spread.flat[60::10] += HIGHER_TERMS_SHARE**2 * changed * C_PER_Q**2  # of K
    trusted = changed <= (MAX_CORRECTION_SHARE * max(curvature, 1.0)) ** 2
    shown = 1.0 - NO_MISFIT_WEIGHT * float(evidence[0] / _PRIOR_WEIGHTS.dot(evidence))
    return Averaged(mean, spread, left, weight.dot(share * s), shown, trusted)


def _prior(blur: float) -> Floats:
    """Prior weights of no misfit, the usual ones and the tail, at κσ_p (rad)."""
    if blur <= BLUR_LIMIT_RAD:
        return _PRIOR_WEIGHTS
    result: Floats = _PRIOR_WEIGHTS + min(blur / BLUR_LIMIT_RAD - 1.0, 1.0) * (_CAUTIOUS_WEIGHTS - _PRIOR_WEIGHTS)
    return result


def correct(
    c: Floats, root: Floats, d: Design, independent: Floats | None, observed: Floats
) -> tuple[Averaged, Floats]:
    """Average a converged fit over its misfit.

    Args:
        c: (9,) parameters in the frame at the last sample.
        root: (9, 9) root of their information, regular.
        d, independent: as for `nonlinear.fit`.
        observed: (3, k) columns: the observed combinations of q. The others are held at what they are.

    Returns:
        The average, and the (9, 9) upper triangular root of the information about the corrected parameters.
    """
    J, E, r, slack = _rows(c, d, independent)
    curvature = float(np.linalg.norm(c[6:] / C_PER_Q))
    E *= scales(curvature)
    fitted = np.zeros((9, 6 + observed.shape[1]))
    fitted[:6, :6], fitted[6:, 6:] = np.eye(6), C_PER_Q[:, None] * observed
    inverse = fitted @ inverted(upper_root(root @ fitted))
    carried = inverse @ (inverse.T @ (J.T @ E))  # terms a put the quadric off by −carried a
    m, U = np.linalg.eigh(E.T @ (E - J @ carried))  # what the parameters and their prior cannot explain of them
    s = U.T @ (carried.T @ slack - E.T @ r)
    blur = sharpest(c) * math.sqrt(float(d.point_variance.mean()))
    found = averaged(np.maximum(m, 0.0), s, carried @ U, curvature, blur, observed)
    whole = inverted(root)
    lower = np.asarray(np.linalg.cholesky(whole @ whole.T + found.spread), dtype=np.float64)
    return found, upper_root(inverted(lower))


def _rows(c: Floats, d: Design, independent: Floats | None) -> tuple[Floats, Floats, Floats, Floats]:
    """Whitened rows of the parameters and of the terms (3n, 9), residuals (3n,), and what is left of Jᵀ r (9,)."""
    # wrong samples count by the square of their weight: those that still pull at the fit would look like a misfit
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
    """Notes of an estimate about a misfit."""
    if not trusted:
        return ("no quadric: K varies too much along the path to be observed",)
    return ("no quadric: corrected for cubic and quartic terms",) if misfit > MENTIONED_PROBABILITY else ()
