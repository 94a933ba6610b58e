"""What every mode of operation shares: the parts of the drive, halt, and the bits of controlword and statusword.

A mode lives between `start` and `leave`, in operation enabled only. One more mode is a class that derives from
`CyclicMode` if it has a target for every SYNC, or from `ProfiledMode` if it makes its own way; `modes.MODES` lists it.
Source: CiA 402-2, controlword bits 4–6, 8 and 9, statusword bits 10–13, halt option code 605Dh.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from canprobe.fieldbus.drive.parameters import PEAK_PERMILLE, Delivery, DriveParameters, Units
from canprobe.fieldbus.drive.reference import STEP_NS, AxisPlant, Motion
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.frames import FOLLOWING_ERROR, RPDO_TIMEOUT, SYNC_LOST

# What a drive gives to the plant's position loop: the torque limit 6072h and the feed-forwards 60B1h and 60B2h.
#
# The feed-forwards act in the mode that gives them; leaving it takes them back. In cyclic synchronous velocity 60B1h is
# part of the target already, and in cyclic synchronous torque both are: there the loop gets none. Outside operation
# enabled the loop stands for the closed brake. A brake that opens before the motor has torque (`Quirks`) is a loop
# without torque for that time: a vertical axis of a dynamic arm falls.
# Source: CiA 402-2, objects 6072h, 60B1h, 60B2h.

_LIMIT, _SPEED, _TORQUE = 0x6072, 0x60B1, 0x60B2


class DriveLoop:
    """Torque limit and feed-forwards of one axis; the plant gets changes only.

    Args:
        axis: of the plant, 0-based.
        plant: shared with the other drives.
        parameters: of the drive.
        node: of the drive.

    Attributes:
        changed: a position mode has to `feed_forward` in this cycle.
    """

    def __init__(self, axis: int, plant: AxisPlant, parameters: DriveParameters, node: SlaveNode) -> None:
        dictionary = node.dictionary
        self._axis, self._plant, self._parameters, self._number = axis, plant, parameters, dictionary.number
        self._early_ns = node.core.quirks.brake_early_ns
        self._torque_comes = node.core.timers.new(lambda _due_ns: self._give(*self._given[1:]))
        self._given: tuple[int, float, float] = (PEAK_PERMILLE, 0.0, 0.0)
        self.changed = True
        for index in (_LIMIT, _SPEED, _TORQUE):
            dictionary.on_write(index, lambda _sub, _value: self._give(*self._given[1:]))

    def open_brake(self, t_ns: int) -> None:
        """Operation is enabled."""
        if self._early_ns:
            self._torque_comes.arm(t_ns + self._early_ns)
            self._give(*self._given[1:])

    def close_brake(self) -> None:
        """Operation is no longer enabled, or is stopping by torque."""
        if self._torque_comes.due_ns is not None:
            self._torque_comes.cancel()
            self._give(*self._given[1:])

    def feed_forward(self) -> None:
        """Take limit and offsets as they are now."""
        self._give(self._number(_SPEED) * self._parameters.units.speed_scale, float(self._number(_TORQUE)))
        self.changed = False

    def feed_torque(self) -> None:
        """Take limit and torque offset: every cycle of a velocity mode."""
        self._give(0.0, float(self._number(_TORQUE)))

    def release(self) -> None:
        """Limit only."""
        self._give(0.0, 0.0)

    def _give(self, speed: float, torque: float) -> None:
        self.changed = True
        limit = self._parameters.max_torque if self._torque_comes.due_ns is None else 0
        wanted = (limit, speed, torque)
        if wanted != self._given:
            self._given = wanted
            self._plant.set_loop(self._axis, *wanted)


# What a drive reports of itself: actual and demand values, brought up to date only where somebody reads them.
#
# Positions and velocities are in the units of the factor group, torques in 1/1000 of the rated torque.
# Source: CiA 402-2, objects 6062h, 6064h, 606Bh, 606Ch, 6074h, 6077h, 60F4h, 60FDh.

_I16, _I32 = 1 << 15, 1 << 31
_TORQUES = (0x6074, 0x6077)
NEGATIVE_SWITCH, POSITIVE_SWITCH = 1, 2
"""Bits of 60FDh."""


class DriveFeedback:
    """Actual values of one axis.

    Args:
        node: the drive's.
        axis: of the plant, 0-based.
        plant: shared with the other drives.
        motion: reference of the axis.
        units: of the drive.
        noise: what the encoder adds to a position, counts; None: nothing.

    Attributes:
        counts: motor position at the last `measure`.
        plant_torque: returns the torque that the plant needs for its motion now, permille.
    """

    def __init__(
        self,
        node: SlaveNode,
        axis: int,
        plant: AxisPlant,
        motion: Motion,
        units: Units,
        *,
        noise: Callable[[], float] | None,
    ) -> None:
        self._core, self._axis, self._plant, self._units, self._noise = node.core, axis, plant, units, noise
        self.counts = 0.0
        self._velocity = 0.0
        self._t_ns: int | None = None
        self.plant_torque = partial(plant.torque_permille, axis)
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
                sample = self._sampler(index, _I16 if index in _TORQUES else _I32)
                node.pdos.on_trigger(index, sample)
                node.dictionary.on_read(index, lambda _sub, sample=sample: sample(self._core.now_ns))  # type: ignore[misc]

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
            if self._noise is not None:
                counts += self._noise()
            if last_ns is not None:
                self._velocity = (counts - self.counts) / (t_ns - last_ns) * 1e9
            self.counts, self._t_ns = counts, t_ns
        return self.counts

    def switch_positions(self) -> tuple[float, float]:
        """Of the negative and the positive limit switch, counts: the negative one ends motion to lower positions."""
        low, high = self._plant.limit_switches(self._axis)
        return (low, high) if self._units.scale > 0.0 else (high, low)

    def switches(self) -> int:
        """Which limit switches are active: bits 0 (negative) and 1 (positive) of 60FDh."""
        low, high = self._plant.limit_switches(self._axis)
        counts = self._plant.motor_counts(self._axis)
        below, above = counts <= low, counts >= high
        negative, positive = (below, above) if self._units.scale > 0.0 else (above, below)
        return NEGATIVE_SWITCH * negative | POSITIVE_SWITCH * positive

    def show_torque(self, source: Callable[[], float]) -> None:
        """Take the torque, permille, from `source` from now on: the plant's, or that of a mode that controls it."""
        self._sources.update(dict.fromkeys(_TORQUES, source))

    def _sampler(self, index: int, limit: int) -> Callable[[int], None]:
        """What puts a value into the dictionary, as a whole number within +-limit."""
        values, key, sources, least, most = self._core.dictionary.values, index << 8, self._sources, -limit, limit - 1

        def sample(t_ns: int) -> None:
            if t_ns != self._t_ns:
                self.measure(t_ns)
            number = round(sources[index]())
            values[key] = number if least <= number <= most else min(max(number, least), most)

        return sample


