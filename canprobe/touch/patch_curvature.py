"""The contact patch as a second sensor: curvature from the second moments of tactile images, fused with the motion's.

The moments are averaged over the last frames, in axes that follow the contact normal, and compared with a calibrated
model of the sensor (`patch_moments`). What gains, hysteresis and blur do to them is common to all images of a contact:
however many are averaged, the patch never knows more than the calibration's floor.

In the fusion the patch speaks where it knows more than the motion does, combination by combination of K; elsewhere it
is not asked. A point-and-normal estimate along a path that excites all of K is better than any image.

Source: ESTIMATION §3; Winkler layer, see `patch_moments`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.contact import ContactSample
from canprobe.touch.frames import tangent_rotation, transported_rotation
from canprobe.touch.patch_moments import MomentModel
from canprobe.touch.rank import turned

LEAST_FRAMES = 8
"""Fewer frames make no estimate."""
MOST_FRAMES = 64
"""Frames that the running mean reaches back: 0.3 s at 200 Hz, 8 mm at 25 mm/s."""
ROUNDS = 4
"""Gauss–Newton steps: the third changes K by less than 1e-3 of itself."""
_ROOT2 = math.sqrt(2.0)
_TO_Q = np.array([1.0, _ROOT2, 1.0])


class CurvatureInformation(NamedTuple):
    """What a source says about q = (K11, √2 K12, K22) in some contact frame.

    Attributes:
        q: (3,) its own value, 1/m; counts only where there is information.
        information: (3, 3) inverse covariance, m².
    """

    q: Array
    information: Array


class PatchCurvature:
    """Running mean of second moments in axes that are carried along with the contact normal.

    Args:
        model: of the sensor.

    Attributes:
        frames: how many the mean stands for, at most `MOST_FRAMES`.
        refused: contacts without moments (saturated, at the pad's edge, hardly any taxel, or a sensor that sends none).
    """

    def __init__(self, model: MomentModel) -> None:
        self.model = model
        self.refused = 0
        self.reset()

    def reset(self) -> None:
        """Forget all images: contact was lost."""
        self.frames = 0
        self.force = 0.0
        self._R = np.eye(3)
        self._xx = self._xy = self._yy = 0.0

    def add(self, sample: ContactSample) -> None:
        """Take the image of one contact."""
        if sample.moments is None:
            self.refused += 1
            return
        inward = -sample.n_base
        self._R = transported_rotation(self._R, inward) if self.frames else tangent_rotation(inward)
        self.frames = min(self.frames + 1, MOST_FRAMES)
        share = 1.0 / self.frames
        c, s = self._pad_axis(sample)
        xx, xy, yy = _turned(*sample.moments, c, s)
        self._xx += share * (xx - self._xx)
        self._xy += share * (xy - self._xy)
        self._yy += share * (yy - self._yy)
        self.force += share * (sample.force_n - self.force)

    def _pad_axis(self, sample: ContactSample) -> tuple[float, float]:
        """Cosine and sine of the angle from x of the carried axes to u of the pad, both about the inward normal."""
        x, y, z = sample.r_probe.tolist()
        k = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = k * x, k * y, k * z
        # the pad's u axis, turned from the pole to the contact the shortest way
        bend = x / (1.0 + z)
        u = sample.T_base_probe[:3, :3] @ np.array([1.0 - bend * x, -bend * y, -x])
        cx, cy, _ = (u @ self._R).tolist()
        size = 1.0 / math.hypot(cx, cy)
        return cx * size, cy * size

    def information(
        self, T_base_contact: Array, motion: CurvatureInformation | None = None
    ) -> CurvatureInformation | None:
        """What the patch adds in a contact frame, linearised where patch and motion together put K.

        Args:
            T_base_contact: (4, 4) contact frame, z inward.
            motion: what else is known about q there; combinations that it knows better are left to it.

        Returns:
            Value and information; None from too few frames, or where the patch is outside the calibration.
        """
        if self.frames < LEAST_FRAMES:
            return None
        x = self._R.T @ T_base_contact[:3, 0]
        size = math.hypot(x[0], x[1])
        xx, xy, yy = _turned(self._xx, self._xy, self._yy, x[0] / size, -x[1] / size)
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        principal = (mean + half, 0.0, mean - half)
        turn = turned(angle)  # q in the contact frame to q in the patch's principal axes
        known = None if motion is None else CurvatureInformation(turn @ motion.q, turn @ motion.information @ turn.T)
        found = self._solve(principal, known)
        return None if found is None else CurvatureInformation(turn.T @ found.q, turn.T @ found.information @ turn)

    def _solve(self, v: tuple[float, float, float], motion: CurvatureInformation | None) -> CurvatureInformation | None:
        start = self.model.start(v, self.force / self.model.fit.force_ratio)
        if start is None:
            return None
        q = np.array(start) * _TO_Q
        try:
            for _ in range(ROUNDS):
                J, r = self.model.linearised(v, self.force, self.frames, _entries(q))
                own = CurvatureInformation(q + np.linalg.solve(J, r), J.T @ J)
                used = own if motion is None else own._replace(information=_better(own.information, motion.information))
                q = own.q if motion is None else mean_of(motion, used)
        except (ValueError, np.linalg.LinAlgError):
            return None
        return used if self.model.covers(_entries(q), self.force / self.model.fit.force_ratio) else None


def _turned(xx: float, xy: float, yy: float, c: float, s: float) -> tuple[float, float, float]:
    """A symmetric tensor in other axes, in which the old x axis has the components c, s."""
    cc, cs, ss = c * c, c * s, s * s
    return cc * xx - 2.0 * cs * xy + ss * yy, cs * (xx - yy) + (cc - ss) * xy, ss * xx + 2.0 * cs * xy + cc * yy


def _entries(q: Array) -> tuple[float, float, float]:
    q1, q2, q3 = q.tolist()
    return q1, q2 / _ROOT2, q3


def _better(own: Array, motion: Array) -> Array:
    """The part of a definite information (3, 3) about combinations that the motion knows less well."""
    L = np.linalg.cholesky(own)
    half = np.linalg.solve(L, motion)
    ratio, W = np.linalg.eigh(np.linalg.solve(L, half.T))
    kept = L @ W[:, ratio < 1.0]
    result: Array = kept @ kept.T
    return result


def mean_of(a: CurvatureInformation, b: CurvatureInformation) -> Array:
    """(3,) the value nearest to both; combinations that neither knows stay at 0."""
    result: Array = np.linalg.lstsq(
        a.information + b.information, a.information @ a.q + b.information @ b.q, rcond=1e-12
    )[0]
    return result
