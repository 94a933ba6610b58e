"""From poses and velocities of the tool to the joints: inverse kinematics in closed form, and steps by the Jacobian.

Two shoulder solutions (the arm reaches forward or over its back), two elbow solutions, two wrist solutions.
The elbow offset a3 and the forearm d4 act as one link of length hypot(a3, d4), turned by atan2(d4, a3).

Source: Paul & Zhang, "Computationally efficient kinematics for manipulators with spherical wrists", IJRR 5(2), 1986.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from math import atan2, ceil, cos, degrees, hypot, inf, pi, sin, sqrt

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from canprobe.errors import PlanError
from canprobe.robot.kinematics import ELBOW_FORM, Array, PumaModel, forward

# Closed-form inverse kinematics: eight branches, angles placed inside the joint ranges, singularities named.

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


# Poses that put a spherical probe on a surface point, and the joint angles for them: start poses of a scene.


def probe_pose(point: npt.ArrayLike, normal: npt.ArrayLike, centre_height_m: float, x_hint: npt.ArrayLike) -> Array:
    """Probe frame above a surface point, pole (z) against the outward normal.

    Args:
        point: (3,) surface point, base frame, m.
        normal: (3,) outward normal of the surface, any length.
        centre_height_m: distance of the probe's centre from the point along the normal, m
            (probe radius + clearance, or radius - depth).
        x_hint: (3,) direction that the frame's x axis follows as far as the pole allows.

    Returns:
        (4, 4) T_base_probe, m.

    Raises:
        ValueError: for a hint parallel to the normal.
    """
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    hint = np.asarray(x_hint, dtype=float)
    x = hint - (hint @ n) * n
    size = float(np.linalg.norm(x))
    if size < 1e-9 * float(np.linalg.norm(hint)) or size == 0.0:
        raise ValueError(f"x_hint {hint.tolist()} is parallel to the normal {n.tolist()}")
    T_base_probe = np.eye(4)
    T_base_probe[:3, 0] = x / size
    T_base_probe[:3, 1] = np.cross(-n, x / size)
    T_base_probe[:3, 2] = -n
    T_base_probe[:3, 3] = np.asarray(point, dtype=float) + centre_height_m * n
    return T_base_probe


def start_posture(
    model: PumaModel,
    point: npt.ArrayLike,
    normal: npt.ArrayLike,
    *,
    radius_m: float,
    T_flange_probe: Array,
    clearance_m: float = 0.0,
    yaw_rad: float | None = None,
    q_near: npt.ArrayLike = ELBOW_FORM,
) -> Array:
    """Joint angles that hold the probe over a surface point, pole against the normal, nearest to a known posture.

    The turn about the normal is free: by default it is what ``q_near`` has (joint 6 moves least); with ``yaw_rad``
    the probe's x axis points at that angle from base x, in the horizontal plane, counted about base z.

    Args:
        model: the arm.
        point: (3,) surface point, base frame, m.
        normal: (3,) outward normal there.
        radius_m: probe radius, m.
        T_flange_probe: (4, 4) probe centre in the flange frame, m.
        clearance_m: gap between probe and surface, m; negative presses.
        yaw_rad: optional heading of the probe's x axis, rad.
        q_near: (6,) rad.

    Returns:
        (6,) joint angles, rad, within the limits.

    Raises:
        PlanError: when no branch reaches the pose within the limits.
    """
    if yaw_rad is None:
        x_hint = (forward(model, q_near) @ T_flange_probe)[:3, 0]
    else:
        x_hint = np.array((math.cos(yaw_rad), math.sin(yaw_rad), 0.0))
    T_base_probe = probe_pose(point, normal, radius_m + clearance_m, x_hint)
    return inverse_near(model, T_base_probe @ np.linalg.inv(T_flange_probe), q_near)


# Damped least-squares inverse of the Jacobian, damped only near singular poses.


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


# Moving the tool with the motors that are left: what the others would have done is shared among them.

WORST_GAIN = 30.0
"""Joint motion per motion of the tool, rad/m, beyond which the motors that are left are badly placed for it."""
_EXACT = 1e-6


def lifting_step(J: Array, joints_per_count: Array, move: Array, free: NDArray[np.bool_]) -> Array | None:
    """Motor steps that move the tool's point, its orientation left open, while some motors stand still.

    Of all steps the one with the least joint motion. The motors' coupling in the wrist is in it: a motor that stands
    still is not a joint that stands still.

    Args:
        J: (3, 6) velocity of the point per joint rate, m/rad, base frame.
        joints_per_count: (6, 6) joint angles of motor counts, rad.
        move: (3,) of the point, m, base frame.
        free: (6,) motors that may turn.

    Returns:
        (6,) counts; None where the free motors cannot make this move, or only by turning far.

    Source: least-norm solution of an underdetermined system (Golub and Van Loan, Matrix Computations, 5.6).
    """
    turns = joints_per_count[:, free]
    scale = 1.0 / np.linalg.norm(turns, axis=0)  # counts of a motor for one rad of joints
    shares, *_ = np.linalg.lstsq(J @ turns * scale, move, rcond=None)
    counts = np.zeros(len(free))
    counts[free] = scale * shares
    dq = joints_per_count @ counts
    size = float(np.linalg.norm(move))
    if np.linalg.norm(J @ dq - move) > _EXACT * size or np.linalg.norm(dq) > WORST_GAIN * size:
        return None
    return counts
