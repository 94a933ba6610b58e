"""Actual and demand values that a drive reports, brought up to date only where somebody reads them.

Positions and velocities are in the units of the factor group, torques in 1/1000 of the rated torque.
Source: CiA 402-2, objects 6062h, 6064h, 606Bh, 606Ch, 6074h, 6077h, 60F4h, 60FDh.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from canprobe.fieldbus.drive.reference import Motion
from canprobe.fieldbus.drive.units import Units
from canprobe.fieldbus.node.slave_node import SlaveNode

_I16_LIMIT, _I32_LIMIT = 1 << 15, 1 << 31
_TORQUE_INDICES = (0x6074, 0x6077)
NEGATIVE_SWITCH_FLAG, POSITIVE_SWITCH_FLAG = 1, 2
"""Flags of 60FDh."""


class DriveFeedback:
    """Actual values of one axis.

    Args:
        node: node of the drive.
        motion: reference of the axis.
        units: units of the drive.
        noise: function for the noise that the encoder adds to a position, counts; None: there is none.

    Attributes:
        counts: motor position at the last `measure`, counts.
        plant_torque: function for the torque that the plant needs for its motion now, permille.
        distortions: functions that make measured counts of true ones, one after the other; faults of the encoder.
    """

    def __init__(self, node: SlaveNode, motion: Motion, units: Units, noise: Callable[[], float] | None) -> None:
        self._core, self._units, self._noise = node.core, units, noise
        self._axis, self._plant = motion.axis, motion.plant
        self.counts = self._velocity = 0.0
        self.distortions: list[Callable[[float], float]] = []
        self._t_ns: int | None = None
        self.plant_torque = partial(motion.plant.torque_permille, motion.axis)
        self._sources: dict[int, Callable[[], float]] = {
            0x6062: lambda: units.position(motion.demand(self._t_ns or 0)),
            0x6064: lambda: (self.counts - units.origin) / units.scale,
            0x606B: lambda: motion.speed(self._t_ns or 0) / units.speed_scale,
            0x606C: lambda: self._velocity / units.speed_scale,
            0x60F4: lambda: (motion.demand(self._t_ns or 0) - self.counts) / units.scale,
            0x60FD: self.switches,
        }
        self.show_torque(self.plant_torque)
        for index in self._sources:
            if node.dictionary.has_index(index):
                sample = self._sampler(index, _I16_LIMIT if index in _TORQUE_INDICES else _I32_LIMIT)
                node.pdos.on_trigger(index, sample)
                node.dictionary.on_read(index, lambda _sub, sample=sample: sample(self._core.now_ns))  # type: ignore[misc]

    def reset(self, t_ns: int) -> None:
        """Forget the velocity."""
        self._t_ns = None
        self._velocity = 0.0

    def measure(self, t_ns: int) -> float:
        """Measure and return the position at `t_ns`, counts; the velocity is the mean since the last call."""
        last_ns = self._t_ns
        if t_ns != last_ns:
            self._plant.advance(t_ns)
            counts = self._plant.motor_counts(self._axis)
            if self._noise is not None:
                counts += self._noise()
            for distort in self.distortions:
                counts = distort(counts)
            if last_ns is not None:
                self._velocity = (counts - self.counts) / (t_ns - last_ns) * 1e9
            self.counts, self._t_ns = counts, t_ns
        return self.counts

    def switch_positions(self) -> tuple[float, float]:
        """Positions of the negative and positive limit switch, counts; the negative one stops motion downward."""
        low, high = self._plant.limit_switches(self._axis)
        return (low, high) if self._units.scale > 0.0 else (high, low)

    def switches(self) -> int:
        """Active limit switches: bits 0 (negative) and 1 (positive) of 60FDh."""
        low, high = self._plant.limit_switches(self._axis)
        counts = self._plant.motor_counts(self._axis)
        below, above = counts <= low, counts >= high
        negative, positive = (below, above) if self._units.scale > 0.0 else (above, below)
        return NEGATIVE_SWITCH_FLAG * negative | POSITIVE_SWITCH_FLAG * positive

    def show_torque(self, source: Callable[[], float]) -> None:
        """Show the torque, permille, from `source` from now on: that of the plant, or of a mode that controls it."""
        self._sources.update(dict.fromkeys(_TORQUE_INDICES, source))

    def _sampler(self, index: int, limit: int) -> Callable[[int], None]:
        """The function that puts a value into the dictionary, as a whole number within ±limit."""
        values, key, sources, least, most = self._core.dictionary.values, index << 8, self._sources, -limit, limit - 1

        def sample(t_ns: int) -> None:
            if t_ns != self._t_ns:
                self.measure(t_ns)
            number = round(sources[index]())
            values[key] = number if least <= number <= most else min(max(number, least), most)

        return sample
