"""The plant: arm, probe, object and array as one thing that the emulated nodes share.

Time only moves forward; several calls at one instant are the same as one. Contact is solved once per distinct time
and only when somebody asks. Contact pushes the dynamic arm back, and the ideal one where its joints are compliant: its
drives are taken as stiff, and report the torque that they give against the push.

The times of all calls are those of the bus. The plant's own time is 0 at `begin`, so that nothing in it depends on how
long the nodes took to be brought up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from canprobe.cell.plant.arms import make_arm
from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.dynamic_arm import DynamicArm
from canprobe.cell.plant.elastic_contact import NO_CONTACT, Indentation, elastic_contact
from canprobe.cell.plant.ideal_arm import IdealArm
from canprobe.cell.plant.pressure import Vec, pad_coordinates
from canprobe.cell.plant.probe import PressedProbe, ProbeState, in_pad
from canprobe.cell.plant.several_contacts import MIN_CURVATURE_SHARE, total_force
from canprobe.cell.plant.taxels import Image, TaxelArray
from canprobe.errors import PlanError
from canprobe.fieldbus.drive.profile import MotorDynamics
from canprobe.mechanics.robot.chain import Chain, ending_in, jacobian, point_velocity, posture
from canprobe.mechanics.robot.model import ArmModel, units_to_joints
from canprobe.mechanics.robot.motors import joints_per_motor
from canprobe.mechanics.touch.shapes import Nearest, PlacedShape, TouchedPlaces
from canprobe.mechanics.types import Floats

Truth = dict[str, float | bool | Floats]
SWITCH_DISTANCE_SHARE = 0.01
"""Distance of the limit switches beyond a joint's range, as a share of the range."""


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


