"""What a drive tells of itself: actual and demand values, brought up to date only where somebody reads them.

Positions and velocities are in the units of the factor group, torques in 1/1000 of the rated torque.
Source: CiA 402-2, objects 6062h, 6064h, 606Bh, 606Ch, 6074h, 6077h, 60F4h.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from canprobe.emulator.drive_motion import AxisPlant, Motion
from canprobe.emulator.drive_units import Units
from canprobe.emulator.node import SlaveNode

_I16, _I32 = 1 << 15, 1 << 31


class DriveFeedback:
    """Actual values of one axis.

    Attributes:
        counts: motor position at the last `measure`.
        plant_torque: tells the torque that the plant needs for its motion now, permille.
        torque: tells the torque now, permille; a drive that controls torque puts its own there.
    """

    def __init__(self, node: SlaveNode, axis: int, plant: AxisPlant, motion: Motion, units: Units) -> None:
        self._core, self._axis, self._plant = node.core, axis, plant
        self.counts = 0.0
        self._velocity = 0.0
        self._t_ns: int | None = None
        self.plant_torque = partial(plant.torque_permille, axis)
        self.torque: Callable[[], float] = self.plant_torque
        sources: dict[int, tuple[int, Callable[[], float]]] = {
            0x6062: (_I32, lambda: units.position(motion.demand(self._t_ns or 0))),
            0x6064: (_I32, lambda: (self.counts - units.origin) / units.scale),
            0x606B: (_I32, lambda: motion.speed(self._t_ns or 0) / units.speed_scale),
            0x606C: (_I32, lambda: self._velocity / units.speed_scale),
            0x6074: (_I16, self._torque),
            0x6077: (_I16, self._torque),
            0x60F4: (_I32, lambda: (motion.demand(self._t_ns or 0) - self.counts) / units.scale),
        }
        for index, (limit, source) in sources.items():
            if node.dictionary.has_index(index):
                sample = self._sampler(index, limit, source)
                node.pdos.on_trigger(index, sample)
                node.dictionary.on_read(index, self._reader(sample))

    def reset(self, t_ns: int) -> None:
        """Velocity starts anew."""
        self._t_ns = None
        self._velocity = 0.0

    def measure(self, t_ns: int) -> float:
        """Position at `t_ns`, counts; the velocity is the mean since the last call."""
        last_ns = self._t_ns
        if t_ns != last_ns:
            self._plant.advance(t_ns)
            counts = self._plant.motor_counts(self._axis)
            if last_ns is not None:
                self._velocity = (counts - self.counts) / (t_ns - last_ns) * 1e9
            self.counts, self._t_ns = counts, t_ns
        return self.counts

    def _torque(self) -> float:
        return self.torque()  # whoever tells it now

    def _sampler(self, index: int, limit: int, source: Callable[[], float]) -> Callable[[int], None]:
        """What puts a value into the dictionary, as a whole number of so many bits."""
        values, key = self._core.dictionary.values, index << 8

        def sample(t_ns: int) -> None:
            if t_ns != self._t_ns:
                self.measure(t_ns)
            number = round(source())
            values[key] = number if -limit <= number < limit else min(max(number, -limit), limit - 1)

        return sample

    def _reader(self, sample: Callable[[int], None]) -> Callable[[int], None]:
        return lambda _subindex: sample(self._core.now_ns)
