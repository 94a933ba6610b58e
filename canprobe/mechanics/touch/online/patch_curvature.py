"""The contact patch as a second sensor: curvature from the second moments of tactile images, fused with the motion's.

The moments are averaged over the last frames, in axes that follow the contact normal, and compared with a calibrated
model of the sensor (`image_model`). Errors by gains, hysteresis and blur are common to all images of a contact: however
many images are averaged, the information never exceeds that of the calibration (`MomentErrors`).

Motion and patch are fused as measurements: their informations are added, each with its whole covariance. So the patch
has little weight where a path excites all of K, and much where it does not. The stiffness of the layer is a fourth
unknown beside q. Why not a constant: an error of it looks like isotropic curvature. Its prior is the state of the scan
(`ScanStiffness`): stated at first, then found from the slope of a touch together with the first images, and improved by
every answer in which the motion knows curvature. Outside the calibrated range the patch counts less and less. Where
patch and motion disagree both count less, by χ² over its 95 % point; where they contradict each other (99.9 %), nothing
is called observed.

Where the curvature changes along the path, a mean over some millimetres belongs to an earlier place. A second, shorter
mean shows it: the difference of the two, extrapolated to now, counts as an error of the longer one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.checks import positive
from canprobe.mechanics.touch.contact import ContactSample, Slope, direction_to_pad
from canprobe.mechanics.touch.estimate.noise import CHI2_999
from canprobe.mechanics.touch.estimate.observed import CurvatureInformation, turned
from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.touch.image.image_model import ImageModel
from canprobe.mechanics.touch.image.moments import Moments, PadMemory, overlapping
from canprobe.mechanics.touch.layer_stiffness import ScanStiffness, stiffness_from_slope
from canprobe.mechanics.touch.linear_algebra import inverted, principal_of, solved
from canprobe.mechanics.touch.tangent_frames import tangent_rotation, transported
from canprobe.mechanics.types import Floats, Vec

MIN_FRAMES = 8
"""Least number of frames for an estimate."""
MAX_FRAMES = 32
"""Most frames in the running mean: 0.16 s at 200 Hz, 4 mm at 25 mm/s."""
MAX_RECENT_FRAMES = 8
"""Most frames in the shorter mean."""
RECENT_OUTLIER_SHARE = 0.05
"""`OUTLIER_SHARE` of the shorter mean, in which one image has more weight: four times the noise of a frame."""
MIN_AGE_DIFFERENCE_FRAMES = 4.0
"""Least difference of the ages of both means, in frames, from which a drift is computed."""
OUTLIER_SHARE = 0.2
"""Largest departure from the mean, over its trace, of an image that counts in full: ten times the noise of a frame."""
FORGOTTEN_AFTER_M = 4e-3
"""Way of the contact since the last image, m, beyond which images say nothing about its place: that of the mean."""
MAX_ROUNDS = 6
"""Most Gauss–Newton steps; from the last answer one or two suffice."""
SLOPE_SIGMA = 0.08
"""Standard deviation of ln(stiffness) from the slope of a touch, by the error of the force; that of the slope comes on
top."""
TRACE_ERROR_SHARE = 0.5
"""Standard deviation of what traces of earlier places do to the moments, over what is taken off for them."""
_STIFFNESS_STEP = 0.01
_ROOT2 = math.sqrt(2.0)
LAST_STEP, MAX_LAST_STEP = 0.002, 0.05
"""Step, in units of the probe's curvature, that ends the iteration; largest last step of a solution that is used."""


class Fused(NamedTuple):
    """What patch and motion say together about q in a contact frame.

    Attributes:
        q: (3,) value of (K11, √2 K12, K22), 1/m.
        patch: (3, 3) the patch's part of the information, with the layer's stiffness unknown, m².
        cost: χ² of patch, motion and stiffness against the answer.
        log_stiffness: logarithm of the layer's stiffness K/h in N/m³.
        stiffness_information: its inverse variance.
    """

    q: Floats
    patch: Floats
    cost: float
    log_stiffness: float
    stiffness_information: float

    @property
    def stiffness(self) -> float:
        """Stiffness K/h of the layer, N/m³."""
        return math.exp(self.log_stiffness)

    @property
    def contradicted(self) -> bool:
        """Whether patch and motion contradict each other (99.9 %)."""
        return self.cost > CHI2_999


_Seen = tuple[Moments, tuple[Moments, Moments]]
"""Moments in their principal axes, and errors of unknown sign: a change along the path, traces of the past, m²."""