class Plant:
    """Arm, probe, object and array.

    Args:
        config: configuration of the plant.
        waits: the plant's time stands at 0 until `begin`; False: it is the time of the calls.

    Attributes:
        motor_counts, torque_permille: position (counts, continuous) and torque (see ``IdealArm.torque_permille``) of a
            motor now, of its axis from 0: the arm's own methods; 0 without one.

    Raises:
        PlanError: a probe without an arm is over a hollow as tight as itself.
    """

    def __init__(self, config: PlantConfig, *, waits: bool = False) -> None:
        self.config = config
        self.t_ns = 0
        self._origin_ns = None if waits else 0
        self.motor_counts: Callable[[int], float] = lambda axis: 0.0
        self.torque_permille: Callable[[int], int] = lambda axis: 0
        self.arm: IdealArm | DynamicArm | None = None
        self._pressed: PressedProbe | None = None
        if config.model is not None:
            self.arm = make_arm(config)
            self.motor_counts, self.torque_permille = self.arm.motor_counts, self.arm.torque_permille
            if isinstance(self.arm, IdealArm) and config.object is not None:
                self._joints_per_motor, self._unpushed = joints_per_motor(config.model), [0.0] * config.model.n
                self.arm.push = self._push
        if config.object is not None and config.model is None:
            _refuse_tight_hollow(config)
            self._pressed = PressedProbe(config)
        self._tightest = -inf if config.object is None else (MIN_CURVATURE_SHARE - 1.0) / config.radius_m
        self.array: TaxelArray | None = None
        if config.taxels is not None:
            rng = np.random.default_rng(config.seed)
            self.array = TaxelArray(
                config.taxels,
                rng,
                radius_m=config.radius_m,
                stiffness_n_m3=config.stiffness_n_m3,
                pad=config.pad,
            )
        self._base: Vec = tuple(config.base_offset_m.tolist())
        self._chain: Chain | None = None
        if config.model is not None:
            self._chain = ending_in(config.model.chain, config.T_flange_probe_centre)
        rows = [] if config.model is None else config.model.q_per_unit.tolist()
        self._shares = [[(motor, share) for motor, share in enumerate(row) if share] for row in rows]
        self._at_zero = _joints_at_zero(config.model)
        self._solved: _Solution | None = None
        self._image: tuple[int, Image] | None = None
        self._first_image_s: float | None = None

    def begin(self, t_ns: int) -> None:
        """Start the plant's time here, unless it runs already.

        Args:
            t_ns: present time, ns.
        """
        if self._origin_ns is None:
            self._origin_ns = t_ns

    def advance(self, t_ns: int) -> None:
        """Move the present time on; earlier times and repeats change nothing.

        Args:
            t_ns: present time, ns.
        """
        if self._origin_ns is None:
            return
        t_ns -= self._origin_ns
        if t_ns > self.t_ns:
            self.t_ns = t_ns
            self._solved = None
            if self.arm is not None:
                self.arm.advance(t_ns)

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        """Set the reference of a drive, see ``IdealArm.set_ramp``.

        Raises:
            RuntimeError: without an arm.
        """
        origin_ns = t1_ns if self._origin_ns is None else self._origin_ns  # at rest until its time begins
        (self.arm or self._need_arm()).set_ramp(axis, start_counts, end_counts, t0_ns - origin_ns, t1_ns - origin_ns)

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Set torque limit and feed-forwards of a drive, see ``DynamicArm.set_loop``; nothing happens without an arm.

        Args:
            axis: number of the drive, from 0.
            limit_permille: torque limit, permille of the rated torque.
            speed: speed that is added, counts/s.
            torque_permille: torque that is added, permille of the rated torque.
        """
        if self.arm is not None:
            self.arm.set_loop(axis, limit_permille, speed, torque_permille)

    def motor_dynamics(self, axis: int) -> MotorDynamics:
        """How one motor would answer to torque: inertia, viscous and Coulomb friction of its own joint alone.

        Links and the wrist's coupling are left out.

        Args:
            axis: number of the drive, from 0.

        Raises:
            RuntimeError: without an arm.
        """
        model = self._need_arm().model
        joint, units = model.joints[axis], abs(float(model.units_per_q[axis, axis]))
        return MotorDynamics(
            gain=1e-3 * joint.rated_torque * units / joint.rotor_inertia,
            coulomb=1000.0 * joint.coulomb / joint.rated_torque,
            damping=joint.viscous / joint.rotor_inertia,
        )

    def limit_switches(self, axis: int) -> tuple[float, float]:
        """Positions of one motor (counts) at and beyond which its joint's limit switches are active, lower first.

        The joint is where it really is, whatever zero its drive believes in; where motors are coupled the positions
        follow from where the others are now. Infinite without an arm.

        Args:
            axis: number of the drive, from 0.
        """
        arm = self.arm
        if arm is None:
            return -inf, inf
        model, here = arm.model, arm.motor_counts(axis)
        q = float(units_to_joints(model, arm.motors()[0])[axis])
        beyond = SWITCH_DISTANCE_SHARE * (model.q_max[axis] - model.q_min[axis])
        per_count = float(model.q_per_unit[axis, axis])
        ends = [here + (end - q) / per_count for end in (model.q_min[axis] - beyond, model.q_max[axis] + beyond)]
        return min(ends), max(ends)

    def _need_arm(self) -> IdealArm | DynamicArm:
        if self.arm is None:
            raise RuntimeError("this plant has no arm")
        return self.arm

    def sample_image(self, t_ns: int) -> Image:
        """Advance and sample the array; a second call at one instant gives the same image.

        Args:
            t_ns: time of the sample, ns.

        Returns:
            (rows, columns) counts; zeros without an array.
        """
        self.advance(t_ns)
        if self.array is None:
            return np.zeros(self.config.pad.shape, dtype=np.uint8)
        if self._image is None:
            self._first_image_s = 1e-9 * self.t_ns
        if self._image is None or self._image[0] != t_ns:
            self._image = (t_ns, self._sampled(self.array, self._solution()))
        return self._image[1].copy()

    def pressure(self, state: PlantState | None = None) -> Floats:
        """(rows, columns) mean pressure of every taxel, Pa, before the array's imperfections; zeros without an array.

        Args:
            state: state of this plant; the present one by default.
        """
        s = self._solution() if state is None else self._solve(state)
        if self.array is None or s.depth <= 0.0:
            return np.zeros(self.config.pad.shape)
        means: Floats
        if self.config.object is not None and self.config.object.by_gaps:
            means = self._over_gaps(self.array, self.config.object, s)
        else:
            means = self.array.field.mean_pressure(s.pad_uv, s.depth, s.kappa, in_pad(s.foot, s.probe, s.direction))
        return means * (self.config.stiffness_n_m3 * s.contact.damping_factor)

    def _sampled(self, array: TaxelArray, s: _Solution) -> Image:
        shape = self.config.object
        if s.several and shape is not None:
            if shape.by_gaps and s.depth <= 0.0:
                return array.image_of(np.zeros(array.pad.shape), 1e-9 * self.t_ns)
            means = self._over_gaps(array, shape, s)
            return array.image_of(means * s.contact.damping_factor, 1e-9 * self.t_ns)
        return array.image(
            s.pad_uv,
            s.depth,
            s.kappa,
            in_pad(s.foot, s.probe, s.direction) if s.depth > 0.0 else ((1.0, 0.0), (0.0, 1.0)),
            1e-9 * self.t_ns,
            pressure_factor=s.contact.damping_factor,
        )

    def _over_gaps(self, array: TaxelArray, shape: PlacedShape, s: _Solution) -> Floats:
        """(rows, columns) taxel means of the layer's compression, m, from the gaps all over the pad."""
        points = array.field.points(np.array(s.probe.centre), np.array(s.probe.axes))
        return array.field.mean_of(-shape.gaps(points))

    def state(self) -> PlantState:
        """The present state: cheap to take, `truth` can be asked for it at any time."""
        if self.arm is None:
            return PlantState(self.t_ns, (), ())
        return PlantState(self.t_ns, *self.arm.motors())

    def truth(self, state: PlantState | None = None) -> Truth:
        """True values of a state, SI, base frame.

        Args:
            state: state of this plant; the present one by default.

        Without contact ``force`` is 0 and the contact fields are those of the closest surface point; without an object
        they are zeros.

        Returns:
            q (n), probe_centre (3), pole (3), force, depth (negative: gap), depth_rate, contact_point (3) on the
            object, contact_normal (3) outward of the object, kappa (2), direction1 (3), direction2 (3), pad_uv (2),
            in_contact.
        """
        found = _true(self._solution() if state is None else self._solve(state))
        return {name: np.array(value) if isinstance(value, tuple) else value for name, value in found.items()}

    def truths(self, states: Sequence[PlantState]) -> dict[str, Floats]:
        """`truth` of many states, a row each; empty without a state."""
        return truth_columns([self.truth_row(state) for state in states])

    def truth_row(self, state: PlantState | None = None) -> TruthRow:
        """`truth` in plain numbers; that of the present state costs nothing where the array was just sampled."""
        return _true(self._solution() if state is None else self._solve(state))

    def _solution(self) -> _Solution:
        if self._solved is None:
            self._solved = self._solve(self.state())
        return self._solved

    def _push(self) -> Sequence[float]:
        """The object's push now, (n,) torques on the motors, in motor coordinates.

        Without friction every force on a ball acts through its centre, however many places touch:
        `(∂q/∂θ)ᵀ Jᵀ f` with J at the centre and f their sum.
        """
        s = self._solution()
        if s.torques is None:
            s.torques = self._unpushed
            if s.contact.force > 0.0:
                assert self._chain is not None
                at = posture(self._chain, s.q)
                s.torques = (jacobian(at, at.flange)[:3].T @ s.push @ self._joints_per_motor).tolist()
        return s.torques

    def _probe(self, t_ns: int, q: tuple[float, ...], qd: tuple[float, ...]) -> ProbeState:
        if self._pressed is not None:
            return self._pressed.at(1e-9 * t_ns, self._first_image_s)
        if self._chain is None:
            return ProbeState((0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))
        c = posture(self._chain, q)
        (c0, c1, c2), (b0, b1, b2) = c.flange, self._base
        return ProbeState((c0 + b0, c1 + b1, c2 + b2), (c.x, c.y, c.z), point_velocity(c, c.flange, qd))

    def _joints(self, motors: Sequence[float]) -> tuple[float, ...]:
        """Joint positions, or rates, of motor positions or rates; empty without an arm."""
        joints = []
        for row in self._shares:
            value = 0.0
            for motor, share in row:
                value += share * motors[motor]
            joints.append(value)
        return tuple(joints)

    def _solve(self, state: PlantState) -> _Solution:
        config = self.config
        q, qd = self._joints(state.counts), self._joints(state.rates)
        if self._at_zero is not None:
            q = tuple([a + b for a, b in zip(q, self._at_zero, strict=True)])
        probe = self._probe(state.t_ns, q, qd)
        if config.object is None:
            return _Solution(q, probe, _NOWHERE, 0.0, 0.0, NO_CONTACT, (0.0, 0.0), (0.0, 0.0), _POLE, _ORIGIN)
        foot = config.object.nearest(probe.centre)
        if config.compliance is not None and foot.distance < config.radius_m:
            q = self._given_way(q, foot, config.compliance)
            probe = self._probe(state.t_ns, q, qd)
            foot = config.object.nearest(probe.centre)
        nx, ny, nz = foot.normal
        vx, vy, vz = probe.velocity
        depth, rate = config.radius_m - foot.distance, -(nx * vx + ny * vy + nz * vz)
        k1, k2 = foot.kappa
        push = None
        if config.object.by_gaps:
            several, contact = True, self._squeezed(config.object, probe, depth, rate)
        else:
            touches = config.object.touches(probe.centre, config.radius_m)
            several = touches is not None
            contact = elastic_contact(
                depth,
                (max(k1, self._tightest), max(k2, self._tightest)),
                config.radius_m,
                config.stiffness_n_m3,
                depth_rate=rate,
                damping=config.damping_s_m,
            )
            if touches is not None:
                contact, push = self._resting(touches, probe)
        # Contact direction on the probe: from its centre against the object's outward normal.
        (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = probe.axes
        d = (-(nx * x0 + ny * x1 + nz * x2), -(nx * y0 + ny * y1 + nz * y2), -(nx * z0 + ny * z1 + nz * z2))
        uv = pad_coordinates(d, config.radius_m)
        force = contact.force
        push = (force * nx, force * ny, force * nz) if push is None else push
        return _Solution(q, probe, foot, depth, rate, contact, (k1, k2), uv, d, push, several=several)

    def _given_way(self, q: tuple[float, ...], foot: Nearest, compliance: Floats) -> tuple[float, ...]:
        """Joint positions (n,) after the contact has pushed each joint back by its torque over its stiffness.

        Model: at rest and linear, `q + C Jᵀ F n` with the motors where they are. F is the force at the depth that
        remains, `F = f(δ − c F)` with `c = nᵀ J C Jᵀ n`; the layer's square law makes that a quadratic. The normal is
        the one before the push.
        """
        assert self._chain is not None
        config, normal = self.config, np.array(foot.normal)
        at = posture(self._chain, q)
        J = jacobian(at, at.flange)
        lever = J[:3].T @ normal
        c = float(lever @ (compliance * lever))
        depth = config.radius_m - foot.distance
        kappa = (max(foot.kappa[0], self._tightest), max(foot.kappa[1], self._tightest))
        unit = elastic_contact(1.0, kappa, config.radius_m, config.stiffness_n_m3).force  # F = unit · depth²
        left = (sqrt(1.0 + 4.0 * unit * c * depth) - 1.0) / (2.0 * unit * c) if c > 0.0 else depth
        given: tuple[float, ...] = tuple((np.array(q) + compliance * lever * (unit * left * left)).tolist())
        return given

    def _squeezed(self, shape: PlacedShape, probe: ProbeState, depth: float, rate: float) -> Indentation:
        """The contact with the force of the whole volume that is pressed in; it has no patch."""
        if depth <= 0.0:
            return NO_CONTACT
        config = self.config
        factor = max(0.0, 1.0 + 1.5 * config.damping_s_m * rate)
        force = factor * config.stiffness_n_m3 * shape.squeezed(probe.centre, config.radius_m)
        return NO_CONTACT._replace(force=force, damping_factor=factor)

    def _resting(self, touches: TouchedPlaces, probe: ProbeState) -> tuple[Indentation, Vec]:
        """Several places at once as one contact with the resultant force; it has no patch. And the resultant."""
        config = self.config
        rates = -(touches.normals @ np.array(probe.velocity))
        force = total_force(touches, config.radius_m, config.stiffness_n_m3, rates, config.damping_s_m)
        return NO_CONTACT._replace(force=float(np.linalg.norm(force))), tuple(force.tolist())


def _joints_at_zero(model: ArmModel | None) -> list[float] | None:
    """Joint positions where every drive counts zero; None where they are zero too."""
    if model is None or not model.zero_units.any():
        return None
    q: list[float] = units_to_joints(model, np.zeros(model.n)).tolist()
    return q


@dataclass(slots=True, eq=False)
class _Solution:
    """The contact at one instant."""

    q: tuple[float, ...]
    probe: ProbeState
    foot: Nearest
    depth: float
    depth_rate: float
    contact: Indentation
    kappa: tuple[float, float]
    pad_uv: tuple[float, float]
    direction: Vec  # of the contact from the probe's centre, pad frame
    push: Vec  # of the object on the probe's centre, N, base frame
    torques: Sequence[float] | None = None  # on the motors by the push, once somebody has asked for them
    several: bool = False  # it touches in several places or all over, and these are of the deepest


def truth_columns(rows: Sequence[TruthRow]) -> dict[str, Floats]:
    """Columns of truths, one row each; empty without a row."""
    return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}