# What makes a drive stop by itself in operation enabled: a silent master, and a motor that does not follow.
#
# Source: CiA 402-2, objects 6065h and 6066h; CiA 301, error codes 8100h and 8250h.


class Supervision:
    """Counts missed SYNCs and targets between `start` and `stop`.

    Attributes:
        outside_ns: since when the following error has been outside 6065h; None while it is inside.
        watching: between `start` and `stop`, in a mode that lives by SYNC.
    """

    def __init__(self, node: SlaveNode, parameters: DriveParameters, on_loss: Callable[[int, int], None]) -> None:
        """`on_loss(code, t_ns)` is called when the master is taken for dead."""
        self.watching = False
        self._node, self._parameters, self._on_loss = node, parameters, on_loss
        self._timer = node.core.timers.new(self._sync_missing)
        self._misses = 0
        self._by_rpdo = False
        self.outside_ns: int | None = None

    def start(self, target: int | None, t_ns: int) -> None:
        """Operation is enabled, in a mode that lives by SYNC and the object `target`, or by neither (None)."""
        self._misses = 0
        self.outside_ns = None
        self._timer.cancel()
        self.watching = target is not None
        if target is not None:
            self._by_rpdo = self._node.pdos.receives(target)
            if patience_ns := self._parameters.patience_ns:
                self._timer.arm(t_ns + patience_ns)

    def stop(self) -> None:
        """Operation is no longer enabled."""
        self.watching = False
        self._timer.cancel()

    def sync(self, fresh: bool, t_ns: int) -> None:
        """A SYNC came, with a target since the last one (fresh) or without."""
        if patience_ns := self._parameters.patience_ns:
            self._timer.arm(t_ns + patience_ns)
        if fresh or not self._by_rpdo:
            self._misses = 0
            return
        self._misses += 1
        if 0 < self._parameters.misses <= self._misses:
            self._lose(RPDO_TIMEOUT, t_ns)

    def _sync_missing(self, due_ns: int) -> None:
        self._lose(SYNC_LOST, due_ns)

    def _lose(self, code: int, t_ns: int) -> None:
        self._node.emcy.report(code)
        self._on_loss(code, t_ns)


