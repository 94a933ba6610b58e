"""Closed-form inverse kinematics: eight branches, angles placed inside the joint ranges, singularities named.

Two shoulder solutions (the arm reaches forward or over its back), two elbow solutions, two wrist solutions.
The elbow offset a3 and the forearm d4 act as one link of length hypot(a3, d4), turned by atan2(d4, a3).

Source: Paul & Zhang, "Computationally efficient kinematics for manipulators with spherical wrists", IJRR 5(2), 1986.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, ceil, cos, degrees, hypot, inf, pi, sin, sqrt

import numpy as np
import numpy.typing as npt

from canprobe.errors import PlanError
from canprobe.robot.puma260 import Array, PumaModel

_TURN = 2 * pi


@dataclass(frozen=True, slots=True, eq=False)
class IkSolution:
    """One branch.

    Attributes:
        q: (6,) joint angles, rad, in the joint ranges wherever that is possible.
        shoulder: +1 wrist centre in front of the shoulder, -1 behind it (over the back).
        elbow: sign of the sine of the angle between upper arm and effective forearm.
        wrist: sign of sin(q5).
        within_limits: whether every angle lies in its range.
    """

    q: Array
    shoulder: int
    elbow: int
    wrist: int
    within_limits: bool


def _wrap(angle: float, low: float, high: float, near: float) -> tuple[float, bool]:
    """The representation of an angle inside [low, high] that is nearest to ``near``, or nearest at all."""
    inside = angle + _TURN * ceil((low - angle) / _TURN - 1e-12)
    if inside > high + 1e-9:
        return angle + _TURN * round((near - angle) / _TURN), False
    best = inside
    while inside <= high + 1e-9:
        if abs(inside - near) < abs(best - near):
            best = inside
        inside += _TURN
    return best, True


def _arm_angles(model: PumaModel, wx: float, wy: float, wz: float) -> list[tuple[float, float, float, int, int]]:
    """(q1, q2, q3, shoulder, elbow) of every branch that reaches the wrist centre."""
    d1, a2, offset, a3, d4, _ = model.links
    forearm, phi = hypot(a3, d4), atan2(d4, a3)
    h = wz - d1
    r2 = wx * wx + wy * wy - offset * offset
    cos_psi = (r2 + h * h - a2 * a2 - forearm * forearm) / (2 * a2 * forearm)
    if r2 < 0.0 or abs(cos_psi) > 1.0:
        return []
    found = []
    for shoulder in (1, -1):
        r = shoulder * sqrt(r2)
        q1 = atan2(wy, wx) - atan2(-offset, r)
        for elbow in (1, -1):
            sin_psi = elbow * sqrt(max(0.0, (1.0 - cos_psi) * (1.0 + cos_psi)))
            q2 = atan2(h, r) - atan2(forearm * sin_psi, a2 + forearm * cos_psi)
            found.append((q1, q2, atan2(sin_psi, cos_psi) - phi, shoulder, elbow))
    return found


def _wrist_angles(R: list[list[float]], q1: float, q23: float, q4_near: float) -> list[tuple[float, float, float, int]]:
    """(q4, q5, q6, wrist) of both wrist branches; at the singularity q4 is free and taken from ``q4_near``."""
    c1, s1, c, s = cos(q1), sin(q1), cos(q23), sin(q23)
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = R
    # Columns of R36 = R03' R: rows are x3, y3, z3.
    x2, y2, z2 = c * (c1 * r02 + s1 * r12) + s * r22, c1 * r12 - s1 * r02, c * r22 - s * (c1 * r02 + s1 * r12)
    x0, y0 = c * (c1 * r00 + s1 * r10) + s * r20, c1 * r10 - s1 * r00
    x1, y1 = c * (c1 * r01 + s1 * r11) + s * r21, c1 * r11 - s1 * r01
    singular = hypot(x2, y2) < 1e-12
    found = []
    for wrist in (1, -1):
        q4 = q4_near if singular else atan2(-wrist * y2, -wrist * x2)
        c4, s4 = cos(q4), sin(q4)
        # q5 and q6 follow from this q4, not from entries of their own: exact near the singularity too.
        q5 = atan2(-(c4 * x2 + s4 * y2), z2)
        q6 = atan2(c4 * y0 - s4 * x0, c4 * y1 - s4 * x1)
        found.append((q4, q5, q6, wrist))
    return found


def inverse(model: PumaModel, T_base_flange: Array, q_near: npt.ArrayLike | None = None) -> list[IkSolution]:
    """All branches that reach a flange pose.

    Args:
        model: the arm.
        T_base_flange: (4, 4) flange pose, m.
        q_near: (6,) rad; chooses among representations that differ by whole turns. Default: middle of the ranges.

    Returns:
        Eight solutions, or none where the wrist centre is out of reach. At a singular pose branches coincide.
    """
    low, high = model.q_min.tolist(), model.q_max.tolist()
    near = [(a + b) / 2 for a, b in zip(low, high, strict=True)] if q_near is None else np.asarray(q_near).tolist()
    R = T_base_flange[:3, :3].tolist()
    wx, wy, wz = (T_base_flange[:3, 3] - model.links[5] * T_base_flange[:3, 2]).tolist()
    solutions = []
    for q1, q2, q3, shoulder, elbow in _arm_angles(model, wx, wy, wz):
        for q4, q5, q6, wrist in _wrist_angles(R, q1, q2 + q3, near[3]):
            wrapped = [_wrap(*a) for a in zip((q1, q2, q3, q4, q5, q6), low, high, near, strict=True)]
            q = np.array([angle for angle, _ in wrapped])
            solutions.append(IkSolution(q, shoulder, elbow, wrist, all(ok for _, ok in wrapped)))
    return solutions


def inverse_near(model: PumaModel, T_base_flange: Array, q_near: npt.ArrayLike, *, max_move_rad: float = inf) -> Array:
    """The solution within the joint limits that is nearest to a given posture (largest joint move smallest).

    Args:
        model: the arm.
        T_base_flange: (4, 4) flange pose, m.
        q_near: (6,) rad.
        max_move_rad: farthest that any joint may be from ``q_near``; without it the answer may be another branch
            (over the back, elbow turned, wrist turned) when the nearest one breaks a limit.

    Returns:
        (6,) joint angles, rad.

    Raises:
        PlanError: out of reach, or every branch breaks a joint limit or is too far; the message names the joints.
    """
    near = np.asarray(q_near, dtype=float)
    solutions = inverse(model, T_base_flange, near)
    allowed = [s.q for s in solutions if s.within_limits and float(np.max(np.abs(s.q - near))) <= max_move_rad]
    if not allowed:
        raise PlanError([_why_not(model, T_base_flange, solutions, near)])
    return min(allowed, key=lambda q: float(np.max(np.abs(q - near))))


def _why_not(model: PumaModel, T_base_flange: Array, solutions: list[IkSolution], near: Array) -> str:
    x, y, z = (1e3 * T_base_flange[:3, 3]).tolist()
    where = f"flange at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    if not solutions:
        return f"{where}: out of reach of the {model.name} arm; move the object or shorten the probe"
    q = min((s.q for s in solutions), key=lambda q: float(np.max(np.abs(q - near))))
    bad = [
        f"joint {i + 1} would be at {degrees(q[i]):.1f} deg, allowed {degrees(model.q_min[i]):.0f} to "
        f"{degrees(model.q_max[i]):.0f}"
        for i in range(6)
        if not model.q_min[i] - 1e-9 <= q[i] <= model.q_max[i] + 1e-9
    ]
    if not bad:
        move, joint = max((abs(float(q[i] - near[i])), i + 1) for i in range(6))
        bad = [f"joint {joint} would have to move by {degrees(move):.1f} deg"]
    return f"{where}: no branch within the joint limits nearby; nearest branch: " + "; ".join(bad)


def singularities(model: PumaModel, q: npt.ArrayLike, *, tolerance: float = 0.05) -> tuple[str, ...]:
    """Names of the singularities that a posture is close to.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.
        tolerance: dimensionless: sine of the elbow or wrist angle, or reach over upper arm for the shoulder.

    Returns:
        Any of "shoulder" (wrist centre on the axis of joint 1, offset aside), "elbow" (arm stretched or folded),
        "wrist" (axes 4 and 6 in line).
    """
    _, a2, _, a3, d4, _ = model.links
    _, q2, q3, _, q5, _ = np.asarray(q, dtype=float).tolist()
    reach = a2 * cos(q2) + a3 * cos(q2 + q3) - d4 * sin(q2 + q3)
    measures = {"shoulder": reach / a2, "elbow": sin(q3 + atan2(d4, a3)), "wrist": sin(q5)}
    return tuple(name for name, value in measures.items() if abs(value) < tolerance)
