"""Torque limit 6072h and feed-forwards 60B1h and 60B2h, which a drive gives to the position loop of the plant.

The feed-forwards act in the mode that gives them, until it is left. In cyclic synchronous velocity 60B1h is part of the
target, and in cyclic synchronous torque both are: there the loop gets none. Outside operation enabled the loop stands
for the closed brake. A brake that opens before the motor has torque (`Quirks`) is a loop without torque for that time:
a vertical axis of a dynamic arm falls.
Source: CiA 402-2, objects 6072h, 60B1h, 60B2h.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.parameters import PEAK_TORQUE_PERMILLE, DriveParameters
from canprobe.fieldbus.drive.reference import Motion
from canprobe.fieldbus.node.slave_node import SlaveNode

_LIMIT_INDEX, _SPEED_INDEX, _TORQUE_INDEX = 0x6072, 0x60B1, 0x60B2


class DriveLoop:
    """Torque limit and feed-forwards of one axis; the plant gets changes only.

    Args:
        node: node of the drive.
        motion: reference of the axis.
        parameters: parameters of the drive.

    Attributes:
        changed: whether a position mode has to call `feed_forward` in this cycle.
    """

    def __init__(self, node: SlaveNode, motion: Motion, parameters: DriveParameters) -> None:
        dictionary = node.dictionary
        self._motion, self._parameters, self._number = motion, parameters, dictionary.number
        self._early_ns = node.core.quirks.brake_early_ns
        self._torque_comes = node.core.timers.new(lambda _due_ns: self._give(*self._given[1:]))
        self._given: tuple[int, float, float] = (PEAK_TORQUE_PERMILLE, 0.0, 0.0)
        self.changed = True
        for index in (_LIMIT_INDEX, _SPEED_INDEX, _TORQUE_INDEX):
            dictionary.on_write(index, lambda _sub, _value: self._give(*self._given[1:]))

    def open_brake(self, t_ns: int) -> None:
        """Open the brake, as operation is enabled."""
        if self._early_ns:
            self._torque_comes.arm(t_ns + self._early_ns)
            self._give(*self._given[1:])

    def close_brake(self) -> None:
        """Close the brake, as operation is no longer enabled, or stops by torque."""
        if self._torque_comes.due_ns is not None:
            self._torque_comes.cancel()
            self._give(*self._given[1:])

    def feed_forward(self) -> None:
        """Give the loop the present limit and both offsets."""
        self._give(self._number(_SPEED_INDEX) * self._parameters.units.speed_scale, float(self._number(_TORQUE_INDEX)))
        self.changed = False

    def feed_torque(self) -> None:
        """Give the loop the present limit and the torque offset, in every cycle of a velocity mode."""
        self._give(0.0, float(self._number(_TORQUE_INDEX)))

    def release(self) -> None:
        """Give the loop the limit only."""
        self._give(0.0, 0.0)

    def _give(self, speed: float, torque: float) -> None:
        self.changed = True
        limit = self._parameters.max_torque if self._torque_comes.due_ns is None else 0
        wanted = (limit, speed, torque)
        if wanted != self._given:
            self._given = wanted
            self._motion.plant.set_loop(self._motion.axis, *wanted)
