"""Whether an array behaves as its calibration says, found while it scans by four signs of another array's file.

- **Blur.** Each image shows how far the cover blurs it (`blur_fit`), whatever is touched.
- **Stiffness.** The slope of the touch, the images' moments and the motion show the stiffness of the layer, and
  estimators know it as `SurfaceEstimate.stiffness`. Another layer and other gains change it alike, as images alone do
  not show newtons. So does an object or an arm that gives way, which the message says.
- **Disagreement.** On a surface that is known, the slope of the touch gives a stiffness, and so does the bend of the
  pressure in an image. Another pitch makes one of them smaller and the other larger, each by its square.
- **Contradiction.** Images mean another curvature than the motion shows, in most answers (`patch_fusion`).

Each sign is a median or a share of what was seen so far, from a least number on, and up to a number from which the
array counts as the calibrated one: a check costs nothing after that. The limits come from a development draw of study
`regions`, and study `calibrations` counts what they find.

Until the array is calibrated, its answers are less certain. A force has the spread of a make and half of what stiffness
and disagreement are off: two standard deviations reach the force that other gains would mean. Regions of curvature are
wider (`regions.scaled`) where any sign but the stiffness shows that images mean another curvature. Why not for
another stiffness: estimators find it, and regions that were widened for it were three times the error. Images that
contradict the motion in most answers are not asked for curvature any more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.array_calibration.blur_fit import fit_blur
from canprobe.mechanics.touch.contact import HOLLOW_LIMIT_SHARE, Slope
from canprobe.mechanics.touch.image.calibration import ArrayCalibration
from canprobe.mechanics.touch.image.force_errors import MAKE_SPREAD, STRAIGHT_SHARE
from canprobe.mechanics.touch.image.patch import Patch
from canprobe.mechanics.touch.layer_stiffness import stiffness_from_slope
from canprobe.mechanics.touch.pad import COUNTS_MAX, Pad

if TYPE_CHECKING:
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate

LOOK_S = 0.15
"""Time between two images that are fitted, s: a fit takes a millisecond."""
MAX_LIGHTNESS = 0.12
"""Largest level over peak of an image that is fitted: the rim of a light touch is lost below the threshold."""
MIN_BEND_SHARE = 0.8
"""Least mean curvature of probe and object over the probe's: errors of curvature are large against that of a hollow."""
MAX_BEND_CHANGE = 0.1
"""Largest change of the bend from the first three images to all, in ln, on a surface that stays as curved as it was at
the touch: the slope of the touch belongs to that curvature, which only the motion shows later."""
MIN_TRIES, MAX_TRIES = 20, 64
"""Number of images after which something is said, so that it holds all signs, and at which the check ends."""
MIN_IMAGES, MIN_ANSWERS = 16, 40
"""Number of images with a fit from which on blur and disagreement are judged, and of answers, for the stiffness."""
MAX_RATIO = 1.22
"""Ratio of blur or stiffness to the calibration's, up or down, beyond which it is another array's."""
MAX_DISAGREEMENT, MAX_TOUCH_SIGMA = 0.3, 0.08
"""Difference of the logarithms of two stiffnesses of one layer beyond which the calibration is another array's, and
largest standard deviation of the touch's at which they are compared: a light touch shows it to 30 % only."""

MAX_CONTRADICTED = 0.5
"""Share of the answers that images contradict, beyond which the calibration is another array's: known ones have 3 % on
the roughest surfaces."""


