"""A node from an EDS alone, of any make: the values of the file, and a drive where the file describes one."""

from __future__ import annotations

from functools import partial
from math import inf
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary

from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.drive.profile import MotorDynamics
from canprobe.fieldbus.drive.reference import AxisPlant
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.eds.reading import is_drive
from canprobe.fieldbus.node.slave_node import SlaveNode, set_serial_number


class IdealAxis(AxisPlant):
    """An axis for a drive that has no plant: the motor is exactly where its reference is.

    It has no load: the torque is 0, and there is never a following error. It answers the torque of a drive as an
    inertia with viscous damping, without Coulomb friction. The axis number in calls has no meaning here.

    Args:
        position: place of the motor at first, counts.
    """

    def __init__(self, position: float = 0.0) -> None:
        self._start = self._end = position
        self._t0 = self._t1 = self._now = 0

    def begin(self, t_ns: int) -> None:
        """Do nothing: the axis rests until it gets a reference."""

    def advance(self, t_ns: int) -> None:
        self._now = max(self._now, t_ns)

    def motor_counts(self, axis: int) -> float:
        if self._now >= self._t1:
            return self._end
        return self._start + (self._end - self._start) * max(0, self._now - self._t0) / (self._t1 - self._t0)

    def torque_permille(self, axis: int) -> int:
        """Motor torque, which is always 0."""
        return 0

    def limit_switches(self, axis: int) -> tuple[float, float]:
        """Positions of limit switches, at infinity as there are none."""
        return -inf, inf

    def motor_dynamics(self, axis: int) -> MotorDynamics:
        """Dynamics of the motor: 100 permille give 10⁵ counts/s² from rest, and in the end 10⁵ counts/s."""
        return MotorDynamics(gain=1000.0, coulomb=0.0, damping=1.0)

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Do nothing: there is no loop and no torque."""

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        self._start, self._end, self._t0, self._t1 = start_counts, end_counts, t0_ns, t1_ns


def make_eds_node(
    od: ObjectDictionary,
    node_id: int,
    *,
    eds: str | Path | None = None,
    serial: int | None = None,
    position: int = 0,
) -> SlaveNode:
    """Make a conforming CiA 301 node with the values of its EDS; a CiA 402 drive moves an ideal axis.

    Args:
        od: parsed EDS, for this node id.
        node_id: node id, 1–127; with 255 the node waits for LSS to give it one.
        eds: name or path of the EDS, for a node that speaks LSS; None for one that does not.
        serial: serial number for 1018h:04, in the place of that of the file.
        position: place of the motor of a drive at first, counts.
    """
    od_of = None if eds is None else partial(load_eds, eds)
    drive = is_drive(od)
    axis = IdealAxis(position)
    node = make_drive_node(od, node_id, 0, axis, od_of) if drive else SlaveNode(od, node_id, od_of=od_of)
    if serial is not None:
        set_serial_number(node, serial)
    return node