# What every mode of operation shares: the drive's parts, the controlword's own bits, halt, and the statusword's.

REACHED = 1 << cia402.TARGET_REACHED
FOLLOWS = 1 << cia402.DRIVE_FOLLOWS


class DriveParts:
    """The parts of one drive, which its application and its modes share.

    Args:
        node: the drive's.
        axis: of the plant, 0-based.
        plant: shared with the other drives.
        fault: `fault(code, t_ns)` when a mode has found one.
        on_loss: `on_loss(code, t_ns)` when the master is taken for dead.
        show: the mode's part of the statusword may have changed.
        delivery: what its EDS does not say.
        noise: of the encoder, counts; None: it has none.
    """

    def __init__(
        self,
        node: SlaveNode,
        axis: int,
        plant: AxisPlant,
        *,
        fault: Callable[[int, int], None],
        on_loss: Callable[[int, int], None],
        show: Callable[[], None],
        delivery: Delivery,
        noise: Callable[[], float] | None,
    ) -> None:
        self.node, self.axis, self.plant, self.fault, self.show = node, axis, plant, fault, show
        self.parameters = DriveParameters(node.dictionary, delivery)
        self.motion = Motion(axis, plant, node.core.timers)
        self.feedback = DriveFeedback(node, axis, plant, self.motion, self.parameters.units, noise=noise)
        self.supervision = Supervision(node, self.parameters, on_loss)
        self.loop = DriveLoop(axis, plant, self.parameters, node)