def _true(s: _Solution) -> TruthRow:
    """The values of `Plant.truth` in plain numbers."""
    return {
        "q": s.q,
        "probe_centre": s.probe.centre,
        "pole": s.probe.axes[2],
        "force": s.contact.force,
        "depth": s.depth,
        "depth_rate": s.depth_rate,
        "contact_point": s.foot.point,
        "contact_normal": s.foot.normal,
        "kappa": s.foot.kappa,
        "direction1": s.foot.directions[0],
        "direction2": s.foot.directions[1],
        "pad_uv": s.pad_uv,
        "in_contact": s.depth > 0.0,
    }


_POLE = (0.0, 0.0, 1.0)
_ORIGIN = (0.0, 0.0, 0.0)
_NOWHERE = Nearest(_ORIGIN, _ORIGIN, 0.0, (0.0, 0.0), (_ORIGIN, _ORIGIN))


def _refuse_tight_hollow(config: PlantConfig) -> None:
    """A probe without an arm is pressed on the object's reference point, which it must be able to reach."""
    assert config.object is not None
    tightest = config.object.tightest_concave_radius()
    if tightest <= config.radius_m:
        raise PlanError(
            [
                f"the object has a hollow of radius {1e3 * tightest:.1f} mm, the probe's radius is "
                f"{1e3 * config.radius_m:.1f} mm: it cannot touch there in one point; take a smaller probe"
            ]
        )
