"""The plant: arm, probe, object and array as one thing that the emulated nodes share.

Time only moves forward; several calls at one instant are the same as one. Contact is solved once per distinct time
and only when somebody asks. Contact pushes the dynamic arm back, and the ideal one where its joints are compliant: its
drives are taken as stiff, and report the torque that they give against the push.

The times of all calls are those of the bus. The plant's own time is 0 at `begin`, so that nothing in it depends on how
long the nodes took to be brought up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.contact import ContactSolver, PlantState, SolvedContact, TruthRow
from canprobe.cell.plant.ideal_arm import IdealArm
from canprobe.cell.plant.taxels import Image, TaxelArray
from canprobe.mechanics.robot.model import units_to_joints
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.plant.dynamic_arm import DynamicArm
    from canprobe.fieldbus.drive.profile import MotorDynamics
    from canprobe.mechanics.touch.shapes import PlacedShape

Truth = dict[str, float | bool | Floats]
SWITCH_DISTANCE_SHARE = 0.01
"""Distance of the limit switches beyond a joint's range, as a share of the range."""


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
        self._solver = ContactSolver(config)
        if config.model is not None:
            if config.fidelity == "ideal":
                self.arm = IdealArm(config.model, config.q0, config.bandwidth_hz)
            else:
                from canprobe.cell.plant.dynamic_arm import DynamicArm

                self.arm = DynamicArm(config)
            self.motor_counts, self.torque_permille = self.arm.motor_counts, self.arm.torque_permille
            if isinstance(self.arm, IdealArm) and config.object is not None:
                self.arm.push = lambda: self._solver.torques(self._solution())
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
        self._solved: SolvedContact | None = None
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

    @property
    def carrier_position(self) -> float:
        """Position of the object's carrier now, rad or m; 0 without one."""
        return 1e-9 * self.t_ns * self.config.carrier.speed if self.config.carrier is not None else 0.0

    def place(self, shape: PlacedShape | None) -> None:
        """Put another object in the place of the present one; None: nothing is there any more."""
        self.config = replace(self.config, object=shape)
        self._solver, self._solved = ContactSolver(self.config), None

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
        from canprobe.fieldbus.drive.profile import MotorDynamics

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
            s, t_s = self._solution(), 1e-9 * self.t_ns
            self._image = t_ns, self.array.image_of(self._compression(self.array, s), t_s, s.contact.damping_factor)
        return self._image[1].copy()

    def pressure(self, state: PlantState | None = None) -> Floats:
        """(rows, columns) mean pressure of every taxel, Pa, before the array's imperfections; zeros without an array.

        Args:
            state: state of this plant; the present one by default.
        """
        s = self._solution() if state is None else self._solve(state)
        if self.array is None:
            return np.zeros(self.config.pad.shape)
        return self._compression(self.array, s) * (self.config.stiffness_n_m3 * s.contact.damping_factor)

    def _compression(self, array: TaxelArray, s: SolvedContact) -> Floats:
        """(rows, columns) taxel means of the layer's compression, m."""
        if s.depth <= 0.0:
            return np.zeros(array.pad.shape)
        if s.several and self.config.object is not None:  # from the gaps all over the pad
            points = array.field.points(np.array(s.probe.centre), np.array(s.probe.axes))
            return array.field.mean_of(-self.config.object.gaps(points))
        return array.field.mean_pressure(s.pad_uv, s.depth, s.foot.kappa, s.directions_pad)

    def state(self) -> PlantState:
        """The present state: cheap to take, `truth` can be asked for it at any time."""
        if self.arm is None:
            return PlantState(self.t_ns, (), ())
        return PlantState(self.t_ns, *self.arm.motors())

    def truth(self, state: PlantState | None = None) -> Truth:
        """True values of a state, SI, base frame; on a carrier the carrier's frame, in which the object stands still.

        Args:
            state: state of this plant; the present one by default.

        Without contact ``force`` is 0 and the contact fields are those of the closest surface point; without an object
        they are zeros.

        Returns:
            q (n), probe_centre (3), pole (3), force, depth (negative: gap), depth_rate, contact_point (3) on the
            object, contact_normal (3) outward of the object, kappa (2), direction1 (3), direction2 (3), pad_uv (2),
            in_contact.
        """
        found = self.truth_row(state)
        return {name: np.array(value) if isinstance(value, tuple) else value for name, value in found.items()}

    def truths(self, states: Sequence[PlantState]) -> dict[str, Floats]:
        """`truth` of many states, a row each; empty without a state."""
        return truth_columns([self.truth_row(state) for state in states])

    def truth_row(self, state: PlantState | None = None) -> TruthRow:
        """`truth` in plain numbers; that of the present state costs nothing where the array was just sampled."""
        return (self._solution() if state is None else self._solve(state)).truth

    def _solve(self, state: PlantState) -> SolvedContact:
        return self._solver.solve(state, self._first_image_s)

    def _solution(self) -> SolvedContact:
        if self._solved is None:
            self._solved = self._solve(self.state())
        return self._solved


def truth_columns(rows: Sequence[TruthRow]) -> dict[str, Floats]:
    """Columns of truths, one row each; empty without a row."""
    return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
