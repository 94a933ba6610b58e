"""The model of an arm that its controller has: chain, limits of its joints, and the units of its drives.

Each drive counts in units such as encoder counts or 1/1000 of a degree. Gears, signs and couplings between the joints
are one matrix, the drives' zeros one vector: `units = units_per_q @ q + zero_units`.

A motor coordinate is the position of a drive divided by its units per own joint; without coupling it is the position of
the joint. Rotor inertia, friction and drive torque act there, one motor each; rigid bodies move at the joints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import Chain, forward_jacobian
from canprobe.mechanics.types import Floats

SPEED_UP_S = 0.5
"""Time in which a joint reaches its speed limit, s, where no acceleration is known."""
METRES_PER_RADIAN = 0.2
"""Travel of a prismatic joint that counts as much as a radian of a revolute one, m: about the length of a link."""


@dataclass(frozen=True, slots=True)
class Joint:
    """Limits and drive of one joint. Units are rad, N m and kg m^2; m, N and kg for a prismatic joint.

    Attributes:
        name: name of the joint, as in the chain.
        prismatic: whether the joint slides; otherwise it turns.
        q_min, q_max: positions of its stops.
        qd_max: speed limit, per second.
        rated_torque: continuous torque of its drive, at the joint.
        rotor_inertia: inertia of its motor's rotor, at the joint; only emulation uses it, and friction.
        coulomb: friction torque that does not depend on the speed.
        viscous: friction torque per speed.
        qdd_max: acceleration limit, per second²; by default that which reaches the speed limit in `SPEED_UP_S`.

    The defaults of drive and friction are assumptions: a geared motor of a small arm.
    """

    name: str
    prismatic: bool
    q_min: float
    q_max: float
    qd_max: float
    rated_torque: float = 10.0
    rotor_inertia: float = 0.05
    coulomb: float = 0.5
    viscous: float = 0.3
    qdd_max: float | None = None

    @property
    def unit(self) -> str:
        """Unit for people: deg or mm."""
        return "mm" if self.prismatic else "deg"

    def shown(self, q: float) -> float:
        """A position or speed in the unit for people.

        Args:
            q: position, rad or m, or speed, per second.
        """
        return 1e3 * q if self.prismatic else math.degrees(q)

    def text(self, q: float, places: str = ".1f") -> str:
        """A position with its unit, for people.

        Args:
            q: position, rad or m.
            places: format of the number.
        """
        return f"{self.shown(q):{places}} {self.unit}"


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Everything that a joint carries up to the next joint, as one rigid body in the frame of the joint.

    Attributes:
        mass: mass, kg.
        com: (3,) centre of mass, m.
        tensor: (3, 3) inertia about the centre of mass, kg m^2.
    """

    mass: float
    com: Floats
    tensor: Floats

    @classmethod
    def combined(cls, parts: Sequence[Body]) -> Body:
        """Several bodies in one frame, of a positive mass together, as one body.

        Source: parallel axis theorem (Steiner).
        """
        mass = sum(part.mass for part in parts)
        com = np.sum([part.mass * part.com for part in parts], axis=0) / mass
        tensor = np.zeros((3, 3))
        for part in parts:
            off = part.com - com
            tensor += part.tensor + part.mass * (float(off @ off) * np.eye(3) - np.outer(off, off))
        return cls(mass, com, tensor)

    def moved(self, T: Floats) -> Body:
        """The same body in another frame.

        Args:
            T: (4, 4) transform from this frame to the other one, m.
        """
        R = T[:3, :3]
        return Body(self.mass, R @ self.com + T[:3, 3], R @ self.tensor @ R.T)


INERTIA_TOLERANCE = 0.1
"""Share of the largest principal moment by which moments may break the rules of a rigid body: published values are
measured."""
ROUNDING_KG_M2 = 1e-12
"""Largest moment of inertia that is rounding error, kg m^2."""


