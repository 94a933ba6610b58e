"""Drive cascade of a motor: position loop, velocity loop, torque limit, feed-forwards.

Position: ``v* = kp (r - x) + share r'``. Velocity: ``u = Kv (v* - v) + s + tau_ff``, ``s' = Ki (v* - v)``, where s
also unwinds while the torque is at its limit. Torque: ``min(max(u, -limit), limit)``, without a lag of its own. All in
motor coordinates (``robot.actuation``). The loops are continuous; a real drive samples them at some kHz.

With ``kp = w / 2z`` and ``Kv = 2 z w J`` a motor with the inertia J and nothing else is the second-order system of
the ideal arm: same bandwidth, same lag behind a ramp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from canprobe.emulator.plant.arm import natural_frequency
from canprobe.robot.actuation import CONTINUOUS_TORQUE_NM, PEAK_PERMILLE
from canprobe.robot.puma260 import Array


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """How the six drives are tuned.

    Args:
        bandwidth_hz: -3 dB frequency of position.
        damping_ratio: 1 is critical.
        integral_s: reset time of the velocity loop; 0 for none.
        velocity_feed_forward: share of the reference's speed that is added behind the position loop; 1 removes the lag.
        torque_limit_permille: of the continuous torque.
    """

    bandwidth_hz: float = 30.0
    damping_ratio: float = 1.0
    integral_s: float = 0.02
    velocity_feed_forward: float = 0.0
    torque_limit_permille: int = PEAK_PERMILLE


class Cascade:
    """Gains of six drives, motor coordinates, SI.

    Args:
        settings: the tuning.
        inertia: (6,) what each drive takes for its motor's inertia, kg m^2.
    """

    def __init__(self, settings: DriveSettings, inertia: Array) -> None:
        w, z = natural_frequency(settings.bandwidth_hz, settings.damping_ratio), settings.damping_ratio
        self.position = w / (2.0 * z)
        self.velocity: Array = 2.0 * z * w * inertia
        self.integral: Array = self.velocity / settings.integral_s if settings.integral_s > 0.0 else 0.0 * inertia
        self.unwind = 1.0 / settings.integral_s if settings.integral_s > 0.0 else 0.0
        self.share = settings.velocity_feed_forward
        self.limit: Array = np.array(CONTINUOUS_TORQUE_NM) * (1e-3 * settings.torque_limit_permille)

    @property
    def lag_s(self) -> float:
        """How far a motor stays behind a steady ramp, s."""
        return (1.0 - self.share) / self.position
