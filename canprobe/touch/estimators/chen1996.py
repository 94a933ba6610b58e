"""`chen1996`: the paper's own scheme, with the rates of a robot and its pad."""

from __future__ import annotations

import math

import numpy as np

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array
from canprobe.touch.batch import Touches, working_frame
from canprobe.touch.chen import solve_paper, usable_lag
from canprobe.touch.contact import ContactSample
from canprobe.touch.differences import Pairs
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.estimators.base import WindowEstimator
from canprobe.touch.frames import cross, rotation_vector


class Chen1996Estimator(WindowEstimator):
    """(24)–(35) over a window, from W = ω × n, V and v as differences of samples `lag` apart (`chen`).

    Args:
        sigma_point, sigma_normal: effective noise, m and rad; they only enter covariance and flags.
        window: samples kept.
        lag: samples between the two of a difference. 1 is the paper's; noise of the points then swamps the motion.
    """

    least = 3

    def __init__(self, *, sigma_point: float, sigma_normal: float, window: int, lag: int = 10) -> None:
        super().__init__(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window)
        if lag < 1:
            raise UsageError(f"lag: expected at least 1 sample, got {lag}")
        self._lag = lag

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        samples = list(self._samples)
        lag = usable_lag(len(samples), self._lag)
        newer = np.arange(lag, len(samples))
        rates = [paper_rates(samples[i - lag], samples[i]) for i in newer]
        R = working_frame(touches)[:3, :3]
        x, y = np.array([r[0] for r in rates]) @ R, np.array([r[1] for r in rates]) @ R
        return solve_paper(touches, Pairs(newer, newer - lag, y / touches.extent, -x))


def paper_rates(older: ContactSample, newer: ContactSample) -> tuple[Array, Array]:
    """x (28) and y (29) times the time between two samples, in base axes; the object stands still.

    `x = ω × n_f + K_f v_f`, `y = V_f + v_f`, everything taken half-way; K_f = 1/|r_probe|.
    """
    Ra, Rb = older.T_base_probe[:3, :3], newer.T_base_probe[:3, :3]
    turn = rotation_vector(Rb @ Ra.T)
    arm = 0.5 * (Ra @ older.r_probe + Rb @ newer.r_probe)
    slide = 0.5 * (Ra + Rb) @ (newer.r_probe - older.r_probe)
    radius = math.sqrt(float(newer.r_probe @ newer.r_probe))
    V = newer.T_base_probe[:3, 3] - older.T_base_probe[:3, 3] + cross(turn, arm)
    return cross(turn, -0.5 * (older.n_base + newer.n_base)) + slide / radius, V + slide