def negative_inertia(tensor: Floats) -> str | None:
    """Why dynamics cannot be computed from a (3, 3) tensor, as a principal moment is negative; None where none is."""
    low, _, high = np.linalg.eigvalsh(tensor).tolist()
    if low >= -max(INERTIA_TOLERANCE * high, ROUNDING_KG_M2):
        return None
    return f"{_principal_moments(tensor)}, of which one is negative"


def lopsided_inertia(tensor: Floats) -> str | None:
    """Why no body has the inertia (3, 3): one principal moment exceeds the sum of the others; None where none does."""
    low, middle, high = np.linalg.eigvalsh(tensor).tolist()
    if low + middle >= high * (1.0 - INERTIA_TOLERANCE) - ROUNDING_KG_M2:
        return None
    return f"{_principal_moments(tensor)}, of which one is larger than the sum of the others"


def _principal_moments(tensor: Floats) -> str:
    return f"principal moments of inertia of {', '.join(f'{one:.4g}' for one in np.linalg.eigvalsh(tensor))} kg m^2"


@dataclass(frozen=True, slots=True, eq=False)
class ArmModel:
    """Geometry, joints and drive units of one arm; compared by identity.

    Args:
        chain: the geometry.
        joints: the n joints of the chain, from the base.
        units_per_q: (n, n) drive units per rad or m of each joint: gear, sign and coupling. A drive's own joint is on
            the diagonal.
        zero_units: (n,) drive units at q = 0.

    Attributes:
        q_min, q_max, qd_max, qdd_max: (n,) stops, speed and acceleration limits of the joints, rad or m, per s and s².
        q_per_unit: (n, n) inverse of `units_per_q`.
        radian: (n,) motion of each joint that counts as a radian: 1 rad, or `METRES_PER_RADIAN` of a prismatic one.

    Raises:
        PlanError: the joints are not those of the chain, stops or speeds leave no motion, or the units cannot be
            computed from the joints and back.
    """

    chain: Chain
    joints: tuple[Joint, ...]
    units_per_q: Floats
    zero_units: Floats
    q_min: Floats = field(init=False)
    q_max: Floats = field(init=False)
    qd_max: Floats = field(init=False)
    qdd_max: Floats = field(init=False)
    q_per_unit: Floats = field(init=False)
    radian: Floats = field(init=False)

    def __post_init__(self) -> None:
        units, zero = np.array(self.units_per_q, dtype=float), np.array(self.zero_units, dtype=float)
        problems = self._problems(units, zero)
        if problems:
            raise PlanError([f"arm {self.chain.name!r}: {problem}" for problem in problems])
        arrays = {
            "units_per_q": units,
            "zero_units": zero,
            "q_per_unit": np.linalg.inv(units),
            "radian": np.where([joint.prismatic for joint in self.joints], METRES_PER_RADIAN, 1.0),
        }
        arrays["qdd_max"] = np.array([joint.qdd_max or joint.qd_max / SPEED_UP_S for joint in self.joints])
        for name in ("q_min", "q_max", "qd_max"):
            arrays[name] = np.array([getattr(joint, name) for joint in self.joints])
        for name, array in arrays.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def name(self) -> str:
        """Name of the chain."""
        return self.chain.name

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def _problems(self, units: Floats, zero: Floats) -> list[str]:
        n = self.chain.n
        names = [(joint.name, joint.prismatic) for joint in self.joints]
        if names != list(zip(self.chain.joints, self.chain.prismatic, strict=True)):
            return [f"expected the joints {', '.join(self.chain.joints)}, got {', '.join(name for name, _ in names)}"]
        if units.shape != (n, n) or zero.shape != (n,):
            return [f"expected units_per_q ({n}, {n}) and zero_units ({n},), got {units.shape} and {zero.shape}"]
        problems = []
        for joint, row in zip(self.joints, units.tolist(), strict=True):
            if not joint.q_min < joint.q_max:
                problems.append(f"{joint.name}: expected q_min below q_max, got {joint.q_min:g} and {joint.q_max:g}")
            if not joint.qd_max > 0.0:
                problems.append(f"{joint.name}: expected a speed limit above 0, got {joint.qd_max:g}; give it one")
            if row[self.joints.index(joint)] == 0.0:
                problems.append(f"{joint.name}: its drive does not move it (0 in units_per_q); give it its gear")
        if not problems and not np.linalg.cond(units / np.abs(units).max(axis=1)[:, None]) < 1e6:
            problems.append("units_per_q cannot be inverted: two drives move the same joints alike")
        return problems


