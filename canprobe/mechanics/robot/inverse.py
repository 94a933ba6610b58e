"""From poses and velocities of the tool to the joints of any arm, numerically.

A tool's pose has six rows, in this order: position (3), direction of the pole, the tool's z axis (2), and turn about
the pole (1). Six or more joints hold all six; more than six also stay near a posture. Five joints hold position and
pole, unless the last of them only rolls about the pole. Fewer hold the position, and the pole is what follows from it.
`task_rows` gives the number for a model, `in_rows` takes those rows out of a Jacobian or a twist; tasks and planning
use both.

`inverse_near` finds the joints for a pose, starting from a known posture and within the joint limits
(Levenberg-Marquardt). It stays on the branch of that posture, as an arm that moves there does. Why not a closed form:
that exists only for some arms, and would have to be told which of its branches the arm is on.

For a velocity one step of the inverse Jacobian is enough: `damped_step` near singular poses, `lifting_step` with some
drives at rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, degrees, inf, pi

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats

ERROR_LENGTH_M = 0.2
"""Length by which linear rows are divided to compare with angular ones, m: about the length of a link."""
_ROLL_COSINE = 0.999
"""Cosine of the angle between the axis of the last joint and the pole from which that joint only rolls: 2.6°."""
MAX_GAIN = 30.0
"""Largest joint motion per motion of the tool, rad/m; with more the remaining drives are badly placed for it."""
_MAX_ERROR_SHARE = 1e-6
_MAX_STEP_DAMPING, _DAMPING_THRESHOLD = 0.05, 0.08
"""Largest damping, and the singular value below which it starts; linear rows are divided by `ERROR_LENGTH_M`."""
FULL_POSE, FIXED_POLE = 6, 3
"""Rows of an arm that holds a whole pose, and of one that holds the position alone."""


def task_rows(model: ArmModel) -> int:
    """Number of rows of a tool's pose that an arm can hold, by its number of joints.

    It stops being true where the geometry wastes a joint in another way than by `rolls_last`. Such poses are out of
    reach of `inverse_near`, and `damped_step` is damped as near singular poses.

    Args:
        model: the arm.

    Returns:
        6 for six joints or more (position, pole and the turn about it), 5 for five (position and pole), 3 for fewer,
        and for five of which the last one only rolls (position).
    """
    return 6 if model.n >= 6 else 5 if model.n == 5 and not rolls_last(model) else 3


def rolls_last(model: ArmModel) -> bool:
    """Whether the last joint turns about the flange's z axis, the pole of a probe, which it then cannot tilt."""
    return not model.joints[-1].prismatic and abs(float(model.chain.T_last_flange[2, 2])) > _ROLL_COSINE


def in_rows(rows: int, R_base_tool: Floats, six: Floats) -> Floats:
    """The rows that an arm can hold, of a Jacobian (6, n) or a twist (6,).

    Args:
        rows: number of rows, of `task_rows`.
        R_base_tool: (3, 3) axes of the tool; turns about its x and y are those of the pole.
        six: (6, n) or (6,) linear rows, then angular ones, base frame.

    Returns:
        (rows, n) or (rows,): linear rows in the base frame, then angular ones; with five rows these are in the frame of
        the tool.
    """
    if rows == 5:
        return np.concatenate((six[:3], R_base_tool[:, :2].T @ six[3:]))
    return six[:rows]


_ROUNDING_ERROR = 1e-9
"""Largest error of a pose that is rounding, rad, or m over `ERROR_LENGTH_M`."""
_MAX_STEPS = 200
_MAX_STEP_RAD = 0.3
"""Largest step of a joint, rad: farther off the Jacobian is no longer that of the start."""
_MIN_DAMPING, _MAX_DAMPING = 1e-12, 1e8


def inverse_near(
    model: ArmModel,
    T_base_tool: Floats,
    T_flange_tool: Floats,
    q_near: npt.ArrayLike,
    *,
    max_move_rad: float = inf,
    q_rest: npt.ArrayLike | None = None,
) -> Floats:
    """Joints within their limits that hold a tool at a pose, on the branch of a known posture.

    Args:
        model: the arm; `task_rows` gives the rows of the pose that it can hold.
        T_base_tool: (4, 4) pose of the tool, m.
        T_flange_tool: (4, 4) tool in the flange frame, m.
        q_near: (n,) known posture, rad or m.
        max_move_rad: largest distance of a joint from `q_near`, rad; for a prismatic one see `ArmModel.radian`.
        q_rest: (n,) posture near which more than six joints stay, rad or m; `q_near` by default.

    Returns:
        (n,) joint positions, rad or m.

    Raises:
        PlanError: the pose is out of reach from there (the message has the nearest), or a joint would move too far.

    Source: Nocedal & Wright, Numerical Optimization, 10.3 (Levenberg-Marquardt), 16.7 (projected to bounds).
    """
    near = np.asarray(q_near, dtype=float)
    pose = _PosedTool(model, np.asarray(T_base_tool, dtype=float), np.asarray(T_flange_tool, dtype=float))
    q, left = _reach(pose, near)
    if pose.rows < model.n:
        q, left = _rest(pose, q, left, near if q_rest is None else np.asarray(q_rest, dtype=float))
    if float(np.linalg.norm(left)) > _ROUNDING_ERROR:
        raise PlanError([_out_of_reach(pose, q)])
    moves = np.abs(q - near) / model.radian
    if float(moves.max()) > max_move_rad:
        i = int(np.argmax(moves))
        joint = model.joints[i]
        raise PlanError(
            [
                f"{_place(T_base_tool)}: not near the posture before: joint {i + 1} would have to move by "
                f"{joint.text(abs(float(q[i] - near[i])))}"
            ]
        )
    return q


