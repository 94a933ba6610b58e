"""An emulated external arm on the plant: it takes poses, moves behind its dead time, and stops by itself."""

from __future__ import annotations

import numpy as np

from canprobe.cell.planning.model import Plan
from canprobe.cell.plant.plant import Plant
from canprobe.fieldbus.bus.clock import Clock
from canprobe.mechanics.robot.flange import flange_joints, flange_pose
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints
from canprobe.mechanics.types import Floats


class EmulatedArm:
    """The external arm of a plan, whose coordinates are the motors of an ideal arm; see `ExternalArm`.

    Args:
        plan: plan of a cell with an external arm.
        plant: its plant.
        clock: clock of the bus.
    """

    def __init__(self, plan: Plan, plant: Plant, clock: Clock) -> None:
        arm = plan.setup.needed_arm()
        assert arm.external is not None
        self._model, self._period_ns = arm.model, plan.sync.period_ns
        self._delay_ns, self._patience_ns = (round(1e9 * s) for s in (arm.external.delay_s, arm.external.stop_after_s))
        self._plant, self._clock = plant, clock
        self._last: Floats | None = None
        self._last_ns = 0

    def read(self) -> tuple[Floats, int]:
        now_ns = self._clock.now_ns()
        if self._last is not None and now_ns - self._last_ns > self._patience_ns:
            self.stop()
        return flange_pose(self._model, units_to_joints(self._model, self._counts(now_ns))), now_ns

    def command(self, T_base_flange: Floats) -> None:
        now_ns, counts = self._clock.now_ns(), joints_to_units(self._model, flange_joints(self._model, T_base_flange))
        begin_ns, before = now_ns + self._delay_ns, self._counts(now_ns) if self._last is None else self._last
        for axis, (start, end) in enumerate(zip(before.tolist(), counts.tolist(), strict=True)):
            self._plant.set_ramp(axis, start, end, begin_ns, begin_ns + self._period_ns)
        self._last, self._last_ns = counts, now_ns

    def stop(self) -> None:
        now_ns, self._last = self._clock.now_ns(), None
        for axis, here in enumerate(self._counts(now_ns).tolist()):
            self._plant.set_ramp(axis, here, here, now_ns, now_ns)

    def _counts(self, now_ns: int) -> Floats:
        self._plant.advance(now_ns)
        return np.array([self._plant.motor_counts(axis) for axis in range(self._model.n)])
