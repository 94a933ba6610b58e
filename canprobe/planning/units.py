"""Position units of the drives: what the cell states, whether its counts fit 32 bits, and what a device says of them.

A cell states the units of a drive (`counts_per_turn`, `gear`, `sign`, `zero_counts`), and they count: nothing in a
device is changed for them. Where a device has the factor group of CiA 402, its own statement is compared with the
cell's at bring-up, and 607Eh, which turns positions round, must be as its EDS has it.

Source: CiA 402-2, "Factor group": 607Eh, 608Fh, 6091h, 6092h; 6064h and 607Ah are INTEGER32.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from canprobe.planning.devices import Abilities
from canprobe.robot.chain import Array
from canprobe.robot.model import ArmModel
from canprobe.scene.setup import Setup

POLARITY, RESOLUTION, GEAR_RATIO, FEED = 0x607E, 0x608F, 0x6091, 0x6092
ROUNDING_COUNTS = 2
"""By which two targets may be rounded apart."""
_LOWEST, _HIGHEST = -(1 << 31), (1 << 31) - 1
_TOLERANCE = 1e-3
"""Share by which units may differ: a factor of the device is a quotient of integers."""


@dataclass(frozen=True, slots=True)
class TurnUnits:
    """Position units of a motor turn as the cell states them, and the objects in which the device does.

    Attributes:
        units: the cell's, per turn of the motor.
        gear: turns of the motor per turn of the joint.
        feed: 6092h, or 608Fh where the device has no 6092h; the quotient of :01 and :02.
        ratio: 6091h, motor turns per shaft turn; None where the device has none, or no 6092h.
    """

    units: float
    gear: float
    feed: int
    ratio: int | None

    def mismatch(self, feed: float, ratio: float) -> str | None:
        """How the quotients that a device holds differ from the cell; None where they fit.

        A device may take the motor for its shaft, or the joint.

        Args:
            feed: quotient of `feed`.
            ratio: quotient of `ratio`; 1 without.
        """
        by_motor, by_joint = feed / ratio / self.units, feed / (self.units * self.gear)
        if min(abs(by_motor - 1), abs(by_joint - 1)) <= _TOLERANCE:
            return None
        objects = f"{self.feed:04X}h" + (f" and {self.ratio:04X}h" if self.ratio is not None else "")
        return (
            f"counts {feed / ratio:g} units a motor turn by its {objects}, the cell {self.units:g} (counts_per_turn):"
            " check which is right before it moves"
        )


def turn_units(device: Abilities, units: float | None, gear: float) -> TurnUnits | None:
    """What to compare with a device; None where it states nothing, or the cell counts no turns.

    Args:
        device: by its EDS.
        units: per motor turn, of the cell; None: of a prismatic joint.
        gear: turns of the motor per turn of the joint.
    """
    whole = {index: device.has(index, 1) and device.has(index, 2) for index in (FEED, GEAR_RATIO, RESOLUTION)}
    if units is None or not (whole[FEED] or whole[RESOLUTION]):
        return None
    if not whole[FEED]:
        return TurnUnits(units, gear, RESOLUTION, None)
    return TurnUnits(units, gear, FEED, GEAR_RATIO if whole[GEAR_RATIO] else None)


def range_problems(setup: Setup) -> Iterator[str]:
    """Joints whose positions leave the 32 bits of 6064h and 607Ah, where they would wrap round."""
    arm = setup.arm
    if arm is None:
        return
    low, high = software_limits(arm.model)
    for joint, drive, least, most in zip(arm.model.joints, arm.drives, low.tolist(), high.tolist(), strict=True):
        if least < _LOWEST or most > _HIGHEST:
            yield (
                f"joints.{joint.name}: drive {drive.node_id} would count from {least:.0f} to {most:.0f} over the range"
                f" of the joint, {joint.text(joint.q_min)} to {joint.text(joint.q_max)}, and 6064h and 607Ah hold"
                f" {_LOWEST} to {_HIGHEST}: set zero_counts nearer to 0, by homing the drive elsewhere, or let it count"
                " in coarser units"
            )


def motor_speed_limit(model: ArmModel, axis: int, share: float, period_ns: int) -> int:
    """Drive units/s beyond which it must not follow a target: all joints that move the motor, at their limits.

    Args:
        model: the arm.
        axis: of the motor, 0-based.
        share: of the joints' speed limits.
        period_ns: of the cycle; a target is a whole number of drive units.
    """
    fastest = float(np.abs(model.units_per_q[axis]) @ model.qd_max) * share
    return math.ceil(fastest + ROUNDING_COUNTS * 1e9 / period_ns)


def software_limits(model: ArmModel) -> tuple[Array, Array]:
    """Extremes of each drive (n,) and (n,), units, over the joints' ranges; the coupled ones span both joints'."""
    a, b, zero = model.units_per_q * model.q_min, model.units_per_q * model.q_max, model.zero_units
    return np.floor(np.minimum(a, b).sum(axis=1) + zero), np.ceil(np.maximum(a, b).sum(axis=1) + zero)
