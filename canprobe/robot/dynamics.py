"""Rigid-body dynamics of the arm: mass matrix, Coriolis and centrifugal torques, gravity.

Equation of motion: ``M(q) q'' + b(q, q') = tau``, all at the joints; b holds gravity. Motors, gears and friction are
not in it (``canprobe.robot.actuation``). The work is done for all links at once in arrays: Kane's partial velocities,
one product for the mass matrix and one for the bias.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canprobe.robot.inertia import GRAVITY_M_S2, LinkInertia
from canprobe.robot.puma260 import Array, PumaModel

_CROSS = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_i, _k, _j], _CROSS[_j, _k, _i] = 1.0, -1.0
_CROSS = np.ascontiguousarray(_CROSS.reshape(3, 9))
"""a @ _CROSS, as (3, 3), is the matrix of b -> a x b."""


class Frames(NamedTuple):
    """All Denavit-Hartenberg frames in the base frame.

    Attributes:
        axes: (6, 3, 3) rows x, y, z of frames 1 to 6.
        origins: (7, 3) of frames 0 to 6, m.
        joints: (6, 3) axes of the joints (z of frames 0 to 5).
    """

    axes: Array
    origins: Array
    joints: Array


def link_frames(model: PumaModel, q: npt.ArrayLike) -> Frames:
    """Every frame of the chain, written out for the PUMA pattern.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.
    """
    q1, q2, q3, q4, q5, q6 = np.asarray(q, dtype=float).tolist()
    c1, s1, c2, s2, c23, s23 = cos(q1), sin(q1), cos(q2), sin(q2), cos(q2 + q3), sin(q2 + q3)
    c4, s4, c5, s5, c6, s6 = cos(q4), sin(q4), cos(q5), sin(q5), cos(q6), sin(q6)
    x3, y3, z3 = (c23 * c1, c23 * s1, s23), (-s1, c1, 0.0), (-s23 * c1, -s23 * s1, c23)
    x4, z4 = _turn(c4, x3, s4, y3), _turn(s4, x3, -c4, y3)
    x5, y5, z5 = _turn(c5, x4, s5, z3), (-z4[0], -z4[1], -z4[2]), _turn(-s5, x4, c5, z3)
    x6, y6 = _turn(c6, x5, s6, y5), _turn(-s6, x5, c6, y5)
    z1 = (s1, -c1, 0.0)
    axes = np.array((
        (c1, s1, 0.0), (0.0, 0.0, 1.0), z1,
        (c2 * c1, c2 * s1, s2), (-s2 * c1, -s2 * s1, c2), z1,
        x3, y3, z3, x4, z3, z4, x5, y5, z5, x6, y6, z5,
    )).reshape(6, 3, 3)  # fmt: skip
    joints = np.empty((6, 3))
    joints[0] = 0.0, 0.0, 1.0
    joints[1:] = axes[:5, 2]
    steps = np.empty((7, 3))
    steps[0] = 0.0
    steps[1:] = model.dh[:, :1] * axes[:, 0] + model.dh[:, 2:] * joints
    return Frames(axes, np.cumsum(steps, axis=0), joints)


def _turn(
    c: float, a: tuple[float, float, float], s: float, b: tuple[float, float, float]
) -> tuple[float, float, float]:
    return c * a[0] + s * b[0], c * a[1] + s * b[1], c * a[2] + s * b[2]


class RigidBody:
    """Dynamics of one arm with what it carries.

    Args:
        model: its geometry.
        inertia: its links.
        gravity: acceleration of free fall along base -z, m/s^2.
    """

    def __init__(self, model: PumaModel, inertia: LinkInertia, gravity: float = GRAVITY_M_S2) -> None:
        self.model = model
        self.inertia = inertia
        self._gravity = np.array((0.0, 0.0, gravity))
        self._mass = inertia.mass[:, None, None]
        self._com = inertia.com[:, None, :]
        self._tensor = inertia.tensor
        self._moves = np.tril(np.ones((6, 6)))[:, None, :]  # joint j moves link i only where j <= i

    def terms(self, q: npt.ArrayLike, qd: npt.ArrayLike) -> tuple[Array, Array]:
        """Mass matrix and bias.

        Args:
            q: (6,) rad.
            qd: (6,) rad/s.

        Returns:
            (6, 6) M, kg m^2, and (6,) bias: torque that holds the joint rates constant against gravity, Coriolis and
            centrifugal effects, N m.
        """
        axes, origins, joints = link_frames(self.model, q)
        tensor = axes.transpose(0, 2, 1) @ (self._tensor @ axes)  # of every link, base frame
        steps = np.empty((6, 3, 2))  # from the previous origin to the link's own, from there to its centre of mass
        np.subtract(origins[1:], origins[:6], out=steps[:, :, 0])
        steps[:, :, 1] = (self._com @ axes)[:, 0]
        velocities = np.empty((2, 6, 3, 6))  # of centre i, and rotation of link i, per rate of joint j
        about = (joints @ _CROSS).reshape(6, 3, 3) @ origins[:6, :, None]
        np.matmul((-(origins[1:] + steps[:, :, 1]) @ _CROSS).reshape(6, 3, 3), joints.T, out=velocities[0])
        velocities[0] -= about[:, :, 0].T
        velocities[1] = joints.T
        velocities *= self._moves
        momenta = np.empty((2, 6, 3, 6))
        np.multiply(self._mass, velocities[0], out=momenta[0])
        np.matmul(tensor, velocities[1], out=momenta[1])
        flat = velocities.reshape(36, 6)
        loads = self._loads(joints * np.asarray(qd, dtype=float)[:, None], steps, tensor)
        return flat.T @ momenta.reshape(36, 6), loads @ flat

    def gravity(self, q: npt.ArrayLike) -> Array:
        """(6,) torque that carries the arm's weight at rest, N m.

        Args:
            q: (6,) rad.
        """
        return self.terms(q, np.zeros(6))[1]

    def _loads(self, turning: Array, steps: Array, tensor: Array) -> Array:
        """(36,) force at each centre of mass and torque about it that q'' = 0 takes, base frame."""
        turn = np.empty((6, 3, 2))  # angular velocity and acceleration of each link
        omega = np.cumsum(turning, axis=0)
        spin = (omega @ _CROSS).reshape(6, 3, 3)
        turn[:, :, 0] = omega
        np.cumsum((spin @ turning[:, :, None])[:, :, 0], axis=0, out=turn[:, :, 1])
        field = (turn[:, :, 1] @ _CROSS).reshape(6, 3, 3)
        field += spin @ spin
        moved = field @ steps
        carried = tensor @ turn
        loads = np.empty((2, 6, 3))
        np.cumsum(moved[:, :, 0], axis=0, out=loads[0])
        loads[0] += moved[:, :, 1]
        loads[0] += self._gravity
        loads[0] *= self._mass[:, 0]
        loads[1] = carried[:, :, 1]
        loads[1] += (spin @ carried[:, :, :1])[:, :, 0]
        return loads.reshape(36)
