"""Rigid-body dynamics of any arm: mass matrix, Coriolis and centrifugal torques, gravity; computed by MuJoCo.

Equation of motion: ``M(q) q'' + b(q, q') = tau``, all at the joints; b includes gravity. Motors, gears and friction are
not in it (`model`). MuJoCo is in the extra `dynamics` and is imported when a `RigidBody` is made.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from canprobe.errors import PlanError, install_line
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.robot.model import Body, lopsided_inertia
from canprobe.mechanics.types import Floats

GRAVITY_M_S2 = 9.81
"""Acceleration of free fall along base -z, m/s²."""
_PLACEHOLDER_INERTIAL = '<inertial pos="1 2 3" quat="1 2 3 4" mass="1" diaginertia="1 1.1 1.2"/>'
"""A body that MuJoCo's compiler neither refuses nor simplifies; it is replaced by the real one, which it may refuse."""


def dynamics_problem(name: str, bodies: Sequence[Body | None] | None) -> str | None:
    """Why an arm cannot be emulated with its dynamics, and what to do about it; None where it can.

    Args:
        name: name of the arm.
        bodies: (n,) bodies of its joints; None where they are not known.
    """
    lead = 'plant.fidelity = "dynamic"'
    if bodies is None:
        return (
            f"{lead}: the masses of arm {name!r} are not known; give its joints mass_kg, com_mm and inertia_kg_m2 "
            '(in a URDF <inertial>), or set plant.fidelity = "ideal"'
        )
    if importlib.util.find_spec("mujoco") is None:
        return f"{lead} needs the package mujoco: {install_line('dynamics')}"
    return None


def impossible_bodies(joints: Sequence[str], bodies: Sequence[Body | None]) -> list[str]:
    """Why the motion of bodies (n,) of joints cannot be computed: they have moments of inertia that no solid has.

    A moment of 0 on the diagonal stands for an unknown one; such a body is used as it is.
    """
    tensors = {joint: body.tensor for joint, body in zip(joints, bodies, strict=False) if body is not None}
    return [
        f'plant.fidelity = "dynamic": joint {joint} moves a body with {why}, as no solid has; correct its '
        '<inertia> or inertia_kg_m2, or set plant.fidelity = "ideal"'
        for joint, tensor in tensors.items()
        if np.diag(tensor).min() != 0.0 and (why := lopsided_inertia(tensor)) is not None
    ]


def ball(mass: float, radius: float, centre: Floats) -> Body:
    """A homogeneous ball.

    Args:
        mass: mass, kg.
        radius: radius, m.
        centre: (3,) centre, m.
    """
    return Body(mass, centre, 0.4 * mass * radius**2 * np.eye(3))


def joined(a: Body | None, b: Body) -> Body:
    """A body, or None for none, and another one in the same frame, as one body."""
    return b if a is None or a.mass + b.mass == 0.0 else Body.combined((a, b))


class RigidBody:
    """Dynamics of one arm with what it carries.

    Args:
        chain: geometry of the arm.
        bodies: (n,) bodies of its joints; None for a joint without one. Values that no solid could have are used as
            they are, as published tables leave out what does not matter.

    Raises:
        PlanError: the extra `dynamics` is not installed.
    """

    def __init__(self, chain: Chain, bodies: Sequence[Body | None]) -> None:
        problem = dynamics_problem(chain.name, bodies)
        if problem is not None:
            raise PlanError([problem])
        import mujoco  # here, as it is in the extra `dynamics`

        self._mujoco: Any = mujoco
        text = "".join(_opened(mujoco, T, slides) for T, slides in zip(chain.fixed, chain.prismatic, strict=True))
        text = f"<worldbody>{text}{'</body>' * chain.n}</worldbody>"
        made = mujoco.MjModel.from_xml_string(f'<mujoco><option gravity="0 0 {-GRAVITY_M_S2!r}"/>{text}</mujoco>')
        for i, body in enumerate(bodies, start=1):  # 0 is the world
            moments, axes = np.linalg.eigh(np.zeros((3, 3)) if body is None else body.tensor)
            made.body_mass[i] = 0.0 if body is None else body.mass
            made.body_ipos[i] = np.zeros(3) if body is None else body.com
            made.body_inertia[i] = moments
            made.body_iquat[i] = _quaternion(mujoco, axes * np.linalg.det(axes))
        self._model, self._data = made, mujoco.MjData(made)
        mujoco.mj_setConst(made, self._data)
        self._armature = np.eye(chain.n)

    def terms(self, q: npt.ArrayLike, qd: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Mass matrix and bias.

        Args:
            q: (n,) joint positions, rad or m.
            qd: (n,) joint rates, rad/s or m/s.

        Returns:
            M (n, n), kg m^2 (kg m and kg where joints slide), and bias (n,): torques or forces that keep the joint
            rates constant against gravity, Coriolis and centrifugal effects, N m or N.
        """
        made, data, mass = self._model, self._data, np.empty_like(self._armature)
        data.qpos[:], data.qvel[:] = q, qd
        self._mujoco.mj_fwdPosition(made, data)
        self._mujoco.mj_fwdVelocity(made, data)
        self._mujoco.mj_fullM(made, data, mass)
        return mass - self._armature, data.qfrc_bias.copy()


def _opened(mujoco: Any, T: Floats, slides: bool) -> str:
    """A joint's frame with its joint. The armature of 1 keeps MuJoCo's matrix regular where nothing has a mass."""
    pos, quat = (" ".join(map(repr, values.tolist())) for values in (T[:3, 3], _quaternion(mujoco, T[:3, :3])))
    joint = f'<joint type="{"slide" if slides else "hinge"}" axis="0 0 1" armature="1"/>'
    return f'<body pos="{pos}" quat="{quat}">{joint}{_PLACEHOLDER_INERTIAL}'


def _quaternion(mujoco: Any, R: Floats) -> Floats:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(R).ravel())
    return quat
