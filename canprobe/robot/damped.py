"""Damped least-squares inverse of the Jacobian, damped only near singular poses."""

from __future__ import annotations

import numpy as np

from canprobe.robot.puma260 import Array


def damped_step(
    J: Array,
    twist: Array,
    *,
    qd_max: Array | None = None,
    damping: float = 0.05,
    threshold: float = 0.08,
    length_m: float = 0.2,
) -> Array:
    """Joint rates for a tool twist.

    Away from singular poses this is the exact inverse. Where the smallest singular value s falls below the threshold
    the squared damping rises as ``damping^2 (1 - (s/threshold)^2)``, on all directions alike, so that rates stay
    bounded and continuous. Rates beyond ``qd_max`` are scaled together: the direction of motion is kept.

    Args:
        J: (6, 6) geometric Jacobian, linear rows first.
        twist: (6,) linear m/s then angular rad/s (or a displacement: the map is linear up to the limits).
        qd_max: (6,) limits in the unit of the result; none if omitted.
        damping: largest damping, dimensionless (linear rows are divided by ``length_m``).
        threshold: singular value below which damping starts, dimensionless.
        length_m: characteristic length of the arm that makes linear and angular rows comparable, m.

    Returns:
        (6,) joint rates, rad/s.

    Source: Nakamura & Hanafusa 1986; Maciejewski & Klein 1988 (variable damping factor).
    """
    scale = np.array((1 / length_m,) * 3 + (1.0,) * 3)
    scaled = J * scale[:, None]
    qd = _regular_step(scaled, scale * twist, threshold)
    if qd is None:
        U, s, Vt = np.linalg.svd(scaled)
        ratio = float(s[-1]) / threshold
        lambda2 = damping**2 * (1.0 - ratio**2) if ratio < 1.0 else 0.0
        qd = Vt.T @ ((U.T @ (scale * twist)) * (s / (s * s + lambda2)))
    if qd_max is not None:
        qd = qd / max(1.0, float(np.max(np.abs(qd) / qd_max)))
    return qd


def _regular_step(J: Array, twist: Array, threshold: float) -> Array | None:
    """The exact inverse where it is cheap to see that no damping is due (1/‖J⁻¹‖ is below every singular value)."""
    try:
        inverse = np.linalg.inv(J)
    except np.linalg.LinAlgError:
        return None
    if float(np.vdot(inverse, inverse)) * threshold**2 >= 1.0:
        return None
    step: Array = inverse @ twist
    return step