class _Mean:
    """Running mean of moments over at most `most` frames, with their number and age.

    `gross` is the largest departure of a frame that counts in full, as `OUTLIER_SHARE`.
    """

    def __init__(self, most: int, gross: float) -> None:
        self.moments: Moments = (0.0, 0.0, 0.0)
        self.age = 0.0
        self._most, self._gross = most, gross
        self.frames = 0
        self._apart = 0

    def add(self, xx: float, xy: float, yy: float) -> float:
        """Take the moments of a frame; returns its share in the mean, which is small for a frame far from the mean."""
        self.frames = min(self.frames + 1, self._most)
        share = 1.0 / self.frames
        mxx, mxy, myy = self.moments
        dxx, dxy, dyy = xx - mxx, xy - mxy, yy - myy
        if self.frames >= MIN_FRAMES:
            nearness = self._gross * (mxx + myy) / max(abs(dxx) + 2.0 * abs(dxy) + abs(dyy), 1e-300)
            self._apart = self._apart + 1 if nearness < 1.0 else 0
            if self._apart == MIN_FRAMES:
                # so many in a row are no outliers: the surface has changed, and the mean starts afresh
                self.moments, self.age, self.frames, self._apart = (xx, xy, yy), 0.0, 1, 0
                return 1.0
            share *= min(1.0, nearness)
        self.moments = _mixed(self.moments, (xx, xy, yy), share)
        self.age = (1.0 - share) * (self.age + 1.0)
        return share

    def drift_from(self, younger: _Mean) -> Moments:
        """Error of this mean by a change since its age, extrapolated from the difference to a younger mean."""
        apart = self.age - younger.age
        if apart < MIN_AGE_DIFFERENCE_FRAMES:
            return 0.0, 0.0, 0.0
        times = self.age / apart
        xx, xy, yy = (times * (now - then) for now, then in zip(younger.moments, self.moments, strict=True))
        return xx, xy, yy


