"""A quartic over a tangent plane: its terms and what is believed of them before any contact.

The height over the plane is h(x, y) = Σ a_ij xⁱ yʲ / (i! j!), i + j ≤ 4: 15 unknowns, each a derivative at the
origin. z is the outward normal, so that the curvature there is K = −∇²h.
"""

from __future__ import annotations

import math

import numpy as np

from canprobe.mechanics.types import Floats

POWERS = [(n - j, j) for n in range(5) for j in range(n + 1)]
TERMS = len(POWERS)
SECOND, THIRD, FOURTH = slice(3, 6), slice(6, 10), slice(10, 15)
LENGTH_M = 6e-3
"""Unit of length of all coefficients: with it they are of one size."""
CURVATURE_SIGMA = 60.0
"""Prior standard deviation of curvature, 1/m."""
HEIGHT_SIGMA_M, SLOPE_SIGMA = 10e-3, 1.0
"""Prior standard deviations of height and slope at the origin: none."""
CHANGES = (15.0, 50.0, 300.0, 2000.0, 12000.0)
"""Prior standard deviations of third derivatives, 1/m², among which the evidence chooses."""
USUAL_CHANGE, CHANGE_SPREAD = 10.0**2.5, 1.5
"""Median of that deviation, 1/m², and standard deviation of its logarithm."""


def _second_derivatives() -> Floats:
    found = np.zeros((2, 2, TERMS, TERMS))
    for a, b in np.ndindex(2, 2):
        for t, (i, j) in enumerate(POWERS):
            lower = (i - (a == 0) - (b == 0), j - (a == 1) - (b == 1))
            if lower in POWERS:
                found[a, b, POWERS.index(lower), t] = 1.0
    return found


SECOND_DERIVATIVES = _second_derivatives()
"""(2, 2, 15, 15): the terms times one of these are their second derivatives along two of the axes x, y."""


def _powers(x: Floats) -> list[Floats]:
    """1, x, x²/2, x³/6, x⁴/24: each is the derivative of the next."""
    found = [np.ones_like(x)]
    for i in range(1, 5):
        found.append(found[-1] * x / i)
    return found


def terms(x: Floats, y: Floats, *derivatives: tuple[int, int]) -> list[Floats]:
    """Terms (…, 15) of each derivative (i, j) of h at places in units of `LENGTH_M`; (0, 0) is h itself."""
    xs, ys = _powers(x), _powers(y)
    found = []
    for di, dj in derivatives:
        out = np.zeros((*x.shape, TERMS))
        for t, (i, j) in enumerate(POWERS):
            if i >= di and j >= dj:
                np.multiply(xs[i - di], ys[j - dj], out=out[..., t])
        found.append(out)
    return found


def heights_and_slopes(a: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """h, ∂h/∂x, ∂h/∂y (…) of coefficients (15, …) at places in units of `LENGTH_M`."""
    xs, ys = _powers(x), _powers(y)
    h, hx, hy = np.zeros((3, *x.shape))
    for one, (i, j) in zip(a, POWERS, strict=True):
        h += one * xs[i] * ys[j]
        if i:
            hx += one * xs[i - 1] * ys[j]
        if j:
            hy += one * xs[i] * ys[j - 1]
    return h, hx, hy


def _prior_information(change: float) -> Floats:
    L = LENGTH_M
    sigma = np.empty(TERMS)
    sigma[0], sigma[1:3] = HEIGHT_SIGMA_M / L, SLOPE_SIGMA
    sigma[SECOND], sigma[THIRD], sigma[FOURTH] = CURVATURE_SIGMA * L, change * L**2, change / LENGTH_M * L**3
    sigma[4] *= math.sqrt(0.5)  # K12: the prior on curvature is then the same in turned axes
    return sigma**-2


PRIOR_INFORMATION = np.array([_prior_information(change) for change in CHANGES])
"""(5, 15) information of the prior, a row for each of `CHANGES`; dimensionless."""
LOG_HYPERPRIOR = -0.5 * (np.log(np.array(CHANGES) / USUAL_CHANGE) / CHANGE_SPREAD) ** 2
"""(5,) logarithm of how likely each is before any contact."""


def fourth_of(K: Floats) -> Floats:
    """(n, 15) prior mean: fourth derivatives −⅛ (xᵀKx)(xᵀK²x) of a surface of constant normal curvature K (n, 2, 2).

    Dimensionless, K too. Without them a ball is no ball but a paraboloid.
    """
    K2 = K @ K
    a, b = ((q[:, 0, 0], 2.0 * q[:, 0, 1], q[:, 1, 1]) for q in (K, K2))
    mean = np.zeros((len(K), TERMS))
    for i in range(3):
        for j in range(3):
            power = i + j  # of y
            # times i! j!, as unknowns are derivatives; 5 mm from the top of a ball of 40 mm a paraboloid is 1.2 µm off,
            # with this 0.01 µm
            mean[:, FOURTH.start + power] -= 0.125 * a[i] * b[j] * math.factorial(4 - power) * math.factorial(power)
    return mean