class CalibrationCheck:
    """Compares the images and the stiffness of a scan with the calibration that it uses.

    Args:
        calibration: calibration of the array.
        pad: its taxels, a grid on a sphere.
    """

    def __init__(self, calibration: ArrayCalibration, pad: Pad) -> None:
        image, self._of_make = calibration.image, calibration.of_make
        self._pad, self._stiffness, self._crosstalk = pad, image.stiffness, image.crosstalk
        self._blur = image.blur / pad.pitch_m
        self._gains = np.array(calibration.gains) if calibration.gains else np.ones(pad.shape)
        # the shown pressure falls by scale · k · A: from a bend in counts over pitch² and the mean of A to k
        self._stiffness_of_bend = pad.full_scale_pa / COUNTS_MAX / (pad.pitch_m**2 * image.scale)
        self._blurs: list[float] = []  # all logarithms over the calibration's
        self._by_answers: list[float] = []
        self._by_images: list[float] = []
        self._by_touch: list[float] = []
        self._bends: list[float] = []
        self._contradicted: list[bool] = []
        self._curvature: float | None = None
        self._tries = 0
        self._next_s = -math.inf
        self._waiting: tuple[NDArray[np.uint8], Sequence[int], Patch] | None = None

    @classmethod
    def of(cls, calibration: ArrayCalibration, pad: Pad, *, images: bool) -> CalibrationCheck | None:
        """The check of an array; None of one that sends no images, and of a flat array and a list of taxels.

        These have no image model.
        """
        return cls(calibration, pad) if images and pad.is_grid and not pad.is_flat else None

    def see(self, t_s: float, image: NDArray[np.uint8], window: Sequence[int], patch: Patch) -> None:
        """Take an image of the scan and its patch; `work` fits it where one is due.

        Args:
            t_s: time of the image, s.
            image: (rows, columns) counts.
            window: first row, first column, rows, columns that were sent.
            patch: its patch.
        """
        if t_s < self._next_s or self._tries >= MAX_TRIES:
            return
        self._next_s = t_s + LOOK_S
        self._waiting = image, window, patch

    def work(self) -> bool:
        """Fit the image that waits; whether there was one, so that there may be a `finding`."""
        if self._waiting is None:
            return False
        (image, window, patch), self._waiting = self._waiting, None
        self._tries += 1
        bent = patch.peak_pa > STRAIGHT_SHARE * self._pad.full_scale_pa
        if bent or patch.cut_by_pad or patch.dead or self._pad.lightness(patch.peak_pa) > MAX_LIGHTNESS:
            return True
        found = fit_blur(image, window, blur=self._blur, crosstalk=self._crosstalk, gains=self._gains)
        if found is not None:
            self._blurs.append(math.log(found.blur / self._blur))
            self._bends.append(max(found.bend, 1e-9))
            if self._curvature is not None and found.bend > 0.0:
                stiffness = self._stiffness_of_bend * found.bend / self._curvature
                self._by_images.append(math.log(stiffness / self._stiffness))
        return True

    def take(self, answer: SurfaceEstimate, slope: Slope | None) -> None:
        """Take an answer of the estimator, and the slope that the touch showed.

        Args:
            answer: answer at the last contact.
            slope: slope of the root of the force over the push; None where the touch showed none.
        """
        radius, kappa, self._curvature = self._pad.radius_m, answer.kappa, None
        if self._tries >= MAX_TRIES:
            return
        self._contradicted.append(answer.contradicted)
        if not answer.observed.all() or float(kappa[1]) < -HOLLOW_LIMIT_SHARE / radius:
            return
        curvature = 0.5 / radius + 0.25 * float(kappa[0] + kappa[1])
        if curvature < MIN_BEND_SHARE * 0.5 / radius:
            return
        self._curvature = curvature
        if answer.stiffness is not None:
            self._by_answers.append(math.log(answer.stiffness / self._stiffness))
        # the slope is of the place of the touch: answers further on know another curvature
        if slope is None or len(self._by_touch) >= MIN_ANSWERS:
            return
        if 2.0 * slope.sigma < MAX_TOUCH_SIGMA * slope.value:  # k goes with b²
            by_touch = stiffness_from_slope(slope.value, radius, kappa)
            self._by_touch.append(math.log(by_touch / self._stiffness))

    @property
    def blur_off(self) -> float:
        """Logarithm of the blur over the calibration's; 0 before it is judged, and within the limit."""
        return _beyond(_median(self._blurs, MIN_IMAGES), math.log(MAX_RATIO))

    @property
    def stiffness_off(self) -> float:
        """Logarithm of the stiffness over the calibration's; 0 before it is judged, and within the limit.

        Where the estimator gives no stiffness, touch and images must both show it: the nearer one counts.
        """
        off = _median(self._by_answers, MIN_ANSWERS)
        if len(self._by_answers) < MIN_ANSWERS:
            off = min(_median(self._by_touch, MIN_ANSWERS), _median(self._by_images, MIN_IMAGES), key=abs)
        return _beyond(off, math.log(MAX_RATIO))

    @property
    def disagreement(self) -> float:
        """Logarithm of the stiffness by images over that by the touch; 0 as for the others."""
        if len(self._by_touch) < MIN_ANSWERS or len(self._by_images) < MIN_IMAGES:
            return 0.0
        if abs(math.log(median(self._bends[:3]) / median(self._bends))) > MAX_BEND_CHANGE:
            return 0.0
        return _beyond(median(self._by_images) - median(self._by_touch), MAX_DISAGREEMENT)

    @property
    def finding(self) -> str | None:
        """What does not fit, in words; None where everything does, and before there are `MIN_TRIES` images."""
        found: list[str] = []
        if self._tries < MIN_TRIES:
            return None
        if off := self.blur_off:
            stated = 1e3 * self._pad.pitch_m * self._blur
            found.append(f"its images are blurred by {stated * math.exp(off):.2f} mm (calibration: {stated:.2f} mm)")
        if off := self.stiffness_off:
            shown = self._stiffness * math.exp(off)
            found.append(f"its layer has {shown:.3g} N/m³ (calibration: {self._stiffness:.3g})")
        if self.disagreement:
            shown, by_touch = (self._stiffness * math.exp(median(by)) for by in (self._by_images, self._by_touch))
            found.append(f"its images show a layer of {shown:.3g} N/m³ and its touch one of {by_touch:.3g}")
        if share := self.contradicted:
            found.append(f"its images contradict {100.0 * share:.0f} % of the answers, which do without them")
        if not found:
            return None
        softer = (self.stiffness_off < 0.0 or self.disagreement > 0.0) and not self.blur_off
        soft = "; or the object or the arm gives way" if softer else ""
        return f"the array is not as its calibration says: {', and '.join(found)}{soft}"

    @property
    def image_model_off(self) -> bool:
        """Whether images mean another curvature than the calibration says: another stiffness alone does not.

        Never of an array that is known to be another one of the make: its regions have these errors.
        """
        return not self._of_make and bool(self.blur_off or self.disagreement or self.contradicted)

    @property
    def contradicted(self) -> float:
        """Share of the answers that images contradict; 0 as for the others."""
        if len(self._contradicted) < MIN_ANSWERS:
            return 0.0
        return _beyond(sum(self._contradicted) / len(self._contradicted), MAX_CONTRADICTED)

    @property
    def force_spread(self) -> float:
        """Relative standard deviation that forces have besides, of an array that is not the calibrated one."""
        return math.hypot(MAKE_SPREAD, 0.5 * self.stiffness_off, 0.5 * self.disagreement)


def _median(logarithms: Sequence[float], least: int) -> float:
    """Median of logarithms; 0 before there are enough."""
    return median(logarithms) if len(logarithms) >= least else 0.0


def _beyond(value: float, limit: float) -> float:
    """A value that is beyond a limit, up or down; else 0."""
    return value if abs(value) > limit else 0.0
