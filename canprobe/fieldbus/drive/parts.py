"""The parts of one drive, which its application and its modes share: feedback, position loop, supervision.

Positions and velocities are in the units of the factor group, torques in 1/1000 of the rated torque.
Source: CiA 402-2, objects 6062h, 6064h, 6065h, 6066h, 606Bh, 606Ch, 6072h, 6074h, 6077h, 60B1h, 60B2h, 60F4h, 60FDh;
CiA 301, error codes 8100h and 8250h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from canprobe.fieldbus.drive.parameters import PEAK_TORQUE_PERMILLE, DriveParameters
from canprobe.fieldbus.drive.reference import Motion
from canprobe.fieldbus.drive.units import Units
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.emcy import RPDO_TIMEOUT_CODE, SYNC_LOST_CODE

_I16_LIMIT, _I32_LIMIT = 1 << 15, 1 << 31
_TORQUE_INDICES = (0x6074, 0x6077)
NEGATIVE_SWITCH_FLAG, POSITIVE_SWITCH_FLAG = 1, 2
"""Flags of 60FDh."""
_LIMIT_INDEX, _SPEED_INDEX, _TORQUE_INDEX = 0x6072, 0x60B1, 0x60B2


class DriveFeedback:
    """Actual and demand values of one axis, brought up to date only where somebody reads them.

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


class DriveLoop:
    """Torque limit 6072h and feed-forwards 60B1h and 60B2h, given to the position loop of the plant when they change.

    The feed-forwards act in the mode that gives them, until it is left. In cyclic synchronous velocity 60B1h is part of
    the target, and in cyclic synchronous torque both are: there the loop gets none. Outside operation enabled the loop
    stands for the closed brake. A brake that opens before the motor has torque (`Quirks`) is a loop without torque for
    that time: a vertical axis of a dynamic arm falls.

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


class Supervision:
    """Lets a drive stop by itself: counts missed SYNCs and targets between `start` and `stop`.

    Attributes:
        outside_ns: time since which the following error has been outside 6065h; None while it is inside.
        watching: whether SYNCs are counted: between `start` and `stop`, in a mode that needs SYNC.
    """

    def __init__(self, node: SlaveNode, parameters: DriveParameters, on_loss: Callable[[int, int], None]) -> None:
        """Make the supervision; `on_loss(code, t_ns)` is called when the master counts as lost."""
        self.watching = False
        self._node, self._parameters, self._on_loss = node, parameters, on_loss
        self._timer = node.core.timers.new(lambda due_ns: self._lose(SYNC_LOST_CODE, due_ns))
        self._misses = 0
        self._by_rpdo = False
        self.outside_ns: int | None = None

    def start(self, target: int | None, t_ns: int) -> None:
        """Start, as operation is enabled in a mode that needs SYNC and the object `target`, or neither (None)."""
        self._misses = 0
        self.outside_ns = None
        self._timer.cancel()
        self.watching = target is not None
        if target is not None:
            self._by_rpdo = self._node.pdos.receives(target)
            if patience_ns := self._parameters.patience_ns:
                self._timer.arm(t_ns + patience_ns)

    def stop(self) -> None:
        """Stop, as operation is no longer enabled."""
        self.watching = False
        self._timer.cancel()

    def sync(self, fresh: bool, t_ns: int) -> None:
        """Count a SYNC, with a target since the last one (fresh) or without."""
        if patience_ns := self._parameters.patience_ns:
            self._timer.arm(t_ns + patience_ns)
        # targets by SDO come when they come: then only SYNC is watched
        if fresh or not self._by_rpdo:
            self._misses = 0
            return
        self._misses += 1
        if 0 < self._parameters.misses <= self._misses:
            self._lose(RPDO_TIMEOUT_CODE, t_ns)

    def _lose(self, code: int, t_ns: int) -> None:
        self._node.emcy.report(code)
        self._on_loss(code, t_ns)


@dataclass(frozen=True, slots=True)
class DriveParts:
    """The parts of one drive, which its application and its modes share.

    Attributes:
        node: node of the drive.
        motion: reference of the axis.
        parameters: parameters of the drive.
        feedback, loop, supervision: the parts above.
        fault: function that is called as `fault(code, t_ns)` when a mode has found a fault.
        show: function that is called when the mode's part of the statusword may have changed.
    """

    node: SlaveNode
    motion: Motion
    parameters: DriveParameters
    feedback: DriveFeedback
    loop: DriveLoop
    supervision: Supervision
    fault: Callable[[int, int], None]
    show: Callable[[], None]