class PatchCurvature:
    """Running mean of second moments in axes that are carried along with the contact normal.

    Args:
        model: model of the sensor.
        sigma_stiffness: standard deviation of the logarithm of the model's stiffness, before any touch.
        others: models of other arrays of the make, each one standard deviation off; none of a calibrated array.

    Attributes:
        stiffness: stiffness of the layer, the state of the scan; a loss of contact does not reset it.
        frames: number of frames in the mean, at most `MAX_FRAMES`.
        force: mean force over these frames, N.
        refused: number of contacts without moments (saturated, at the pad's edge, hardly any taxel, or none sent).
    """

    def __init__(self, model: ImageModel, sigma_stiffness: float = 1e-3, others: Sequence[ImageModel] = ()) -> None:
        self.model, self._others = model, others
        self.stiffness = ScanStiffness(model.parameters.stiffness, positive("sigma_stiffness", sigma_stiffness))
        self.refused = 0
        self._used: Slope | None = None
        self.reset()

    def reset(self) -> None:
        """Forget all images: contact was lost."""
        self._memory = PadMemory()
        self._axes: tuple[Vec, Vec] = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
        self._last: Floats | None = None
        self._slope: Slope | None = None
        self._touched = False
        self._forget_mean()

    def _forget_mean(self) -> None:
        """Forget the images of other places."""
        self.frames = 0
        self.force = 0.0
        self._place: Floats | None = None
        self._traces: Moments = (0.0, 0.0, 0.0)
        self._mean, self._recent = _Mean(MAX_FRAMES, OUTLIER_SHARE), _Mean(MAX_RECENT_FRAMES, RECENT_OUTLIER_SHARE)

    def add(self, sample: ContactSample) -> None:
        """Take the image of one contact."""
        if not self._touched:
            self._touched = True
            if sample.slope != self._used:  # contact that is regained has the slope of an earlier touch
                self._slope = sample.slope
        x, y, z = sample.r_probe.tolist()
        k = 1.0 / math.sqrt(x * x + y * y + z * z)
        direction = k * x, k * y, k * z
        # before the image is judged: the pad remembers this place, whether its moments are used or not
        was = self._memory.add(sample.t_s, *direction_to_pad(direction, self.model.radius))
        if sample.moments is None:
            self.refused += 1
            if self._place is not None and math.dist(sample.p_base, self._place) > FORGOTTEN_AFTER_M:
                self._forget_mean()
            return
        self._place = sample.p_base
        nx, ny, nz = sample.n_base.tolist()
        inward = -nx, -ny, -nz
        # why not always `tangent_rotation`: where a normal passes 18° from x of the base, its axes jump by 90°
        x_axis = self._axes[0] if self.frames else tangent_rotation(inward)[:, 0].tolist()
        self._axes = transported(x_axis, inward)
        (uu, uv, vv), memory = sample.moments, self.model.parameters.memory
        tuu, tuv, tvv = (memory * trace for trace in overlapping(was, sample.moments))
        axis = self._pad_axis(direction, sample.T_base_probe)
        moments = _turned(uu - tuu, uv - tuv, vv - tvv, *axis)
        self._recent.add(*moments)
        share = self._mean.add(*moments)
        self._traces = _mixed(self._traces, _turned(tuu, tuv, tvv, *axis), share)
        self.frames = self._mean.frames
        self.force += share * (sample.force_n - self.force)  # of the same frames as the moments

    def _pad_axis(self, direction: Moments, T_base_probe: Floats) -> tuple[float, float]:
        """Cosine and sine of the angle from x of the carried axes to u of the pad, both about the inward normal."""
        x, y, z = direction
        bend = x / (1.0 + z)  # the pad's u axis, turned from the pole to the contact the shortest way
        u, v, w = 1.0 - bend * x, -bend * y, -x
        (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = T_base_probe.tolist()
        return self._in_axes((a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w))

    def _in_axes(self, u: Vec) -> tuple[float, float]:
        """Direction of a vector of base in the carried tangent plane: cosine, sine."""
        (a, b, c), ((x0, x1, x2), (y0, y1, y2)) = u, self._axes
        x, y = a * x0 + b * x1 + c * x2, a * y0 + b * y1 + c * y2
        size = 1.0 / math.hypot(x, y)
        return x * size, y * size

    def fuse(self, T_base_contact: Floats, motion: CurvatureInformation | None = None) -> Fused | None:
        """Curvature by the patch and the motion's evidence about q, in a contact frame (4, 4), m.

        None where the patch has too few frames, is no ellipse without the traces of earlier places, or the iteration
        does not settle.
        """
        if self.frames < MIN_FRAMES:
            return None
        c, s = self._in_axes(T_base_contact[:3, 0].tolist())
        xx, xy, yy = _turned(*self._mean.moments, c, -s)
        mean, half, angle = principal_of(xx, xy, yy)
        if not mean > half:
            return None
        along = math.cos(angle), -math.sin(angle)
        drift, (txx, txy, tyy) = (
            _turned(*_turned(*error, c, -s), *along) for error in (self._mean.drift_from(self._recent), self._traces)
        )
        traces = TRACE_ERROR_SHARE * txx, TRACE_ERROR_SHARE * txy, TRACE_ERROR_SHARE * tyy
        turn = turned(angle)  # q in the contact frame to q in the patch's principal axes
        known = CurvatureInformation(np.zeros(3), np.zeros((3, 3))) if motion is None else motion
        known = CurvatureInformation(turn.dot(known.q), turn.dot(known.information).dot(turn.T))
        found = self._solve(((mean + half, 0.0, mean - half), (drift, traces)), known)
        if found is None:
            return None
        q, patch = turn.T.dot(found.q), turn.T.dot(found.patch).dot(turn)
        return found._replace(q=q, patch=patch)

    def _solve(self, seen: _Seen, motion: CurvatureInformation) -> Fused | None:
        """Solve from the last answer, and where that fails from that of the ideal layer."""
        last, self._last = self._last, None  # a solution that fails leaves no start for the next
        found = None if last is None else self._iterated(last, seen, motion)
        for guess in self._guesses():
            start = None if found is not None else self._model(guess).start(seen[0], self.force)
            if start is not None:
                found = self._iterated(np.array([*(TO_Q * start), guess]), seen, motion)
        if found is None:
            return None
        self._last, fused = found
        if self._slope is not None:
            # the slope belongs to the place of the touch and is used once; the stiffness that it gave is kept
            self._used, self._slope = self._slope, None
            self.stiffness.take(fused.log_stiffness, fused.stiffness_information)
        return fused

    def _iterated(self, x: Floats, seen: _Seen, motion: CurvatureInformation) -> tuple[Floats, Fused] | None:
        """Gauss–Newton from x (4,) = (q, ln of the stiffness): its last x, and the answer; None without an end."""
        known, mean = np.zeros((4, 4)), np.array([*motion.q, self.stiffness.log])
        known[:3, :3], known[3, 3] = motion.information, self.stiffness.information
        J, (moments, of_way) = np.empty((3, 4)), seen
        errors: list[Moments] = []
        xx, _, yy = moments
        scale = np.array([xx, math.sqrt(xx * yy), yy])
        step = math.inf
        try:
            for round_ in range(MAX_ROUNDS):
                q1, q2, q3, log_stiffness = x.tolist()
                k: Moments = q1, q2 / _ROOT2, q3
                model = self._model(log_stiffness)
                J[:, :3], r, W = model.linearised(moments, self.force, self.frames, k)
                if round_ == 0:  # it hardly changes from step to step
                    here = np.array(moments) - scale * r
                    there = self._model(log_stiffness + _STIFFNESS_STEP).moments(k, self.force)
                    J[:, 3] = (there - here) / scale / _STIFFNESS_STEP
                    others = (other.with_stiffness(math.exp(log_stiffness)) for other in self._others)
                    errors = [*of_way, *(tuple(other.moments(k, self.force) - here) for other in others)]
                for error in errors:
                    W = _less_certain(W, moments, error)
                W *= model.trust(k, self.force)
                JW = J.T.dot(W)
                information, pull, cost = JW.dot(J), JW.dot(r), float(r.dot(W).dot(r))
                if not information.any():
                    return None
                if self._slope is not None:
                    row, off, weight = self._push(x, k, self._slope)
                    information += weight * np.outer(row, row)
                    pull += weight * off * row
                    cost += weight * off**2
                apart = mean - x
                drawn = known.dot(apart)
                way = solved(information + known, pull + drawn)
                cost += float(apart.dot(drawn))
                x = x + way
                *of_q, of_stiffness = map(abs, way.tolist())
                # an error of ln k looks like that times 1/R_p in the curvature of a plane
                step = max(*of_q, of_stiffness / self.model.radius)
                if step < LAST_STEP / self.model.radius:
                    break
        except (ValueError, np.linalg.LinAlgError):
            return None
        if step > MAX_LAST_STEP / self.model.radius:
            return None
        of_stiffness = 1.0 / float(inverted(information + known)[3, 3])
        patch = information[:3, :3] - information[:3, 3, None] * information[3, :3] / (information[3, 3] + known[3, 3])
        return x, Fused(x[:3], patch, cost, float(x[3]), of_stiffness)

    def _guesses(self) -> tuple[float, ...]:
        """Starting values of ln(stiffness): the known one, and that of the touch on a plane."""
        known, slope = self.stiffness.log, self._slope
        if slope is None:
            return (known,)
        return known, math.log(stiffness_from_slope(slope.value, self.model.radius, (0.0, 0.0)))

    def _model(self, log_stiffness: float) -> ImageModel:
        return self.model.with_stiffness(math.exp(log_stiffness))

    def _push(self, x: Floats, k: Moments, slope: Slope) -> tuple[Floats, float, float]:
        """Row (4,) of a touch's slope at x, its residual in ln(stiffness), and its information."""
        K = np.array([[k[0], k[1]], [k[1], k[2]]])
        half = 0.5 * inverted(np.eye(2) / self.model.radius + K)
        kappa = np.linalg.eigvalsh(K)
        off = math.log(stiffness_from_slope(slope.value, self.model.radius, kappa)) - x[3]
        row = np.array([-half[0, 0], -2.0 * half[0, 1] / TO_Q[1], -half[1, 1], 1.0])
        # 2: the stiffness goes with the square of the slope
        return row, off, 1.0 / ((2.0 * slope.sigma / slope.value) ** 2 + SLOPE_SIGMA**2)


def _less_certain(W: Floats, moments: Moments, error: Moments) -> Floats:
    """Information (3, 3) of relative moments, with one more error of unknown sign."""
    (v1, _, v2), (xx, xy, yy) = moments, error
    relative = np.array([xx / v1, xy / math.sqrt(v1 * v2), yy / v2])
    b = W.dot(relative)
    result: Floats = W - b[:, None] * b / (1.0 + float(b.dot(relative)))
    return result


def _mixed(mean: Moments, new: Moments, share: float) -> Moments:
    """A running mean that a new value enters with a share."""
    (a, b, c), (x, y, z) = mean, new
    return a + share * (x - a), b + share * (y - b), c + share * (z - c)


def _turned(xx: float, xy: float, yy: float, c: float, s: float) -> tuple[float, float, float]:
    """A symmetric tensor in other axes, in which the old x axis has the components c, s."""
    cc, cs, ss = c * c, c * s, s * s
    return cc * xx - 2.0 * cs * xy + ss * yy, cs * (xx - yy) + (cc - ss) * xy, ss * xx + 2.0 * cs * xy + cc * yy
