"""Calibration of the probe's centre in the flange frame, by touches of a ball in several orientations.

Each touch gives an equation for the ball's centre: ``p + R (t + (r + ρ − δ) E d) = c`` with the flange at ``p, R``, the
tool centre ``t``, the direction ``d`` of the ball that the array measures, the sum ``r`` of both radii, the indentation
``δ``, the ball's centre ``c``, an error ``ρ`` of the radii and a tilt ``E`` of the array on the probe. Along ``d`` the
equation holds to a few hundredths of a millimetre, across it as well as the array measures directions. All equations
are solved by Gauss-Newton least squares; ``t`` has no prior, so the part of it that the touches do not observe is
marked as unobserved.

A tilt of the array and a sideways offset of the tool have the same effect if the pole always points to the ball;
touches beside the pole separate them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.mechanics.types import Floats

LENGTH_UNIT_M = 1e-3
ANGLE_UNIT_RAD = 1e-2
_UNKNOWN_UNITS = np.array([LENGTH_UNIT_M] * 7 + [ANGLE_UNIT_RAD] * 2)
"""Units of the unknowns (tool centre, ball centre, radii, tilt) in which the problem is solved."""
GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))
_MAX_ROUNDS = 20
_T, _C, _RHO, _TILT = slice(0, 3), slice(3, 6), 6, slice(7, 9)


@dataclass(frozen=True, slots=True, eq=False)
class BallTouch:
    """One touch at rest.

    Attributes:
        T_base_flange: (4, 4) pose of the flange, m.
        d_flange: (3,) unit vector from the probe's centre to the ball, as the array measured it, flange frame.
        depth: indentation of the layer, m.
    """

    T_base_flange: Floats
    d_flange: Floats
    depth: float


@dataclass(frozen=True, slots=True, eq=False)
class BallModel:
    """Values before the touches, and standard deviations.

    Attributes:
        t_flange: (3,) assumed tool centre, m, from which the search starts; it is no prior.
        c_base: (3,) centre of the ball, m.
        radii: sum of the radii of probe and ball, m.
        sigma_c: standard deviation of the ball's centre per axis, m.
        sigma_radii: standard deviation of the sum of the radii with the indentation, m.
        sigma_tilt: standard deviation of the array's orientation on the flange, rad.
        sigma_along: standard deviation of one touch along its direction, m.
        sigma_across: standard deviation of one touch across its direction, m.
        observed_below: standard deviation of a coordinate of the tool centre below which it counts as observed, m.
    """

    t_flange: Floats
    c_base: Floats
    radii: float
    sigma_c: float = 5e-3
    sigma_radii: float = 50e-6
    sigma_tilt: float = 5e-3
    sigma_along: float = 20e-6
    sigma_across: float = 0.1e-3
    observed_below: float = 0.25e-3


@dataclass(frozen=True, slots=True, eq=False)
class ToolEstimate:
    """Result of a calibration.

    Attributes:
        t_flange: (3,) tool centre, m, flange frame; NaN where not observed.
        covariance: (3, 3) covariance of the tool centre, m²; infinite where nothing is known.
        observed: (3,) whether each coordinate was observed.
        c_base: (3,) centre of the ball, m.
        radii_error: error of the sum of the radii, m.
        tilt: (2,) tilt of the array about the flange's x and y, rad.
        condition_number: condition number of the whole problem, priors included, in units of `LENGTH_UNIT_M` and
            `ANGLE_UNIT_RAD`.
        along_rms, across_rms: RMS residuals along and across the touches, m.
        chi2_per_dof: sum of squared residuals over their expectation; None without more rows than unknowns.
        touches: number of touches.
    """

    t_flange: Floats
    covariance: Floats
    observed: NDArray[np.bool_]
    c_base: Floats
    radii_error: float
    tilt: Floats
    condition_number: float
    along_rms: float
    across_rms: float
    chi2_per_dof: float | None
    touches: int

    @property
    def sigma(self) -> Floats:
        """Standard deviation of each coordinate (3,), m."""
        return np.sqrt(np.diag(self.covariance))


def calibrate_tool(touches: Sequence[BallTouch], model: BallModel) -> ToolEstimate:
    """Estimate the tool centre.

    Args:
        touches: touches of one ball, at least two.
        model: values and standard deviations before the touches.

    Raises:
        UsageError: there are fewer than two touches, or one is not finite.
    """
    if len(touches) < 2:
        raise UsageError(f"touches: expected 2 or more, got {len(touches)}: one shows only where the ball is")
    for number, touch in enumerate(touches, start=1):
        if not (np.isfinite(touch.T_base_flange).all() and np.isfinite(touch.d_flange).all()):
            raise UsageError(f"touches: touch {number} is not finite")
    x0 = np.concatenate([model.t_flange, model.c_base, np.zeros(3)])
    x = x0.copy()
    for _ in range(_MAX_ROUNDS):
        r, J = _rows(touches, model, x, x0)
        step = _UNKNOWN_UNITS * np.linalg.lstsq(J * _UNKNOWN_UNITS, -r, rcond=1e-12)[0]
        x += step
        if np.abs(step / _UNKNOWN_UNITS).max() < 1e-9:
            break
    r, J = _rows(touches, model, x, x0)
    return _estimate(touches, model, x, r, J)


def residual(touch: BallTouch, model: BallModel, x: Floats) -> tuple[Floats, Floats]:
    """Residual of one touch: the ball's centre by the touch less the ball's centre, and its derivative.

    Args:
        touch: one touch.
        model: model with the radii.
        x: (9,) unknowns: tool centre (m), ball centre (m), error of the radii (m), tilt (rad).

    Returns:
        Residual (3,), m, base frame, and its derivative (3, 9) by the unknowns.
    """
    R, p = touch.T_base_flange[:3, :3], touch.T_base_flange[:3, 3]
    d = touch.d_flange
    reach = model.radii + x[_RHO] - touch.depth
    ex, ey = x[_TILT]
    turned = d + np.array([ey * d[2], -ex * d[2], ex * d[1] - ey * d[0]])
    J = np.zeros((3, 9))
    J[:, _T], J[:, _C] = R, -np.eye(3)
    J[:, _RHO] = R @ turned
    J[:, 7] = reach * (R @ np.array([0.0, -d[2], d[1]]))
    J[:, 8] = reach * (R @ np.array([d[2], 0.0, -d[0]]))
    return p + R @ (x[_T] + reach * turned) - x[_C], J


def _rows(touches: Sequence[BallTouch], model: BallModel, x: Floats, x0: Floats) -> tuple[Floats, Floats]:
    """Whitened residuals (3n + 6,) and their derivative: the touches, then the priors on all but the tool centre."""
    blocks, slopes = [], []
    for touch in touches:
        r, J = residual(touch, model, x)
        m = touch.T_base_flange[:3, :3] @ touch.d_flange
        along = np.outer(m, m)
        white = along / model.sigma_along + (np.eye(3) - along) / model.sigma_across
        blocks.append(white @ r)
        slopes.append(white @ J)
    sigma = np.array([model.sigma_c] * 3 + [model.sigma_radii] + [model.sigma_tilt] * 2)
    prior = np.zeros((6, 9))
    prior[:, 3:] = np.diag(1.0 / sigma)
    return np.concatenate([*blocks, (x - x0)[3:] / sigma]), np.concatenate([*slopes, prior])


def _estimate(touches: Sequence[BallTouch], model: BallModel, x: Floats, r: Floats, J: Floats) -> ToolEstimate:
    _, s, Vt = np.linalg.svd(J * _UNKNOWN_UNITS, full_matrices=False)
    known = s > s[0] * 1e-12
    condition = float(s[0] / s[-1]) if known.all() else float("inf")
    V = Vt.T[:3] * LENGTH_UNIT_M
    covariance = V[:, known] / s[known] ** 2 @ V[:, known].T
    blind = (np.abs(V[:, ~known]) > 1e-9 * LENGTH_UNIT_M).any(axis=1)
    covariance[blind, blind] = np.inf
    observed = np.sqrt(np.diag(covariance)) < model.observed_below
    n = len(touches)
    rows = r[: 3 * n].reshape(n, 3)
    m = np.array([touch.T_base_flange[:3, :3] @ touch.d_flange for touch in touches])
    along = np.sum(rows * m, axis=1)
    across2 = np.maximum(np.sum(rows**2, axis=1) - along**2, 0.0)
    free = len(r) - len(x)
    return ToolEstimate(
        t_flange=np.where(observed, x[_T], np.nan),
        covariance=covariance,
        observed=observed,
        c_base=x[_C].copy(),
        radii_error=float(x[_RHO]),
        tilt=x[_TILT].copy(),
        condition_number=condition,
        along_rms=float(np.sqrt(np.mean(along**2))) * model.sigma_along,
        across_rms=float(np.sqrt(np.mean(across2) / 2)) * model.sigma_across,
        chi2_per_dof=float(r @ r / free) if free > 0 else None,
        touches=n,
    )


@dataclass(frozen=True, slots=True, eq=False)
class BallApproach:
    """Direction of one touch and orientation of the probe in it.

    Attributes:
        n_base: (3,) outward unit normal of the ball at the contact.
        pole_base: (3,) unit vector of the probe's pole during the touch.
    """

    n_base: Floats
    pole_base: Floats


def ball_approaches(count: int, tilt: float, beside: float, up: Floats) -> list[BallApproach]:
    """Touches all round a ball: on a ring about its top, each beside the pole of the probe in another direction.

    Neighbours on the ball are neighbours in the list. From one to the next the direction beside the pole turns by the
    golden angle, so that the turn of the tool is not correlated with the place on the ball.

    Args:
        count: number of touches, the first on top.
        tilt: angle of the ring from the top, rad.
        beside: angle of the touch from the pole, rad; 0 turns the pole to the ball.
        up: (3,) unit vector to the top.
    """
    e1 = np.cross(up, np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([1.0, 0.0, 0.0]))
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(up, e1)
    found = []
    for k in range(count):
        around = 2.0 * np.pi * k / max(count - 1, 1)
        lean = tilt if k else 0.0
        n = np.cos(lean) * up + np.sin(lean) * (np.cos(around) * e1 + np.sin(around) * e2)
        side = np.cos(k * GOLDEN_ANGLE_RAD) * e1 + np.sin(k * GOLDEN_ANGLE_RAD) * e2
        side = side - n * float(n @ side)
        side /= np.linalg.norm(side)
        found.append(BallApproach(n, -np.cos(beside) * n + np.sin(beside) * side))
    return found
