"""The scheme of Chen, Rink and Zhang (1996), (24)–(35), over a window.

From a stretch of contact, in the contact frame of its last sample: `x_i = −S y_i` (27) with `x_i = ω × n_f + S_f v_f`
(28), `y_i = V + v` (29), assembled to `A c = b` (30)–(34) with the boundary row. What is not in print, and had to be
settled:

- S in (27)–(28) means 2S (of both bodies): as printed, (28) drops the factor 2 on S' and κ would be wrong by it.
- All y_i4 are 0, so the columns of c14, c24, c34, c44 vanish: A has rank 7 at most, (35) is singular for every
  motion. Its solution of least norm is that of the six unknowns that are left (`solve_pairs`), in the gauge
  c14 = c24 = c44 = 0, c34 = −½.
- Rates are differences of samples `lag` apart.

Faults of the scheme that are reproduced: a bias of some percent where |∇f| is not constant, and noise in y that draws κ
towards 0.

Source: Chen, Rink and Zhang, "Local object shape from tactile sensing", section 4.1.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.differences import Pairs, solve_pairs, usable_lag
from canprobe.mechanics.touch.estimate.likelihood import ContactBatch, working_frame
from canprobe.mechanics.touch.estimate.window import WindowEstimator
from canprobe.mechanics.touch.linear_algebra import whole
from canprobe.mechanics.touch.tangent_frames import rotation_vectors
from canprobe.mechanics.types import Floats


class Chen1996Estimator(WindowEstimator):
    """The paper's own scheme, with the rates of a robot and its pad.

    Args:
        sigma_point, sigma_normal, window: as for `WindowEstimator`.
        lag: number of samples between the two of a difference. The paper has 1, with which the noise of the points is
            larger than the motion.
    """

    least = 3

    def __init__(self, *, sigma_point: float, sigma_normal: float, window: int, lag: int = 10) -> None:
        super().__init__(sigma_point=sigma_point, sigma_normal=sigma_normal, window=window)
        self._lag = whole("lag", lag, 1, "sample")

    def _row(self, sample: ContactSample) -> Sequence[float]:
        """With the probe's pose, row by row, and the contact in its frame."""
        return (*super()._row(sample), *sample.T_base_probe[:3].ravel().tolist(), *sample.r_probe.tolist())

    def _solve(self, touches: ContactBatch) -> SurfaceEstimate:
        rows = np.array(self._rows)
        lag = usable_lag(len(rows), self._lag)
        newer = np.arange(lag, len(rows))
        rates = paper_rates(rows[:, 11:23].reshape(-1, 3, 4), rows[:, 23:], touches.normals, lag)
        x, y = np.array(rates) @ working_frame(touches)[:3, :3]
        return solve_pairs(touches, Pairs(newer, newer - lag, y / touches.extent, -x), "chen1996")


def paper_rates(T_base_probe: Floats, r_probe: Floats, n_base: Floats, lag: int) -> tuple[Floats, Floats]:
    """x (28) and y (29), each (n − lag, 3), times the time between samples `lag` apart; the object stands still.

    `x = ω × n_f + K_f v_f`, `y = V_f + v_f`, in base axes, all taken half-way between the samples; K_f = 1/|r_probe|.

    Args:
        T_base_probe: (n, 3 or 4, 4) poses of the probe, m.
        r_probe: (n, 3) contact points in its frame, m.
        n_base: (n, 3) outward unit normals of the object there.
        lag: number of samples between the two of a difference.
    """
    R, r = T_base_probe[:, :3, :3], r_probe[:, :, None]
    Ra, Rb, ra, rb = R[:-lag], R[lag:], r[:-lag], r[lag:]
    n = 0.5 * (n_base[:-lag] + n_base[lag:])
    turn = rotation_vectors(Rb @ Ra.transpose(0, 2, 1))
    arm = (0.5 * (Ra @ ra + Rb @ rb))[:, :, 0]
    slide = (0.5 * (Ra + Rb) @ (rb - ra))[:, :, 0]
    V = T_base_probe[lag:, :3, 3] - T_base_probe[:-lag, :3, 3] + np.cross(turn, arm)
    return slide / np.linalg.norm(rb, axis=1) - np.cross(turn, n), V + slide
