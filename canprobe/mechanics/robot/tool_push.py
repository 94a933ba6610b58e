"""A push on the tool, from the torques of the motors: a coarse witness beside a force sensor.

An object that pushes with F against the pole of a tool asks `Δτ = F J_mᵀ pole` of the motors, J_m the Jacobian of the
tool's point over the motors. Gravity and the friction of a motor that goes on turning are the same before and after, so
torques are compared with those of a moment before. Friction that may hide a push is part of the standard deviation, not
of the model: a motor at rest takes up to its Coulomb torque without showing any.

`TorqueMean` collects the torques of a short time; `push_since` compares two of them. Source: statics of a serial chain,
`τ = Jᵀ f` (Craig, Introduction to Robotics, 5.9).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.robot.model import ArmModel, joints_per_motor, units_per_motor
from canprobe.mechanics.types import Floats

STICTION_RATE = 0.01
"""Rate of a motor coordinate below which its friction may have any value up to Coulomb's, rad/s or m/s."""
RESOLUTION = 1e-3
"""Resolution of a reported torque over the rated one (6077h counts thousandths)."""
GRAVITY_SHARE = 0.6
"""Change of a joint's gravity torque over its rated one per radian of motion of the arm: of the PUMA 260's joint 2."""
INERTIA_RATIO = 8.0
"""Inertia that a motor moves over that of its own rotor, both at the joint: the links of a small geared arm."""


class PushGeometry:
    """What a push on the tool does to the motors of an arm.

    Args:
        model: the arm.
        flange_tool: transform (4, 4) of the tool's frame, its z along the pole, to the flange.
    """

    def __init__(self, model: ArmModel, flange_tool: Floats) -> None:
        self.model = model
        self._flange_tool = flange_tool
        self._per_motor = joints_per_motor(model)
        rated = np.array([joint.rated_torque for joint in model.joints])
        self.newton_metres: Floats = 1e-3 * rated * np.sign(units_per_motor(model))
        """(n,) torque of each motor per reported permille, N m, or N of a motor that slides."""
        self.rated = rated
        self.coulomb = np.array([joint.coulomb for joint in model.joints])
        self.viscous = np.array([joint.viscous for joint in model.joints])
        self.inertia = INERTIA_RATIO * np.array([joint.rotor_inertia for joint in model.joints])

    def per_newton(self, q: Floats) -> Floats:
        """Torques (n,) that a push of 1 N against the pole asks of the motors at joints (n,), rad or m."""
        T, J = forward_jacobian(self.model.chain, q, self._flange_tool)
        return T[:3, 2] @ J[:3] @ self._per_motor

    def motors(self, q: Floats) -> Floats:
        """Motor coordinates (n,) at joints (n,), up to their zeros."""
        return self.model.units_per_q @ q / units_per_motor(self.model)


@dataclass(frozen=True, slots=True, eq=False)
class TorqueMean:
    """Torques of a short time.

    Attributes:
        torque: (n,) mean, N m or N; NaN for a motor that does not report it.
        variance: (n,) variance of a single report.
        reports: number of reports.
        q: (n,) joints at its end, rad or m.
        x: (n,) motor coordinates at its end.
        way: (n,) way of the motor coordinates in the time `over_s` up to its end.
        over_s: that time, s: longer than the mean, as encoders come in counts; the same in means that are compared.
        last: (n,) way of the motor coordinates in the mean itself.
        force: mean force that the array measured, N.
        seconds: its length, s.
    """

    torque: Floats
    variance: Floats
    reports: int
    q: Floats
    x: Floats
    way: Floats
    over_s: float
    last: Floats
    force: float
    seconds: float

    @property
    def rates(self) -> Floats:
        """(2, n) rates of the motor coordinates, per second: over the longer time, and over the mean itself."""
        return np.array([self.way / self.over_s, self.last / self.seconds])


def push_sigma(geometry: PushGeometry, noise: Floats, now: TorqueMean, before: Sequence[TorqueMean]) -> Floats:
    """Standard deviation (n,) of the change of each motor's torque that no push has made.

    Args:
        geometry: the arm.
        noise: (n,) standard deviation of the two means' difference by the reports' own scatter.
        now, before: the two moments, the earlier one in pieces.
    """
    rates = np.array([one.rates for one in (now, *before)])
    turning = np.tanh(rates / STICTION_RATE)
    friction = geometry.coulomb * (np.ptp(turning, axis=(0, 1)) + 1.0 - np.abs(turning[0]).min(axis=0))
    friction += geometry.viscous * np.ptp(rates, axis=(0, 1))
    gravity = GRAVITY_SHARE * geometry.rated * float(np.linalg.norm(now.x - before[-1].x))
    accelerations = np.abs(rates[:, 1] - rates[:, 0]) / (0.5 * now.over_s)  # by the difference of the two rates
    inertia = geometry.inertia * (accelerations[0] + accelerations[1:].mean(axis=0))
    sigma: Floats = np.sqrt(noise**2 + friction**2 + gravity**2 + inertia**2 + (RESOLUTION * geometry.rated) ** 2)
    return sigma


def steady_sigma(geometry: PushGeometry, q: Floats, rates: Floats, mean_s: float) -> float:
    """Standard deviation, N, of a push on motors that turn steadily.

    Args:
        geometry: the arm.
        q: joints (n,), rad or m.
        rates: rates (n,) of the motor coordinates, per second; those that are measured err by half a count a mean.
        mean_s: length of a mean, s.
    """
    count = 0.5 / np.abs(units_per_motor(geometry.model)) / mean_s
    low, high = (np.tanh((np.abs(rates) + sign * count) / STICTION_RATE) for sign in (-1.0, 1.0))
    sigma = np.hypot(geometry.coulomb * (high - low + 1.0 - np.maximum(low, 0.0)), RESOLUTION * geometry.rated)
    return 1.0 / float(np.linalg.norm(geometry.per_newton(q) / sigma))


def push_since(geometry: PushGeometry, now: TorqueMean, before: Sequence[TorqueMean]) -> tuple[float, float]:
    """Growth of the push against the pole since a moment before, N, and its standard deviation.

    Args:
        geometry: the arm.
        now: the torques now.
        before: those of the moment before, in pieces.

    Returns:
        Both; the deviation is infinite where no motor tells.
    """
    torques = np.array([one.torque for one in before])
    own = np.mean([one.variance for one in before], axis=0)
    pieces = torques.var(axis=0) if len(before) > 1 else np.zeros_like(own)
    noise = np.sqrt(own / now.reports + pieces * (1.0 + 1.0 / len(before)))
    sigma = push_sigma(geometry, noise, now, before)
    change, per_newton = now.torque - torques.mean(axis=0), geometry.per_newton(now.q)
    weight = np.where(np.isfinite(change), per_newton / sigma**2, 0.0)
    information = float(weight @ per_newton)
    if not information > 0.0:
        return 0.0, math.inf
    return float(weight @ np.nan_to_num(change)) / information, 1.0 / math.sqrt(information)
