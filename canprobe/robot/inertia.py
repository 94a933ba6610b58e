"""Masses of the PUMA 260's links. No maker ever published them: they are those of a PUMA 560, scaled by size.

Source: Corke & Armstrong-Helouvry 1994 (PUMA 560, standard Denavit-Hartenberg frames), lengths times 0.4706, masses
times 0.17.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from canprobe.robot.puma260 import Array, PumaModel

GRAVITY_M_S2 = 9.81

_MASS_KG = (0.0, 2.97, 0.82, 0.140, 0.058, 0.015)
_COM_MM = (
    (0.0, 0.0, 0.0),
    (-171.0, 2.8, -107.0),  # z is counted from joint 1's axis: the 560's, mirrored
    (-9.6, 6.6, 33.0),  # y mirrored
    (0.0, 8.9, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 15.0),
)
_INERTIA_KG_MM2 = (
    (0.0, 13180.0, 0.0),
    (4890.0, 19730.0, 20290.0),
    (2480.0, 3240.0, 470.0),
    (68.0, 49.0, 68.0),
    (11.0, 15.0, 11.0),
    (5.6, 5.6, 1.5),
)


@dataclass(frozen=True, slots=True, eq=False)
class LinkInertia:
    """Rigid bodies of the six links, each in its own Denavit-Hartenberg frame.

    Args:
        mass: (6,) kg.
        com: (6, 3) centres of mass, m.
        tensor: (6, 3, 3) inertia about the centres of mass, kg m^2.
    """

    mass: Array
    com: Array
    tensor: Array

    def with_payload(self, mass: float, T_flange_payload: Array, tensor: Array) -> LinkInertia:
        """The same arm with a body fixed to its flange.

        Args:
            mass: kg.
            T_flange_payload: (4, 4) frame in the body's centre of mass, m.
            tensor: (3, 3) inertia about it in that frame, kg m^2.
        """
        total = float(self.mass[5]) + mass
        if total == 0.0:
            return self
        R, at = T_flange_payload[:3, :3], T_flange_payload[:3, 3]
        com = (self.mass[5] * self.com[5] + mass * at) / total
        both = self.tensor[5] + R @ tensor @ R.T
        both = both + _steiner(float(self.mass[5]), self.com[5] - com) + _steiner(mass, at - com)
        return LinkInertia(
            np.append(self.mass[:5], total), np.vstack((self.com[:5], com)), np.concatenate((self.tensor[:5], [both]))
        )


def _steiner(mass: float, offset: Array) -> Array:
    return mass * (float(offset @ offset) * np.eye(3) - np.outer(offset, offset))


def puma260_inertia(model: PumaModel) -> LinkInertia:
    """Links of the bare arm.

    Args:
        model: the geometry; how it splits the shoulder's offset moves the frame of link 2, not the link.
    """
    com = 1e-3 * np.array(_COM_MM)
    com[1, 2] -= float(model.dh[1, 2])
    tensor = np.array([np.diag(row) for row in _INERTIA_KG_MM2]) * 1e-6
    return LinkInertia(np.array(_MASS_KG), com, tensor)


def ball_inertia(mass: float, radius: float) -> Array:
    """(3, 3) tensor of a homogeneous ball about its centre, kg m^2.

    Args:
        mass: kg.
        radius: m.
    """
    return 0.4 * mass * radius**2 * np.eye(3)
