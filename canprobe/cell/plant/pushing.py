"""Contact forces on the arm near one posture: the geometry held, the force law exact.

Near the posture the depth of a touch is taken as linear in the motors and its curvature as constant: over one 2.5 ms
cycle at 25 mm/s the probe moves 0.06 mm, which bends the surface by 0.05 um. The elastic force, its damping and the
friction follow from depth and velocities as in ``probe``. Motor coordinates are in rad, of prismatic joints in m.
"""

from __future__ import annotations

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.elastic_contact import NEAR_M, force_laws
from canprobe.mechanics.robot.chain import ending_in, jacobian, posture
from canprobe.mechanics.robot.model import joints_per_motor
from canprobe.mechanics.touch.shapes import TouchedPlaces
from canprobe.mechanics.types import Floats, Vec

SLIP_M_S = 1e-3
"""Sliding speed over which friction grows to its full size."""


class HeldContact:
    """The object's push on the n motors near a posture, in k places.

    Args:
        config: configuration of the plant, for damping and friction of the contact.
        theta: (n,) posture in motor coordinates.
        depth: (k,) indentations there, m; negative for gaps.
        rows: (3, k, n) velocity of each touched point of the probe per motor rate: along the object's outward normal
            and along two tangents.
        laws: coefficients (k,) and exponents (k,) of ``force = coefficient depth^exponent``, N and m.
    """

    def __init__(
        self, config: PlantConfig, theta: Floats, depth: Floats, rows: Floats, laws: tuple[Floats, Floats]
    ) -> None:
        self.rows, self._flat = rows, rows.reshape(-1, len(theta))
        self._normal, self._s, self._t = rows
        self._offset = depth + self._normal @ theta
        self._coefficient, self._exponent = laws
        self._damping, self._friction = 1.5 * config.damping_s_m, config.dynamics.friction

    def push(self, theta: Floats, rate: Floats) -> Floats | None:
        """(n,) torque (of prismatic joints force) on the motors, N m or N; None where nothing touches.

        Args:
            theta: (n,) motor positions.
            rate: (n,) per second.
        """
        depth = self._offset - self._normal @ theta
        if depth.max() <= 0.0:
            return None
        velocity, _, force, drag, _ = self._moving(depth, rate)
        return self._pushed(velocity, force, drag)

    def linearised(self, theta: Floats, rate: Floats) -> tuple[Floats, Floats, Floats] | None:
        """The push, and the slopes (n, n) of ``-push`` by position and by rate; None where nothing touches.

        What friction owes to the depth is left out.
        """
        depth = self._offset - self._normal @ theta
        if depth.max() <= 0.0:
            return None
        velocity, elastic, force, drag, square = self._moving(depth, rate)
        stiffness = self._exponent * force / np.maximum(depth, 1e-12)
        weights = np.concatenate((self._damping * elastic * (force > 0.0), drag, drag))
        slip = velocity[1, :, None] * self._s + velocity[2, :, None] * self._t
        by_rate = (self._flat.T * weights) @ self._flat - (slip.T * (drag / square)) @ slip
        return self._pushed(velocity, force, drag), (self._normal.T * stiffness) @ self._normal, by_rate

    def _pushed(self, velocity: Floats, force: Floats, drag: Floats) -> Floats:
        loads = velocity * -drag
        loads[0] = force
        return loads.ravel() @ self._flat

    def _moving(self, depth: Floats, rate: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Velocities (3, k); of each place elastic force, damped force, friction per slip, and the slip's square."""
        velocity = (self._flat @ rate).reshape(3, -1)
        elastic = self._coefficient * np.maximum(depth, 0.0) ** self._exponent
        force = elastic * np.maximum(0.0, 1.0 - self._damping * velocity[0])
        square = velocity[1] ** 2 + velocity[2] ** 2 + SLIP_M_S**2
        return velocity, elastic, force, self._friction * force / np.sqrt(square), square


class Neighbourhood:
    """Makes the contact near a posture, for ``ArmEquations``.

    Args:
        config: configuration of a plant with an arm and an object.
    """

    def __init__(self, config: PlantConfig) -> None:
        assert config.model is not None
        assert config.object is not None
        self._config, self._shape = config, config.object
        self._chain = ending_in(config.model.chain, config.T_flange_probe_centre)
        self._joints_per_motor = joints_per_motor(config.model)

    def __call__(self, theta: Floats) -> HeldContact | None:
        """Contact held at a posture of the motors; None where the object is farther than a cycle's way.

        Args:
            theta: (n,) motor coordinates.
        """
        at, radius = posture(self._chain, self._joints_per_motor @ theta), self._config.radius_m
        own = np.array(at.flange)  # in the arm's own base
        centre: Vec = tuple((own + self._config.base_offset_m).tolist())
        foot = self._shape.nearest(centre)
        if foot.distance - radius > NEAR_M:
            return None
        touches = self._shape.touches(centre, radius + NEAR_M)
        if touches is None:
            places = (foot.point,), (foot.normal,), (foot.distance,), (foot.kappa,), (0.0,)
            touches = TouchedPlaces(*map(np.array, places))
        normals = touches.normals
        frames = np.array((normals, *_tangents(normals)))
        # The probe's point that touches lies inside the undeformed ball where it is indented.
        touched = own + np.minimum(touches.distances, radius)[:, None] * -normals
        J = np.array([jacobian(at, tuple(point))[:3] for point in touched.tolist()])
        rows = (frames[:, :, None] @ J)[:, :, 0] @ self._joints_per_motor
        laws = force_laws(touches, radius, self._config.stiffness_n_m3)
        return HeldContact(self._config, theta, radius - touches.distances, rows, laws)


def _tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (k, 3) each at right angles to each normal and to each other.

    Source: Duff et al., Building an Orthonormal Basis, Revisited, JCGT 6, 2017.
    """
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array((1.0 + sign * x * x * a, sign * b, -sign * x)).T, np.array((b, sign + y * y * a, -y)).T
