"""Units of the drives: those of the cell, whether its counts fit 32 bits, and those that a device states.

A cell states the units of a drive (`counts_per_turn`, `gear`, `sign`, `zero_counts`), and they count: nothing in a
device is changed for them. Where a device has the factor group of CiA 402, its own statement is compared with the
cell's at bring-up, and 607Eh, which turns positions round, must be as its EDS has it. Speeds and accelerations are
written in the units of 60A9h and 60AAh, which must be as the EDS has them, too.

Source: CiA 402-2, "Factor group": 607Eh, 608Fh, 6091h, 6092h, 60A9h, 60AAh; "Software position limit": 607Dh; 6065h,
607Fh, 6080h; 6064h and 607Ah are INTEGER32.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.planning.node_configuration import TurnUnits
from canprobe.cell.planning.sync import Place, is_profiled
from canprobe.cell.scene.setup import Arm, Drive, Setup
from canprobe.fieldbus.protocol.si_unit import ACCELERATION_UNIT_INDEX, VELOCITY_UNIT_INDEX, rate_unit
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats

POSITION_LIMITS, POLARITY, RESOLUTION, GEAR_RATIO, FEED = 0x607D, 0x607E, 0x608F, 0x6091, 0x6092
PROFILE_SPEED_LIMIT, MOTOR_SPEED_LIMIT, FOLLOWING_WINDOW = 0x607F, 0x6080, 0x6065
PROFILE_SPEED, PROFILE_ACCELERATION, PROFILE_DECELERATION = 0x6081, 0x6083, 0x6084
FOLLOWING_WINDOW_DEG = 5.0
NO_WINDOW = 0xFFFFFFFF
"""Value of 6065h where a drive does not watch the following error."""
LAG_BANDWIDTH = math.sqrt(math.sqrt(2.0) - 1.0) / math.pi
"""Lag behind a ramp, times the -3 dB frequency, of a critically damped loop of second order: 2/w."""
PROFILE_STOP_S = 0.02
"""Longest time in which an arm in profile position brakes from the speed of a motion, s. A drive follows the targets of
a ramp by its way to stop, half of that time behind: joints that lag by different times leave the straight way."""
PROFILE_CYCLES = 2
"""Cycles from a set-point to the next one: bit 4 of the controlword rises in one and falls in the other."""
ROUNDING_COUNTS = 2
"""Counts by which rounding may move two targets apart."""
_LOWEST, _HIGHEST = -(1 << 31), (1 << 31) - 1


@dataclass(frozen=True, slots=True)
class PlannedAxis:
    """A drive of the arm with its device.

    Attributes:
        setup: setup of the scene.
        number: number of the drive from the base, 0-based.
        device: the device by its EDS.
    """

    setup: Setup
    number: int
    device: DeviceCapabilities

    @property
    def drive(self) -> Drive:
        """The drive as the cell describes it."""
        return self.setup.drives[self.number]

    @property
    def model(self) -> ArmModel:
        """The arm."""
        return self.setup.needed_arm().model

    @property
    def fastest(self) -> float:
        """Highest speed, position units/s: all joints that move the motor at their allowed speeds."""
        return float(np.abs(self.model.units_per_q[self.number]) @ self.model.qd_max) * self.setup.limits.speed_share

    @property
    def following_window(self) -> int:
        """Wanted value of 6065h, units: `FOLLOWING_WINDOW_DEG` of the joint."""
        per_radian = self.model.units_per_q[self.number, self.number] * self.model.radian[self.number]
        return round(abs(float(per_radian)) * math.radians(FOLLOWING_WINDOW_DEG))

    @property
    def turn(self) -> TurnUnits | None:
        """The units to compare with the device; None where it states none, or the cell counts no turns."""
        units, gear, has = self.drive.turn_units, self.drive.gear, self.device.has
        whole = {index: has(index, 1) and has(index, 2) for index in (FEED, GEAR_RATIO, RESOLUTION)}
        if units is None or not (whole[FEED] or whole[RESOLUTION]):
            return None
        if not whole[FEED]:
            return TurnUnits(units, gear, RESOLUTION, None)
        return TurnUnits(units, gear, FEED, GEAR_RATIO if whole[GEAR_RATIO] else None)

    @property
    def motor_turn(self) -> tuple[float | None, float]:
        """Position units of a motor turn, None where neither states them; and motor turns per turn of the shaft."""
        feed = self._quotient(FEED)
        ratio = (self._quotient(GEAR_RATIO) or 1.0) if feed else 1.0
        if self.drive.turn_units is not None:
            return self.drive.turn_units, ratio
        lines = self._quotient(RESOLUTION)
        return (feed / ratio if feed and lines else lines), ratio

    def unit(self, index: int) -> float | None:
        """Position units/s in one velocity unit (60A9h) of the device, or /s² in one acceleration unit (60AAh).

        None where its EDS names a unit that the cell's data cannot express.
        """
        turn, ratio = self.motor_turn
        return rate_unit(self.device.number(index) or 0, turn=turn and turn * ratio, metre=self.drive.metre_units)

    def _quotient(self, index: int) -> float | None:
        """Quotient of :01 and :02 by the EDS; None where the device has none."""
        over, under = self.device.number(index, 1), self.device.number(index, 2)
        return over / (under or 1) if over else None


def _axes(setup: Setup, devices: Mapping[int, DeviceCapabilities]) -> list[PlannedAxis]:
    """The drives of the arm, from the base; none without an arm."""
    return [PlannedAxis(setup, number, devices[drive.node_id]) for number, drive in enumerate(setup.drives)]


def range_problems(setup: Setup) -> Iterator[str]:
    """Joints whose positions leave the 32 bits of 6064h and 607Ah, where they would wrap round."""
    arm = setup.arm
    if arm is None or not arm.drives:
        return
    low, high = software_limits(arm.model)
    for joint, drive, least, most in zip(arm.model.joints, arm.drives, low.tolist(), high.tolist(), strict=True):
        if least < _LOWEST or most > _HIGHEST:
            yield (
                f"joints.{joint.name}: drive {drive.node_id} would count from {least:.0f} to {most:.0f} over the range"
                f" of the joint, {joint.text(joint.q_min)} to {joint.text(joint.q_max)}, and 6064h and 607Ah hold"
                f" {_LOWEST} to {_HIGHEST}: check counts_per_turn and gear, then zero_counts; if they are right, home"
                " the drive elsewhere, or let it count in coarser units"
            )


@dataclass(frozen=True, slots=True)
class _SpeedLimit:
    """Limit of speed by an object of a drive, which limits speed or the following error.

    Attributes:
        index: index of the object.
        most: highest speed, position units/s; infinite for none.
        rounding: part of it that the rounding of targets uses up, position units/s.
    """

    index: int
    most: float
    rounding: float

    @property
    def left(self) -> float:
        """Highest speed that the joints may ask for, position units/s."""
        return self.most - self.rounding


def _speed_problems(axes: Iterable[PlannedAxis]) -> Iterator[str]:
    """Problems of drives whose limit of speed is no more than the rounding of targets takes from cycle to cycle."""
    for axis in axes:
        lowest = _lowest_limit(axis, math.inf)
        if lowest.left <= 0.0:
            yield (
                f"joints.{axis.model.joints[axis.number].name}: drive {axis.drive.node_id} allows {lowest.most:.4g}"
                f" units/s by its {lowest.index:04X}h, and whole targets differ by as much as {lowest.rounding:.4g}"
                f" units/s at cycle.rate_hz = {axis.setup.rate_hz:g}: check 60A9h in the EDS, then counts_per_turn and"
                " gear; if they are right, lower cycle.rate_hz"
            )


def software_limits(model: ArmModel) -> tuple[Floats, Floats]:
    """Lowest and highest position of each drive (n,), units, over the ranges of all joints that move it."""
    a, b, zero = model.units_per_q * model.q_min, model.units_per_q * model.q_max, model.zero_units
    return np.floor(np.minimum(a, b).sum(axis=1) + zero), np.ceil(np.maximum(a, b).sum(axis=1) + zero)


def within_drives(setup: Setup, devices: Mapping[int, DeviceCapabilities]) -> tuple[Setup, list[str], tuple[str, ...]]:
    """The setup with joints kept within positions and speeds of their drives.

    Returns:
        The setup, the problems of joints that have no room or speed left, and warnings where that is less.
    """
    beyond = [*range_problems(setup), *_speed_problems(_axes(setup, devices))]
    if setup.arm is None or not setup.drives or beyond:
        return setup, beyond, ()
    setup, ranges = _within_ranges(setup, setup.arm, devices)
    setup, speeds = _within_speeds(setup, _axes(setup, devices))
    if not (profiled := [drive.node_id for drive in setup.drives if is_profiled(devices[drive.node_id])]):
        return setup, [], (*ranges, *speeds)
    lag = 0.5 * PROFILE_STOP_S + PROFILE_CYCLES / setup.rate_hz
    warning = (
        f"nodes {', '.join(map(str, profiled))} have no mode for a target in every cycle (6502h) and go by profile"
        f" position: motions by hand are no faster than the arm stops in {1e3 * PROFILE_STOP_S:g} ms; a higher"
        " acceleration of its joints (acceleration_deg_s2) lets them be faster"
    )
    return setup.changed("arm", profile_lag=lag), [], (*ranges, *speeds, warning)


def profile_values(axis: PlannedAxis) -> dict[Place, int]:
    """Velocity, acceleration and deceleration of a drive in profile position, those of its joints at their limits.

    A unit that the data of the cell cannot express gives the slowest.
    """
    speed = axis.fastest / (axis.unit(VELOCITY_UNIT_INDEX) or math.inf)
    rate = float(np.abs(axis.model.units_per_q[axis.number]) @ axis.model.qdd_max)
    rate /= axis.unit(ACCELERATION_UNIT_INDEX) or math.inf
    values = {PROFILE_SPEED: speed, PROFILE_ACCELERATION: rate, PROFILE_DECELERATION: rate}
    return {(index, 0): max(1, int(value)) for index, value in values.items()}


def _within_speeds(setup: Setup, axes: Iterable[PlannedAxis]) -> tuple[Setup, tuple[str, ...]]:
    """Keep joints within 607Fh, 6080h and 6065h of their drives, beyond which a drive faults."""
    model, share = setup.needed_arm().model, setup.limits.speed_share
    slowest, objects = np.ones(model.n), set()
    for axis in axes:
        lowest = _lowest_limit(axis, axis.fastest)
        if axis.fastest > lowest.left:
            moved = np.flatnonzero(model.units_per_q[axis.number])
            slowest[moved] = np.minimum(slowest[moved], lowest.left / axis.fastest)
            objects.add(lowest.index)
    if not objects:
        return setup, ()
    limits = [replace(joint, qd_max=joint.qd_max * factor) for joint, factor in zip(model.joints, slowest, strict=True)]
    told = ", ".join(
        f"{joint.name} {joint.text(joint.qd_max * share, '.3g')}/s"
        for joint, factor in zip(limits, slowest.tolist(), strict=True)
        if factor < 1.0
    )
    lag = f"their lag of {1e3 * stated_lag_s(setup):.3g} ms (servo.drive_lag_ms, plant.drive_bandwidth_hz), "
    warning = (
        f"{' and '.join(f'{index:04X}h' for index in sorted(objects))}: drives that fault below the speeds of their"
        f" joints; the plan keeps within {told}. If that is wrong, check {lag * (FOLLOWING_WINDOW in objects)}60A9h in"
        " the EDS, then counts_per_turn and gear"
    )
    return setup.changed("arm", model=replace(model, joints=tuple(limits))), (warning,)


def _lowest_limit(axis: PlannedAxis, wanted: float) -> _SpeedLimit:
    """The lowest limit of a drive, where a speed of `wanted` position units/s is needed."""
    device, rounding = axis.device, ROUNDING_COUNTS * axis.setup.rate_hz
    limits = [_SpeedLimit(PROFILE_SPEED_LIMIT, math.inf, 0.0)]
    entry, unit = device.description.entry(PROFILE_SPEED_LIMIT), axis.unit(VELOCITY_UNIT_INDEX)
    if entry is not None and unit is not None and (held := device.number(PROFILE_SPEED_LIMIT)):
        rises = entry.writable and (wanted == math.inf or entry.allows(math.ceil((wanted + rounding) / unit)))
        limits += [] if rises else [_SpeedLimit(PROFILE_SPEED_LIMIT, held * unit, rounding)]
    turn, _ = axis.motor_turn
    if (rpm := device.number(MOTOR_SPEED_LIMIT)) and turn is not None:
        limits.append(_SpeedLimit(MOTOR_SPEED_LIMIT, rpm / 60.0 * turn, rounding))
    entry, window = device.description.entry(FOLLOWING_WINDOW), device.number(FOLLOWING_WINDOW)
    lag = stated_lag_s(axis.setup)
    if entry is not None and window is not None and window != NO_WINDOW and lag > 0.0:
        widens = entry.writable and entry.allows(axis.following_window)
        limits += [] if widens else [_SpeedLimit(FOLLOWING_WINDOW, window / lag, ROUNDING_COUNTS / lag)]
    return min(limits, key=lambda limit: limit.left)


def stated_lag_s(setup: Setup) -> float:
    """Lag of the drives behind a ramp, s: the larger of the scene's and the emulated drives'; 0: unknown.

    That of an external arm has its dead time.
    """
    believed = setup.touch.lag_s if setup.touch is not None else 0.0
    delay_s = setup.arm.delay_s if setup.arm is not None else 0.0
    return max(believed, (LAG_BANDWIDTH / setup.truth.bandwidth_hz if setup.emulates_arm else 0.0) + delay_s)


def lag_s(setup: Setup, unstated_s: float = 0.0) -> float:
    """Lag of the drives behind a ramp with that of profile position, s.

    Args:
        setup: the closed setup.
        unstated_s: lag where none is stated: a bound takes the longest one, s.
    """
    return (stated_lag_s(setup) or unstated_s) + (setup.arm.profile_lag if setup.arm is not None else 0.0)


def _within_ranges(setup: Setup, arm: Arm, devices: Mapping[int, DeviceCapabilities]) -> tuple[Setup, tuple[str, ...]]:
    """Keep joints within 607Dh of their drives, beyond which a drive faults.

    A drive that moves with several joints is left out.
    """
    narrower = []
    joints = list(arm.model.joints)
    low, high = software_limits(arm.model)
    for axis, (joint, drive) in enumerate(zip(arm.model.joints, arm.drives, strict=True)):
        least, most = _guarded(devices[drive.node_id], low[axis], high[axis])
        if (least, most) == (low[axis], high[axis]) or np.count_nonzero(arm.model.units_per_q[axis]) > 1:
            continue
        # a unit inside, so that rounding stays within
        ends = (np.array((least + 1, most - 1)) - arm.model.zero_units[axis]) / arm.model.units_per_q[axis, axis]
        joints[axis] = replace(joint, q_min=max(joint.q_min, min(ends)), q_max=min(joint.q_max, max(ends)))
        narrower.append(f"{joint.name} {joint.shown(min(ends)):.1f} to {joint.text(max(ends))}")
    if not narrower:
        return setup, ()
    warning = (
        f"607Dh: drives that fault before the ends of their joints; the plan keeps within {', '.join(narrower)}. If"
        " that is wrong, check counts_per_turn and gear, then zero_counts"
    )
    return setup.changed("arm", model=replace(arm.model, joints=tuple(joints))), (warning,)


def _guarded(device: DeviceCapabilities, low: float, high: float) -> tuple[float, float]:
    """The part of a range of positions that a drive's 607Dh can allow."""
    lowest, highest = (device.description.entry(POSITION_LIMITS, subindex) for subindex in (1, 2))
    if lowest is None or highest is None:
        return low, high
    ends = (lowest.low if lowest.writable else lowest.initial, highest.high if highest.writable else highest.initial)
    least, most = (end if isinstance(end, int) else None for end in ends)
    if least is not None and most is not None and least >= most:  # no limits
        return low, high
    return low if least is None else max(low, least), high if most is None else min(high, most)
