"""The contact of a plant in one state: where the probe's ball is, what it touches there, and what presses on it."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, inf, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.elastic_contact import (
    MIN_CURVATURE_SHARE,
    NO_CONTACT,
    Indentation,
    depth_for_force,
    elastic_contact,
    total_force,
)
from canprobe.cell.plant.pressure import Vec, pad_basis, pad_coordinates
from canprobe.cell.scene.setup import Carrier
from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import Chain, ending_in, jacobian, point_velocity, posture
from canprobe.mechanics.robot.model import joints_per_motor, units_to_joints
from canprobe.mechanics.touch.shapes import Nearest, PlacedShape, TouchedPlaces
from canprobe.mechanics.types import Floats

Axes = tuple[Vec, Vec, Vec]


@dataclass(slots=True, eq=False)
class ProbeState:
    """Probe sphere now: centre, axes (columns x, y, z = pole) and velocity of the centre, in base or on the carrier."""

    centre: Vec
    axes: Axes
    velocity: Vec


PRESS_GAP = 1e-3
"""Distance of the probe from the object before the press begins, m."""


class PressedProbe:
    """Probe without an arm, pole against the object's normal at its origin.

    Args:
        config: configuration of a plant with an object.

    Raises:
        PlanError: the object has a hollow as tight as the probe, which could not reach its reference point.
    """

    def __init__(self, config: PlantConfig) -> None:
        assert config.object is not None
        tightest = config.object.tightest_concave_radius()
        if tightest <= config.radius_m:
            raise PlanError(
                [
                    f"the object has a hollow of radius {1e3 * tightest:.1f} mm, the probe's radius is "
                    f"{1e3 * config.radius_m:.1f} mm: it cannot touch there in one point; take a smaller probe"
                ]
            )
        pose = config.object.T_base_object
        x, n = pose[:3, 0], pose[:3, 2]
        self._origin, self._normal = pose[:3, 3], n
        self._axes = (tuple(x.tolist()), tuple(np.cross(-n, x).tolist()), tuple((-n).tolist()))
        c = config.object.closest(self._origin)
        self._mean = depth_for_force(
            config.press.force_n, (float(c.kappa[0]), float(c.kappa[1])), config.radius_m, config.stiffness_n_m3
        )
        self._radius, self._press = config.radius_m, config.press

    def at(self, t_s: float, first_s: float | None) -> ProbeState:
        """State of the probe at a time.

        Args:
            t_s: time, s.
            first_s: time of the first image, s; None before it.
        """
        waits = self._press.after_s
        if waits and (first_s is None or t_s < first_s + waits):
            centre = self._origin + (self._radius + PRESS_GAP) * self._normal
            return ProbeState(tuple(centre.tolist()), self._axes, (0.0, 0.0, 0.0))
        rate = 2 * pi * self._press.frequency_hz
        depth = self._mean * (1.0 + self._press.swing * sin(rate * t_s))
        speed = -self._mean * self._press.swing * rate * cos(rate * t_s)
        centre, velocity = self._origin + (self._radius - depth) * self._normal, speed * self._normal
        return ProbeState(tuple(centre.tolist()), self._axes, tuple(velocity.tolist()))


def _seen_from(T_base_carrier: Floats, carrier: Carrier, probe: ProbeState) -> ProbeState:
    """The probe in the frame of a carrier, with its velocity over the carrier."""
    R, origin = T_base_carrier[:3, :3], T_base_carrier[:3, 3]
    turn, centre = carrier.motion.twist(carrier.speed), np.array(probe.centre)
    velocity = np.array(probe.velocity) - turn[3:] - np.cross(turn[:3], centre)
    centre, velocity, *axes = ((vector @ R).tolist() for vector in (centre - origin, velocity, *np.array(probe.axes)))
    return ProbeState(tuple(centre), tuple(map(tuple, axes)), tuple(velocity))  # type: ignore[arg-type]


_POLE = (0.0, 0.0, 1.0)
_ORIGIN = (0.0, 0.0, 0.0)
_NOWHERE = Nearest(_ORIGIN, _ORIGIN, 0.0, (0.0, 0.0), (_ORIGIN, _ORIGIN))

TruthRow = dict[str, float | tuple[float, ...]]
"""True values of an instant in plain numbers, by name; see `Plant.truth`."""


class PlantState(NamedTuple):
    """All that the truth of an instant follows from.

    Attributes:
        t_ns: the instant, in the plant's own time.
        counts, rates: positions (counts) and rates (counts/s) of the motors; empty without an arm.
    """

    t_ns: int
    counts: tuple[float, ...]
    rates: tuple[float, ...]


@dataclass(slots=True, eq=False)
class SolvedContact:
    """The contact at one instant."""

    q: tuple[float, ...]
    probe: ProbeState
    foot: Nearest
    depth: float
    depth_rate: float
    contact: Indentation
    pad_uv: tuple[float, float]
    direction: Vec  # of the contact from the probe's centre, pad frame
    push: Vec  # of the object on the probe's centre, N, base frame
    torques: list[float] | None = None  # on the motors by the push, once somebody has asked for them
    several: bool = False  # it touches in several places or all over, and these are of the deepest

    @property
    def directions_pad(self) -> Floats:
        """(2, 2) rows: principal directions in the transported pad basis at the contact direction."""
        basis = np.array(pad_basis(self.direction)) @ np.array(self.probe.axes)
        directions: Floats = np.array(self.foot.directions) @ basis.T
        return directions

    @property
    def truth(self) -> TruthRow:
        """The values of `Plant.truth` in plain numbers."""
        return {
            "q": self.q,
            "probe_centre": self.probe.centre,
            "pole": self.probe.axes[2],
            "force": self.contact.force,
            "depth": self.depth,
            "depth_rate": self.depth_rate,
            "contact_point": self.foot.point,
            "contact_normal": self.foot.normal,
            "kappa": self.foot.kappa,
            "direction1": self.foot.directions[0],
            "direction2": self.foot.directions[1],
            "pad_uv": self.pad_uv,
            "in_contact": self.depth > 0.0,
        }


class ContactSolver:
    """Finds the contact of a plant in a state.

    Args:
        config: configuration of the plant.

    Raises:
        PlanError: see `PressedProbe`.
    """

    def __init__(self, config: PlantConfig) -> None:
        model, self._config = config.model, config
        self._tightest = -inf if config.object is None else (MIN_CURVATURE_SHARE - 1.0) / config.radius_m
        self._base: Vec = tuple(config.base_offset_m.tolist())
        self._chain: Chain | None = None
        self._pressed = PressedProbe(config) if model is None and config.object is not None else None
        if model is not None:
            self._chain = ending_in(model.chain, config.T_flange_probe_centre)
            self._joints_per_motor, self._unpushed = joints_per_motor(model), [0.0] * model.n

    def solve(self, state: PlantState, first_image_s: float | None) -> SolvedContact:
        """The contact in a state.

        Args:
            state: state of the plant.
            first_image_s: time of the first image, s; None before it.
        """
        config, model = self._config, self._config.model
        q: tuple[float, ...] = ()
        qd: tuple[float, ...] = ()
        if model is not None:
            q, qd = (
                tuple(units_to_joints(model, state.counts).tolist()),
                tuple(model.q_per_unit.dot(state.rates).tolist()),
            )
        probe = self._probe(q, qd) if self._pressed is None else self._pressed.at(1e-9 * state.t_ns, first_image_s)
        if config.carrier is not None:
            T = config.carrier.motion.T_base_carrier(1e-9 * state.t_ns * config.carrier.speed)
            probe = _seen_from(T, config.carrier, probe)
        if config.object is None:
            return SolvedContact(q, probe, _NOWHERE, 0.0, 0.0, NO_CONTACT, (0.0, 0.0), _POLE, _ORIGIN)
        foot = config.object.nearest(probe.centre)
        if config.compliance is not None and foot.distance < config.radius_m:
            q = self._given_way(q, foot, config.compliance)
            probe = self._probe(q, qd)
            foot = config.object.nearest(probe.centre)
        nx, ny, nz = foot.normal
        vx, vy, vz = probe.velocity
        depth, rate = config.radius_m - foot.distance, -(nx * vx + ny * vy + nz * vz)
        push: Vec | None = None
        touches = None if config.object.by_gaps else config.object.touches(probe.centre, config.radius_m)
        if config.object.by_gaps:
            contact = self._squeezed(config.object, probe, depth, rate)
        elif touches is not None:
            contact, push = self._resting(touches, probe)
        else:
            contact = self._elastic(depth, foot, rate, config.damping_s_m)
        # Contact direction on the probe: from its centre against the object's outward normal.
        (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = probe.axes
        d = (-(nx * x0 + ny * x1 + nz * x2), -(nx * y0 + ny * y1 + nz * y2), -(nx * z0 + ny * z1 + nz * z2))
        uv = pad_coordinates(d, config.radius_m)
        force = contact.force
        push = (force * nx, force * ny, force * nz) if push is None else push
        if config.carrier is not None:
            push = tuple((T[:3, :3] @ push).tolist())
        return SolvedContact(
            q, probe, foot, depth, rate, contact, uv, d, push, several=config.object.by_gaps or touches is not None
        )

    def torques(self, s: SolvedContact) -> list[float]:
        """The object's push, (n,) torques on the motors, in motor coordinates.

        Without friction every force on a ball acts through its centre, however many places touch:
        `(∂q/∂θ)ᵀ Jᵀ f` with J at the centre and f their sum.
        """
        if s.torques is None:
            s.torques = self._unpushed
            if s.contact.force > 0.0:
                assert self._chain is not None
                at = posture(self._chain, s.q)
                s.torques = (jacobian(at, at.flange)[:3].T @ s.push @ self._joints_per_motor).tolist()
        return s.torques

    def _given_way(self, q: tuple[float, ...], foot: Nearest, compliance: Floats) -> tuple[float, ...]:
        """Joint positions (n,) after the contact has pushed each joint back by its torque over its stiffness.

        Model: at rest and linear, `q + C Jᵀ F n` with the motors where they are. F is the force at the depth that
        remains, `F = f(δ − c F)` with `c = nᵀ J C Jᵀ n`; the layer's square law makes that a quadratic. The normal is
        the one before the push.
        """
        assert self._chain is not None
        config, normal = self._config, np.array(foot.normal)
        at = posture(self._chain, q)
        J = jacobian(at, at.flange)
        lever = J[:3].T @ normal
        c = float(lever @ (compliance * lever))
        depth = config.radius_m - foot.distance
        unit = self._elastic(1.0, foot).force  # F = unit · depth²
        left = (sqrt(1.0 + 4.0 * unit * c * depth) - 1.0) / (2.0 * unit * c) if c > 0.0 else depth
        return tuple((np.array(q) + compliance * lever * (unit * left * left)).tolist())

    def _elastic(self, depth: float, foot: Nearest, rate: float = 0.0, damping: float = 0.0) -> Indentation:
        """The contact in one place; a hollow tighter than the ball counts as one that leaves a little."""
        config, kappa = self._config, (max(foot.kappa[0], self._tightest), max(foot.kappa[1], self._tightest))
        return elastic_contact(depth, kappa, config.radius_m, config.stiffness_n_m3, depth_rate=rate, damping=damping)

    def _squeezed(self, shape: PlacedShape, probe: ProbeState, depth: float, rate: float) -> Indentation:
        """The contact with the force of the whole volume that is pressed in; it has no patch."""
        if depth <= 0.0:
            return NO_CONTACT
        config = self._config
        factor = max(0.0, 1.0 + 1.5 * config.damping_s_m * rate)
        force = factor * config.stiffness_n_m3 * shape.squeezed(probe.centre, config.radius_m)
        return Indentation(force, factor)

    def _resting(self, touches: TouchedPlaces, probe: ProbeState) -> tuple[Indentation, Vec]:
        """Several places at once as one contact with the resultant force; it has no patch. And the resultant."""
        config = self._config
        rates = -(touches.normals @ np.array(probe.velocity))
        force = total_force(touches, config.radius_m, config.stiffness_n_m3, rates, config.damping_s_m)
        return Indentation(float(np.linalg.norm(force))), tuple(force.tolist())

    def _probe(self, q: tuple[float, ...], qd: tuple[float, ...]) -> ProbeState:
        """The probe as the arm carries it; without an arm it rests at the origin."""
        if self._chain is None:
            return ProbeState((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))
        c = posture(self._chain, q)
        (c0, c1, c2), (b0, b1, b2) = c.flange, self._base
        return ProbeState((c0 + b0, c1 + b1, c2 + b2), (c.x, c.y, c.z), point_velocity(c, c.flange, qd))