@dataclass(frozen=True, slots=True, eq=False)
class _PosedTool:
    """A pose that an arm shall reach."""

    model: ArmModel
    T_base_tool: Floats
    T_flange_tool: Floats

    @property
    def rows(self) -> int:
        return task_rows(self.model)

    def error(self, q: Floats) -> tuple[Floats, Floats]:
        """Error of the pose (rows,) and its Jacobian (rows, n), in rad: lengths are divided by `ERROR_LENGTH_M`.

        The Jacobian is per radian of a joint, see `ArmModel.radian`.
        """
        T, J = forward_jacobian(self.model.chain, q, self.T_flange_tool)
        R, aim, rows = T[:3, :3], self.T_base_tool, self.rows
        turn = _turn(R, aim[:3, :3]) if rows == 6 else _turn_of_pole(R, aim[:3, 2])
        left = np.concatenate(((aim[:3, 3] - T[:3, 3]) / ERROR_LENGTH_M, turn))
        J[:3] /= ERROR_LENGTH_M
        return in_rows(rows, R, left), in_rows(rows, R, J) * self.model.radian


def _turn(R: Floats, R_aim: Floats) -> Floats:
    """(3,) rotation vector from one orientation to another, base frame."""
    E = R_aim @ R.T
    axis = 0.5 * np.array((E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]))
    column = (E + np.eye(3))[:, int(np.argmax(np.diag(E)))]  # half a turn: any sign of its axis
    return _rotation_vector(axis, 0.5 * (float(np.trace(E)) - 1.0), column / np.linalg.norm(column))


def _turn_of_pole(R: Floats, pole: Floats) -> Floats:
    """(3,) shortest rotation vector that brings z to a direction, base frame."""
    return _rotation_vector(np.cross(R[:, 2], pole), float(R[:, 2] @ pole), R[:, 0])


def _rotation_vector(axis: Floats, cosine: float, half: Floats) -> Floats:
    """(3,) rotation vector by its axis times the sine, the cosine, and the unit axis of half a turn."""
    sine = float(np.linalg.norm(axis))
    if sine > 1e-8:
        return np.array(axis * (atan2(sine, cosine) / sine))
    return axis if cosine > 0.0 else np.array(pi * half)


def _reach(pose: _PosedTool, near: Floats) -> tuple[Floats, Floats]:
    """The joints with the least error of a pose, and that error: Levenberg-Marquardt, joints held at stops."""
    model = pose.model
    q = np.clip(near, model.q_min, model.q_max)
    left, J = pose.error(q)
    damping = 1e-3
    for _ in range(_MAX_STEPS):
        cost = float(left @ left)
        uphill = J.T @ left
        free = ~(((q <= model.q_min) & (uphill < 0.0)) | ((q >= model.q_max) & (uphill > 0.0)))
        if (
            cost < 1e-3 * _ROUNDING_ERROR**2
            or not np.abs(uphill[free]).max(initial=0.0) > 1e-14
            or damping > _MAX_DAMPING
        ):
            break
        tried = np.clip(q + _step(J, left, free, damping) * model.radian, model.q_min, model.q_max)
        new_left, new_J = pose.error(tried)
        if float(new_left @ new_left) < cost:
            q, left, J, damping = tried, new_left, new_J, max(damping * 0.1, _MIN_DAMPING)
        else:
            damping = max(10.0 * damping, 1e-6)
    return q, left


def _step(J: Floats, left: Floats, free: NDArray[np.bool_], damping: float, wish: Floats | float = 0.0) -> Floats:
    """The damped step of the free joints that is nearest to a wish, of at most `_MAX_STEP_RAD`, rad."""
    A, step = J[:, free], np.where(free, wish, 0.0)
    step[free] += A.T @ np.linalg.solve(A @ A.T + damping * np.eye(len(left)), left - A @ step[free])
    step /= max(1.0, float(np.abs(step).max()) / _MAX_STEP_RAD)
    return step


def _rest(pose: _PosedTool, reached: Floats, error: Floats, rest: Floats) -> tuple[Floats, Floats]:
    """Of the joints that hold a pose, those nearest to a posture `rest`, and their error.

    Newton steps go towards the pose, and along the null space towards the posture. Where they do not settle, the answer
    is `reached` with its error.
    """
    model, q = pose.model, reached
    for _ in range(_MAX_STEPS):
        left, J = pose.error(q)
        wish = (rest - q) / model.radian
        free = ~(((q <= model.q_min) & (wish < 0.0)) | ((q >= model.q_max) & (wish > 0.0)))
        moved = np.clip(q + _step(J, left, free, 1e-12, wish) * model.radian, model.q_min, model.q_max)
        settled, q = float(np.abs(moved - q).max()) < _ROUNDING_ERROR, moved
        if settled:
            break
    back, left = _reach(pose, q)
    return (back, left) if float(np.linalg.norm(left)) <= _ROUNDING_ERROR else (reached, error)


