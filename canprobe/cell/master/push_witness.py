"""The drives as a witness of the force: a push that grows in their torques and not in the array's force.

One-sided and coarse: a push that the array measures needs no torque that shows it, and what friction may hide is stated
as standard deviation (`canprobe.mechanics.robot.tool_push`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.mechanics.robot.model import ArmModel, units_per_motor
from canprobe.mechanics.robot.tool_push import PushGeometry, TorqueMean, push_since
from canprobe.mechanics.touch.stops import LEAST_PUSH_SHARE, PUSH_SIGMAS, TORQUE_MEAN_NS
from canprobe.mechanics.types import Floats

LATEST, OLDEST = 4, 20
"""Ages of the means that the present one is compared with, in means: 0.1 to 0.5 s."""
EARLY_EVERY, EARLY = 4, 80
"""One mean in so many is kept for longer, and how many: 8 s. The force of a slow approach grows so little in half a
second that its growth looks like noise of the torques, until hundreds of newtons press."""
LEAST_LIKE, MOST_LIKE, LIKE_SHARE, LIKE_COUNTS = 3, 8, 0.3, 1.5
"""Number of means from which on only those count in which the motors turned as they do now, the last of them; and by
how much their way in `LATEST` means may differ: relative, and in counts of the drive. Friction differs elsewhere."""


class PushWitness:
    """Compares the push in the drives' torques with the force that the array measures.

    Args:
        model: the arm.
        flange_tip: transform (4, 4) of the probe's tip, z = pole, to the flange.
        force_max: limit of the force, N.

    Attributes:
        sigma: standard deviation of the last comparison, N; infinite before one.
        unfelt: push beyond the measured force, N, where it is certain; None otherwise.
    """

    def __init__(self, model: ArmModel, flange_tip: Floats, force_max: float) -> None:
        self._geometry = PushGeometry(model, flange_tip)
        self._least = LEAST_PUSH_SHARE * force_max
        self._least_way = LIKE_COUNTS / np.abs(units_per_motor(model))
        self._means: deque[TorqueMean] = deque(maxlen=OLDEST + 1)
        self._early: deque[TorqueMean] = deque(maxlen=EARLY)
        self._count = 0
        self.sigma = float("inf")
        self.unfelt: float | None = None
        self._showed = False
        self._restart(None)

    def step(self, measurement: Measurement, force: float) -> None:
        """Take the torques of a cycle and the force that the array measures, N."""
        q = measurement.q
        if q is None or any(measurement.q_age) or not measurement.torque_permille:
            return
        if self._since is None or not measurement.enabled:
            self._restart(measurement)
            return
        self._torques.append(measurement.torque_permille)
        self._force += force
        since_ns = measurement.t_ns - self._since.t_ns
        if since_ns < TORQUE_MEAN_NS:
            return
        torques = np.array(self._torques) * self._geometry.newton_metres
        x = self._geometry.motors(q)
        earlier = self._means[-LATEST] if len(self._means) >= LATEST else None
        self._means.append(
            TorqueMean(
                torques.mean(axis=0),
                torques.var(axis=0),
                len(torques),
                q,
                x,
                x - earlier.x if earlier is not None else np.full_like(x, np.nan),
                LATEST * TORQUE_MEAN_NS * 1e-9,
                x - self._means[-1].x if self._means else np.full_like(x, np.nan),
                self._force / len(torques),
                since_ns * 1e-9,
            )
        )
        self._restart(measurement)
        if len(self._means) > 2 * LATEST + LEAST_LIKE:
            self._compare()
        self._count += 1
        if self._count % EARLY_EVERY == 0:
            self._early.append(self._means[-1])

    def _restart(self, measurement: Measurement | None) -> None:
        self._since = measurement
        self._torques: list[tuple[float, ...]] = []
        self._force = 0.0

    def _compare(self) -> None:
        means = list(self._means)
        now, recent = means[-1], [one for one in means[:-LATEST] if math.isfinite(one.way[0])]
        like, early = self._alike(recent, now), self._alike(self._early, now)
        shows = False
        # of the earlier ones the oldest, since which a slow push has grown most
        for before in (like[-MOST_LIKE:] if len(like) >= LEAST_LIKE else recent, early[:MOST_LIKE]):
            if len(before) >= LEAST_LIKE and not shows:
                push, self.sigma = push_since(self._geometry, now, before)
                unfelt = push - (now.force - float(np.mean([one.force for one in before])))
                shows = unfelt > max(PUSH_SIGMAS * self.sigma, self._least)
        self.unfelt = unfelt if shows and self._showed else None
        self._showed = shows

    def _alike(self, before: Collection[TorqueMean], now: TorqueMean) -> list[TorqueMean]:
        """Those before now in which the motors turned as they do now."""
        if not before:
            return []
        differs = np.abs(np.array([one.way for one in before]) - now.way)
        alike = np.all(differs <= LIKE_SHARE * np.abs(now.way) + self._least_way, axis=1)
        return [one for one, is_alike in zip(before, alike.tolist(), strict=True) if is_alike]
