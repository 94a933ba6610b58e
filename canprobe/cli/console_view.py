"""The state of a cell as `canprobe console` shows it: that of `monitor`, with joints, touch, and their targets."""

from __future__ import annotations

import math
from typing import Any

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.monitor import Monitor
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cli.listen import array_values
from canprobe.mechanics.types import Floats


class ConsoleView:
    """Looks at a cell from the side; the frames of its cycles are shown to it as to an observer.

    Args:
        cell: a cell with an arm.

    Attributes:
        seen, imaged: the last measurement, and the last one with an image of the array.
    """

    def __init__(self, cell: OpenCell) -> None:
        arm = cell.plan.setup.needed_arm()
        self._cell, self._joints, self._guard = cell, arm.model.joints, JointGuard(cell.plan)
        self._monitor = Monitor(cell.plan)
        self.seen = self.imaged = Measurement(0, 0)

    def observe(self, observation: Observation) -> None:
        """Take the frames of a cycle."""
        self._monitor.push(observation.frames)

    def look(self, measurement: Measurement) -> None:
        """Take the measurement of a cycle."""
        self.seen = measurement
        if measurement.tactile is not None:
            self.imaged = measurement

    def document(self, target: Floats | None) -> dict[str, Any]:
        """The state as JSON prints it.

        Args:
            target: joint positions (n,), rad or m, that the drives have; None where they are not enabled.
        """
        view = self._monitor.view(round(1e9 * self._cell.cell.cycles.run_s(self.seen))).as_document()
        del view["q"], view["units"]
        for node in view["nodes"]:
            read = self._cell.cell.readings.values.get(node["node_id"], {})
            node |= {name: read.get(name) for name in ("voltage_v", "temperature_c")}
        return view | {"joints": self._joint_values(target), "touch": array_values(self._cell, self.imaged)}

    def _joint_values(self, target: Floats | None) -> list[dict[str, Any]]:
        """Each joint, deg or mm: where it is, its target, what is between them, its range, and its torque."""
        q, torques = self.seen.q, self.seen.torque_permille
        joints = []
        for i, its in enumerate(self._joints):
            values = {"actual": q, "target": target, "low": self._guard.low, "high": self._guard.high}
            shown = {key: None if v is None else round(its.shown(v[i]), 3) for key, v in values.items()}
            off = None if q is None or target is None else round(its.shown(target[i] - q[i]), 3)
            torque = torques[i] if torques and math.isfinite(torques[i]) else None
            joints.append({"name": its.name, "unit": its.unit, **shown, "error": off, "torque_permille": torque})
        return joints