def _out_of_reach(pose: _PosedTool, q: Floats) -> str:
    """The message for a pose out of reach: the nearest pose, and the joints at their stops there."""
    model, T = pose.model, forward(pose.model.chain, q) @ pose.T_flange_tool
    away = 1e3 * float(np.linalg.norm(T[:3, 3] - pose.T_base_tool[:3, 3]))
    turned = degrees(float(np.linalg.norm(pose.error(q)[0][3:])))
    stops = [
        f"joint {i + 1} at its stop, {joint.text(float(value))}"
        for i, (joint, value) in enumerate(zip(model.joints, q, strict=True))
        if not joint.q_min + 1e-9 < value < joint.q_max - 1e-9
    ]
    nearest = f"nearest reachable: {_place(T)}, {away:.1f} mm and {turned:.1f} deg away"
    because = f" with {', '.join(stops)}" if stops else ""
    return f"{_place(pose.T_base_tool)}: out of reach of the {model.name} arm; {nearest}{because}"


def _place(T_base_tool: Floats) -> str:
    x, y, z = (1e3 * T_base_tool[:3, 3]).tolist()
    return f"tool at ({x:.1f}, {y:.1f}, {z:.1f}) mm"


def lifting_step(model: ArmModel, J: Floats, move: Floats, free: NDArray[np.bool_]) -> Floats | None:
    """Drive steps that move the tool's point, with free orientation, while some drives stand still.

    Of all such steps it is the one with the least joint motion. Couplings between joints are included: where a drive
    stands still its joint may move.

    Args:
        model: the arm.
        J: (3, n) velocity of the point per joint rate, base frame.
        move: (3,) displacement of the point, m, base frame.
        free: (n,) whether each drive may move.

    Returns:
        (n,) steps in drive units; None where the free drives cannot make this move within `MAX_GAIN`.

    Source: least-norm solution of an underdetermined system (Golub and Van Loan, Matrix Computations, 5.6).
    """
    turns = (model.q_per_unit / model.radian[:, None])[:, free]
    scale = 1.0 / np.linalg.norm(turns, axis=0)  # units of a drive for one rad of joints
    shares, *_ = np.linalg.lstsq(J @ model.q_per_unit[:, free] * scale, move, rcond=None)
    units = np.zeros(len(free))
    units[free] = scale * shares
    dq = model.q_per_unit @ units
    size = float(np.linalg.norm(move))
    if np.linalg.norm(J @ dq - move) > _MAX_ERROR_SHARE * size or np.linalg.norm(dq / model.radian) > MAX_GAIN * size:
        return None
    return units


def damped_step(J: Floats, twist: Floats, wish: Floats | None = None) -> Floats:
    """Joint rates for a tool twist.

    Away from singular poses this is the exact inverse, of least norm where there are more joints than rows. Where the
    smallest singular value s falls below the threshold, the squared damping rises as 0.05^2 (1 - (s / 0.08)^2), equally
    in all directions, so that rates stay bounded and continuous. Why not always damped: the tool would lag at every
    pose.

    Args:
        J: (m, n) rows of the geometric Jacobian that the arm can hold, linear rows first, see `task_rows`.
        twist: (m,) twist, linear rows in m/s, then angular ones in rad/s; or a displacement, as the map is linear.
        wish: (n,) wanted joint rates; only their part in the null space, which does not move the tool, is used.

    Returns:
        (n,) joint rates, rad/s or m/s.

    Source: Nakamura & Hanafusa 1986; Maciejewski & Klein 1988 (variable damping factor); Liegeois 1977 (null space).
    """
    rows, joints = J.shape
    scale = np.array((1 / ERROR_LENGTH_M,) * 3 + (1.0,) * (rows - 3))
    scaled, aim = J * scale[:, None], scale * twist
    regular = _regular_step(scaled, aim) if rows == joints else None
    if regular is not None:
        return regular
    U, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    ratio = float(s[-1]) / _DAMPING_THRESHOLD
    lambda2 = _MAX_STEP_DAMPING**2 * (1.0 - ratio**2) if ratio < 1.0 else 0.0
    step: Floats = Vt.T @ ((U.T @ aim) * (s / (s * s + lambda2)))
    return step if wish is None else step + wish - Vt.T @ (Vt @ wish)


def _regular_step(J: Floats, twist: Floats) -> Floats | None:
    """The exact step where a cheap test rules out damping (1/‖J⁻¹‖ is below every singular value); else None."""
    try:
        inverse = np.linalg.inv(J)
    except np.linalg.LinAlgError:
        return None
    if float(np.vdot(inverse, inverse)) * _DAMPING_THRESHOLD**2 >= 1.0:
        return None
    return inverse @ twist
