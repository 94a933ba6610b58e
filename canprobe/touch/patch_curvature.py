"""The contact patch as a second sensor: curvature from the second moments of tactile images, fused with the motion's.

The moments are averaged over the last frames, in axes that follow the contact normal, and compared with a calibrated
model of the sensor (`patch_moments`). What gains, hysteresis and blur do to them is common to all images of a contact:
however many are averaged, the patch never knows more than the calibration's floor.

In the fusion the patch speaks where it knows more than the motion does, combination by combination of K; elsewhere it
is not asked. A point-and-normal estimate along a path that excites all of K is better than any image.

The layer's model is stated in `patch_moments`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array, solved
from canprobe.touch.contact import ContactSample
from canprobe.touch.frames import tangent_rotation
from canprobe.touch.patch_image import Moments
from canprobe.touch.patch_moments import MomentModel
from canprobe.touch.rank import turned

LEAST_FRAMES = 8
"""Fewer frames make no estimate."""
MOST_FRAMES = 64
"""Frames that the running mean reaches back: 0.3 s at 200 Hz, 8 mm at 25 mm/s."""
GROSS = 0.2
"""Departure from the mean, over its trace, beyond which one image counts less: ten times the noise of a frame."""
MOST_ROUNDS = 6
"""Gauss–Newton steps; from the last answer one or two do."""
SETTLED, UNSETTLED = 0.002, 0.05
"""Step, in units of the probe's curvature, that ends the iteration, and the largest that a last step may have."""
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
        self._x, self._y = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
        self._last: tuple[float, float, float] | None = None
        self._xx = self._xy = self._yy = 0.0

    def add(self, sample: ContactSample) -> None:
        """Take the image of one contact."""
        if sample.moments is None:
            self.refused += 1
            return
        self._carry(*(-sample.n_base).tolist())
        self.frames = min(self.frames + 1, MOST_FRAMES)
        share = 1.0 / self.frames
        xx, xy, yy = _turned(*sample.moments, *self._pad_axis(sample))
        dxx, dxy, dyy = xx - self._xx, xy - self._xy, yy - self._yy
        if self.frames > LEAST_FRAMES:
            share *= min(1.0, GROSS * (self._xx + self._yy) / max(abs(dxx) + 2.0 * abs(dxy) + abs(dyy), 1e-300))
        self._xx += share * dxx
        self._xy += share * dxy
        self._yy += share * dyy
        self.force += share * (sample.force_n - self.force)

    def _carry(self, zx: float, zy: float, zz: float) -> None:
        """Turn the axes the shortest way so that z is the inward normal."""
        if not self.frames:
            self._x, self._y, _ = tangent_rotation(np.array([zx, zy, zz])).T.tolist()
            return
        x, y, z = self._x
        along = x * zx + y * zy + z * zz
        x, y, z = x - along * zx, y - along * zy, z - along * zz
        size = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = size * x, size * y, size * z
        self._x, self._y = [x, y, z], [zy * z - zz * y, zz * x - zx * z, zx * y - zy * x]

    def _pad_axis(self, sample: ContactSample) -> tuple[float, float]:
        """Cosine and sine of the angle from x of the carried axes to u of the pad, both about the inward normal."""
        x, y, z = sample.r_probe.tolist()
        k = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = k * x, k * y, k * z
        bend = x / (1.0 + z)  # the pad's u axis, turned from the pole to the contact the shortest way
        ux, uy, uz = 1.0 - bend * x, -bend * y, -x
        u = [a * ux + b * uy + c * uz for a, b, c, _ in sample.T_base_probe[:3].tolist()]
        return self._in_axes(u)

    def _in_axes(self, u: list[float]) -> tuple[float, float]:
        """Direction of a vector (3,) of base in the carried tangent plane: cosine, sine."""
        cx, cy = (a[0] * u[0] + a[1] * u[1] + a[2] * u[2] for a in (self._x, self._y))
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
        c, s = self._in_axes(T_base_contact[:3, 0].tolist())
        xx, xy, yy = _turned(self._xx, self._xy, self._yy, c, -s)
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        turn = turned(angle)  # q in the contact frame to q in the patch's principal axes
        known = None if motion is None else CurvatureInformation(turn @ motion.q, turn @ motion.information @ turn.T)
        found = self._solve((mean + half, 0.0, mean - half), known)
        return None if found is None else CurvatureInformation(turn.T @ found.q, turn.T @ found.information @ turn)

    def _solve(self, v: Moments, motion: CurvatureInformation | None) -> CurvatureInformation | None:
        """From the last answer, and where that fails from the ideal layer."""
        last, self._last = self._last, None
        found = None if last is None else self._iterated(last, v, motion)
        if found is None and (start := self.model.start(v, self.force)) is not None:
            found = self._iterated(start, v, motion)
        return found

    def _iterated(self, k: Moments, v: Moments, motion: CurvatureInformation | None) -> CurvatureInformation | None:
        """Gauss–Newton from K; None where it does not settle inside the calibration."""
        step = math.inf
        try:
            for _ in range(MOST_ROUNDS):
                J, r, W = self.model.linearised(v, self.force, self.frames, k)
                used = CurvatureInformation(_TO_Q * k + solved(J, r), J.T @ W @ J)
                if motion is not None:
                    used = CurvatureInformation(used.q, _better(used.information, motion.information))
                q = used.q if motion is None else mean_of(motion, used)
                before, k = k, _entries(q)
                step = max(abs(a - b) for a, b in zip(k, before, strict=True))
                if step < SETTLED / self.model.radius:
                    break
        except (ValueError, np.linalg.LinAlgError):
            return None
        if step > UNSETTLED / self.model.radius or not self.model.covers(k, self.force):
            return None
        self._last = k
        return used


def _turned(xx: float, xy: float, yy: float, c: float, s: float) -> tuple[float, float, float]:
    """A symmetric tensor in other axes, in which the old x axis has the components c, s."""
    cc, cs, ss = c * c, c * s, s * s
    return cc * xx - 2.0 * cs * xy + ss * yy, cs * (xx - yy) + (cc - ss) * xy, ss * xx + 2.0 * cs * xy + cc * yy


def _entries(q: Array) -> tuple[float, float, float]:
    q1, q2, q3 = q.tolist()
    return q1, q2 / _ROOT2, q3


def _better(own: Array, motion: Array) -> Array:
    """The part of a definite information (3, 3) about combinations that the motion knows less well."""
    L: Array = np.linalg.cholesky(own).astype(np.float64, copy=False)
    inverse = solved(L, np.eye(3))
    ratio, W = np.linalg.eigh(inverse @ motion @ inverse.T)
    kept = L @ W[:, ratio < 1.0]
    result: Array = kept @ kept.T
    return result


def mean_of(a: CurvatureInformation, b: CurvatureInformation) -> Array:
    """(3,) the mean weighted with the information of both, which together must be definite."""
    return solved(a.information + b.information, a.information @ a.q + b.information @ b.q)
