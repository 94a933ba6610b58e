"""Dynamic arm: rigid links, friction, drive cascade and the object's push, in the place of the ideal arm.

Time goes in steps from the last change of a reference on; a step ends where a reference bends. What is asked between
two steps is answered by a shorter step that is then forgotten, so that asking changes nothing. Mass matrix, bias and
contact geometry are held over ``hold_ns``.
"""

from __future__ import annotations

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.equations import ArmEquations
from canprobe.cell.plant.ideal_arm import PEAK_PERMILLE, Reference
from canprobe.cell.plant.integrators import STEPS
from canprobe.mechanics.robot.model import joints_to_units, units_per_motor
from canprobe.mechanics.types import Floats


class DynamicArm:
    """The n motors that drive the arm's links.

    Args:
        config, held: as for ``ArmEquations``; the arm begins at rest.

    Raises:
        PlanError: see ``ArmEquations``.
    """

    def __init__(self, config: PlantConfig, *, held: bool = True) -> None:
        assert config.model is not None
        self.model = model = config.model
        self.equations = ArmEquations(config, held=held)
        self.t_ns = 0
        self._dynamics, self._step = config.dynamics, STEPS[config.dynamics.integrator]
        units = joints_to_units(model, config.q0)
        self._scales = units_per_motor(model)
        # of a drive that counts backwards negative: its torques are in its own sense
        self._rated = np.sign(self._scales) * [joint.rated_torque for joint in model.joints]
        self._references = [Reference(c) for c in units.tolist()]
        self._y = self.equations.resting((units - model.zero_units) / self._scales)
        self._y_ns = 0
        self._hold_ns = -self._dynamics.hold_ns
        self._bend_ns = 0
        self._now: tuple[int, Floats] | None = None
        self._torques: tuple[Floats, Floats] | None = None
        self._bend()

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        """Give one motor a ramp, see ``IdealArm.set_ramp``."""
        if self._y_ns < self.t_ns:
            self._advance_to(self.t_ns)
        self._references[axis].add((t0_ns, t1_ns, start_counts, end_counts), self.t_ns)
        self._bend_ns = self._y_ns
        self._torques = None  # the state now is what it is, whatever the reference does from now on

    def advance(self, t_ns: int) -> None:
        """Move the present time on; earlier times and repeats change nothing.

        Args:
            t_ns: present time, ns.
        """
        self.t_ns = max(self.t_ns, t_ns)

    def motors(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Positions (counts) and rates (counts/s) of the motors now."""
        x, v, _ = self._state().reshape(3, -1)
        return tuple((x * self._scales + self.model.zero_units).tolist()), tuple((v * self._scales).tolist())

    def motor_counts(self, axis: int) -> float:
        """Position of one motor now, counts, continuous.

        Args:
            axis: number of the motor, from 0.
        """
        return float(self._state()[axis] * self._scales[axis] + self.model.zero_units[axis])

    def torque_permille(self, axis: int) -> int:
        """Torque of one motor over its continuous limit, as a drive reports it (6077h).

        Args:
            axis: number of the motor, from 0.
        """
        y = self._state()
        if self._torques is None or self._torques[0] is not y:
            self._torques = y, self.equations.loops.drives(1e-9 * self.t_ns, y).given
        permille = round(1000.0 * float(self._torques[1][axis]) / float(self._rated[axis]))
        return max(-PEAK_PERMILLE, min(PEAK_PERMILLE, permille))

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Torque limit and feed-forwards of one drive from now on.

        Args:
            axis: number of the motor, from 0.
            limit_permille: largest torque, permille of the continuous torque; the configured limit if that is less.
            speed: speed added behind the position loop, counts/s.
            torque_permille: torque added behind the velocity loop.
        """
        self._advance_to(self.t_ns)
        rated = 1e-3 * float(self._rated[axis])
        self.equations.loops.set_loop(
            axis, abs(rated) * limit_permille, speed / self._scales[axis], rated * torque_permille
        )
        self._torques = None

    def _state(self) -> Floats:
        """The state at the present time."""
        if self._now is None or self._now[0] != self.t_ns:
            self._advance_to(self.t_ns, keep=False)
        assert self._now is not None
        return self._now[1]

    def _advance_to(self, t_ns: int, *, keep: bool = True) -> None:
        """Take all whole steps up to t and one to t itself, which is kept or only noted."""
        while self._y_ns < t_ns:
            if self._y_ns >= self._bend_ns:
                self._bend()
            end_ns = min(self._y_ns + self._dynamics.step_ns, self._bend_ns)
            if end_ns > t_ns:
                break
            self._y, self._y_ns = self._stepped(end_ns), end_ns
        y = self._stepped(t_ns) if t_ns > self._y_ns else self._y
        if keep:
            self._y, self._y_ns = y, t_ns
        self._now = (t_ns, y)

    def _bend(self) -> None:
        """Take the slopes of the references, of which one changes here."""
        now_ns = self._y_ns
        x, v = np.array([reference.at(now_ns) for reference in self._references]).T
        theta = (x - self.model.zero_units) / self._scales
        self.equations.loops.set_reference(1e-9 * now_ns, theta, v / self._scales)
        self._bend_ns = min(reference.next_bend(now_ns) for reference in self._references)

    def _stepped(self, end_ns: int) -> Floats:
        if self._y_ns >= self._hold_ns + self._dynamics.hold_ns:
            self.equations.hold(self._y)
            self._hold_ns = self._y_ns
        return self._step(self.equations, 1e-9 * self._y_ns, self._y, 1e-9 * (end_ns - self._y_ns))