def joints_to_units(model: ArmModel, q: npt.ArrayLike) -> Floats:
    """Drive positions of joint positions.

    Args:
        model: the arm.
        q: (n,) joint positions, rad or m.

    Returns:
        (n,) drive positions in drive units, not rounded.
    """
    units: Floats = model.units_per_q.dot(np.asarray(q, dtype=float)) + model.zero_units
    return units


def units_to_joints(model: ArmModel, units: npt.ArrayLike) -> Floats:
    """Joint positions of drive positions, the inverse of `joints_to_units`.

    Args:
        model: the arm.
        units: (n,) drive positions in drive units.

    Returns:
        (n,) joint positions, rad or m.
    """
    q: Floats = model.q_per_unit.dot(np.asarray(units, dtype=float) - model.zero_units)
    return q


def coupled_joints(model: ArmModel, axis: int) -> frozenset[int]:
    """Indices, from 0, of the other joints on which a drive's position depends, directly or through their drives."""
    found: set[int] = set()
    new = {axis}
    while new:
        found |= new
        new = {int(k) for i in new for k in np.flatnonzero(model.units_per_q[i])} - found
    return frozenset(found - {axis})


def drive_position_at(model: ArmModel, axis: int, q: float, units: npt.ArrayLike) -> float:
    """Position of one drive, drive units, where its joint is at `q` and the other drives stand still.

    Args:
        model: the arm.
        axis: index of the drive, from 0.
        q: position of its joint, rad or m.
        units: (n,) positions of the drives; those of `axis` and of drives that it is not coupled to have no effect.
    """
    rows, right = model.units_per_q.copy(), np.asarray(units, dtype=float) - model.zero_units
    rows[axis], right[axis] = np.eye(model.n)[axis], q
    return float(model.units_per_q[axis] @ np.linalg.solve(rows, right) + model.zero_units[axis])


def units_per_motor(model: ArmModel) -> Floats:
    """(n,) drive units per motor coordinate, negative where a drive counts backwards.

    Args:
        model: the arm.
    """
    return np.diag(model.units_per_q).copy()


def joints_per_motor(model: ArmModel) -> Floats:
    """(n, n) joint positions per motor coordinate.

    Args:
        model: the arm.
    """
    return np.array(model.q_per_unit * units_per_motor(model), dtype=np.float64)


def position_sigma(model: ArmModel, q: npt.ArrayLike, T_flange_tool: Floats, direction: npt.ArrayLike) -> float:
    """Standard deviation of the tool's position along a direction, m, by the rounding of drives to whole units.

    Args:
        model: the arm.
        q: (n,) joint positions, rad or m.
        T_flange_tool: (4, 4) tool in the flange frame, m.
        direction: (3,) unit vector, base frame.

    Source: a rounding error is uniform over one unit, of variance 1/12, and independent from drive to drive.
    """
    return float(np.linalg.norm(position_per_unit(model, q, T_flange_tool, direction))) / math.sqrt(12.0)


def position_per_unit(model: ArmModel, q: npt.ArrayLike, T_flange_tool: Floats, direction: npt.ArrayLike) -> Floats:
    """(n,) motion of the tool along a direction by one unit of each drive, m; arguments as for `position_sigma`."""
    _, J = forward_jacobian(model.chain, q, T_flange_tool)
    return np.asarray(direction, dtype=float) @ J[:3] @ model.q_per_unit