class DriveMode:
    """Mode 0, none: it stands still. Base of the others.

    Attributes:
        number: in 6060h; bit number - 1 of 6502h.
        needs: dictionary keys of the objects without which the EDS does not describe the mode.
        target: index of the object that a cyclic mode lives by; None: SYNC and RPDOs are not watched.
        limited: statusword bit 11.
        halted: controlword bit 8.
    """

    number = OperationMode.NONE
    needs: tuple[int, ...] = ()
    target: int | None = None

    def __init__(self, parts: DriveParts) -> None:
        self.parts = parts
        self._motion, self._parameters, self._units = parts.motion, parts.parameters, parts.parameters.units
        self._supervision, self._values = parts.supervision, parts.node.dictionary.values
        self.limited = self.halted = False
        self._standstill = False
        self._word = 0

    def reset(self) -> None:
        """Power on."""

    def start(self, word: int, t_ns: int) -> None:
        """The mode takes over; the reference stands, or slows down. `word` is the present controlword."""
        self._word = word
        self.limited = self._standstill = False
        self.halted = bool(word >> cia402.HALT & 1)
        if self.halted:
            self._halt(t_ns)

    def leave(self, t_ns: int) -> None:
        """Another mode takes over, or operation is disabled."""
        self.parts.loop.release()

    def sync(self, t_ns: int, counts: float) -> None:
        """A SYNC; the motor is at `counts`."""

    def status(self) -> int:
        """Bits 10, 12 and 13 of the statusword."""
        return REACHED if self._standstill else 0

    def command(self, word: int, t_ns: int) -> None:
        """The controlword changed; all values that came with it are stored."""
        changed, self._word = word ^ self._word, word
        if changed >> cia402.HALT & 1:
            self.halted = bool(word >> cia402.HALT & 1)
            if self.halted:
                self._halt(t_ns)
            else:
                self._standstill = False
                self.resume(t_ns)
        self.bits(word, changed, t_ns)
        self.parts.show()

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """The controlword's bits beside halt."""

    def resume(self, t_ns: int) -> None:
        """Halt is over."""

    def _halt(self, t_ns: int) -> None:
        self._motion.decelerate(t_ns, self._parameters.halt_rate, self._at_standstill)

    def _at_standstill(self, t_ns: int) -> None:
        self._standstill = True
        self.parts.show()

    def _limit(self, limited: bool) -> None:
        if limited is not self.limited:
            self.limited = limited
            self.parts.show()

    def _strains(self) -> bool:
        """Whether the motion takes all of 6072h, or more, which an ideal plant gives all the same."""
        limit = self._parameters.max_torque
        return limit < PEAK_PERMILLE and abs(self.parts.feedback.plant_torque()) >= limit

    def _lags(self, t_ns: int, counts: float) -> bool:
        """Watch the following error; True when it has become a fault."""
        error, supervision = self._motion.demand(t_ns) - counts, self._supervision
        if abs(error) <= self._parameters.following_window:
            supervision.outside_ns = None
            return False
        if supervision.outside_ns is None:
            supervision.outside_ns = t_ns
        if t_ns - supervision.outside_ns < self._parameters.following_timeout_ns:
            return False
        self.parts.fault(FOLLOWING_ERROR, t_ns)
        return True


class ProfiledMode(DriveMode):
    """A mode that makes its own profile; while its timer runs it looks at the motor every `STEP_NS`."""

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._timer = parts.node.core.timers.new(self._look)

    def leave(self, t_ns: int) -> None:
        """Look no more."""
        self._timer.cancel()

    def watch(self, t_ns: int, counts: float) -> None:
        """The motor is at `counts`, and its following error is no fault."""

    def _look(self, due_ns: int) -> None:
        t_ns = self.parts.node.core.now_ns  # a late timer sees the motor of now
        counts = self.parts.feedback.measure(t_ns)
        if not self._lags(t_ns, counts):
            self._timer.arm_next(due_ns, STEP_NS)
            self.watch(t_ns, counts)


class CyclicMode(DriveMode):
    """A mode with a target for every SYNC, until the master is taken for dead.

    Attributes:
        repeats: without a new target the last one is latched again.
        lags: the following error is watched.
    """

    target: int
    repeats, lags = True, False

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._fresh = self._commanded = False
        parts.node.dictionary.on_write(self.target, self._target_written)

    def start(self, word: int, t_ns: int) -> None:
        """Nothing is followed until a target comes."""
        self._fresh = self._commanded = False
        super().start(word, t_ns)

    def status(self) -> int:
        """The drive follows the command value, unless halted."""
        return super().status() if self.halted else FOLLOWS

    def sync(self, t_ns: int, counts: float) -> None:
        """Watch the following error and the master, latch the target."""
        if self.lags and self._lags(t_ns, counts):
            return
        fresh, self._fresh = self._fresh, False
        supervision = self._supervision
        supervision.sync(fresh, t_ns)
        self._commanded = fresh or (self._commanded and self.repeats)
        if self._commanded and not self.halted and supervision.watching:
            self.latch(t_ns)

    def latch(self, t_ns: int) -> None:
        """Follow the target from now on."""

    def _target_written(self, subindex: int, value: Value) -> None:
        self._fresh = True
