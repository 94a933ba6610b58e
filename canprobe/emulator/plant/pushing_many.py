"""Push of several touches on the motors, near one posture; ``pushing`` with arrays in the place of floats."""

from __future__ import annotations

import numpy as np

from canprobe.emulator.plant.pushing import SLIP_M_S, Array, Rubbing, Six, Slopes


class ManyTouches:
    """Several places at once.

    Args:
        theta: (6,) posture in motor coordinates, rad.
        depth: (n,) indentations there, m; negative for gaps.
        rows: (n, 3, 6) velocity of each touched point of the probe per motor rate: along the object's outward normal
            and along two tangents, m.
        coefficient, exponent: (n,) of the force laws, N and m.
        rubbing: damping and friction.
    """

    def __init__(
        self, theta: Six, depth: Array, rows: Array, *, coefficient: Array, exponent: Array, rubbing: Rubbing
    ) -> None:
        self._rows = rows
        self._normal = np.ascontiguousarray(rows[:, 0])
        self._offset = depth + self._normal @ np.array(theta)
        self._coefficient, self._exponent = coefficient, exponent
        self._damping, self._friction = 1.5 * rubbing.damping_s_m, rubbing.friction

    def push(self, theta: Six, rate: Six) -> Array | None:
        """See ``pushing.Contact``."""
        depth = self._offset - self._normal @ np.array(theta)
        if depth.max() <= 0.0:
            return None
        velocity = self._rows @ np.array(rate)
        loads = np.empty_like(velocity)
        loads[:, 0] = self._elastic(depth) * np.maximum(0.0, 1.0 - self._damping * velocity[:, 0])
        speed = np.sqrt(np.sum(velocity[:, 1:] ** 2, axis=1) + SLIP_M_S**2)
        loads[:, 1:] = (-self._friction * loads[:, 0] / speed)[:, None] * velocity[:, 1:]
        torque: Array = loads.reshape(-1) @ self._rows.reshape(-1, 6)
        return torque

    def slopes(self, theta: Six, rate: Six) -> Slopes | None:
        """See ``pushing.Contact``."""
        depth = self._offset - self._normal @ np.array(theta)
        if depth.max() <= 0.0:
            return None
        velocity, elastic = self._rows @ np.array(rate), self._elastic(depth)
        factor = np.maximum(0.0, 1.0 - self._damping * velocity[:, 0])
        stiffness = self._exponent * elastic * factor / np.maximum(depth, 1e-12)
        slip = velocity[:, 1:]
        square = np.sum(slip * slip, axis=1) + SLIP_M_S**2
        drag = self._friction * elastic * factor / np.sqrt(square)
        by_rate = np.zeros((len(depth), 3, 3))
        by_rate[:, 0, 0] = self._damping * elastic * (factor > 0.0)
        by_rate[:, 1:, 1:] = np.eye(2) - slip[:, :, None] * slip[:, None, :] / square[:, None, None]
        by_rate[:, 1:, 1:] *= drag[:, None, None]
        turned = self._rows.transpose(0, 2, 1)
        pushed = (turned[:, :, :1] * stiffness[:, None, None] @ self._rows[:, :1]).sum(axis=0)
        return Slopes(np.eye(6), pushed, (turned @ by_rate @ self._rows).sum(axis=0))

    def _elastic(self, depth: Array) -> Array:
        force: Array = self._coefficient * np.maximum(depth, 0.0) ** self._exponent
        return force
