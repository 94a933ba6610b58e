"""The calibration of one tactile array.

`canprobe calibrate array` finds it by touching a plane and a ball (`touch.array_calibration`), and writes it to a file.
Images alone do not show newtons: stiffness, full scale and mean gain times 1.3 give identical images and 1.3 times the
force. So a calibration names its force reference; without one, forces and stiffness are in nominal newtons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from canprobe.errors import UsageError
from canprobe.mechanics.touch.image.force_errors import MAKE_SPREAD, UNSTATED, ForceErrors

ForceReference = Literal["scale", "weights", "unit", "none"]
NO_FORCE_REFERENCE = "nominal newtons: no force reference"
MAKE_BLUR, MAKE_CROSSTALK = 0.2, 0.014
"""Standard deviations of blur, relative, and crosstalk between arrays of one make: those of the arrays that studies
draw. Images of a small patch are mostly blur, and those of a large one are not."""


@dataclass(frozen=True, slots=True)
class ImageParameters:
    """Parameters of an array's image model, found by touching known objects.

    Attributes:
        stiffness: stiffness K/h of the layer, N/m³.
        scale: pressure that the array shows over the true one.
        blur: standard deviation of the blur by cover and taxel together, m.
        crosstalk: share of a taxel's signal that spreads over its row, and again over its column.
        memory: share of the patch's earlier places on the pad (`PadMemory`) in the moments.

    Raises:
        UsageError: stiffness, scale or blur is not above 0.
    """

    stiffness: float
    scale: float
    blur: float
    crosstalk: float
    memory: float

    def __post_init__(self) -> None:
        for name in ("stiffness", "scale", "blur"):
            if not getattr(self, name) > 0.0:
                raise UsageError(f"{name}: expected a number above 0, got {getattr(self, name)!r}")


@dataclass(frozen=True, slots=True)
class MomentErrors:
    """Relative errors of second moments.

    Attributes:
        moment: variance of a moment along a principal axis that no averaging removes (gains, hysteresis, creep, form of
            the model).
        both: covariance of the errors along the two axes.
        shear: variance of V_12 over √(V_1 V_2).
        frame_sigma: standard deviation of a moment from one frame to the next.
    """

    moment: float
    both: float
    shear: float
    frame_sigma: float


NO_ERRORS = MomentErrors(1.0, 0.0, 1.0, 0.0)
"""Errors for a model that is only used forward."""


@dataclass(frozen=True, slots=True)
class Lag:
    """Lag of the centroid behind the contact, as a calibration found it; the model is that of `pad_lag`.

    Attributes:
        most: largest lag, m.
        reach: way at which the lag is half of that, m.
    """

    most: float
    reach: float


@dataclass(frozen=True, slots=True)
class ContactNoise:
    """Noise of the place of a contact: what the estimators, the patch, the servo and the bound know of it.

    The centroid has two errors. They displace the contact along the surface, and turn its normal by themselves over the
    probe's radius. One changes from image to image; it is larger for light touches, which cover few taxels. The other
    changes only as the contact moves over the pad: hysteresis, gains of the taxels. Neither changes the height of the
    contact, as a sphere that is tangent to the surface keeps its height where the centroid errs. The height errs by
    joint counts and by the depth of the layer.

    Attributes:
        scale, power: parameters of the standard deviation from image to image, `scale · t^power`, m, with t the level
            over the peak pressure.
        slow: standard deviation of the slow error, m.
        slow_way: way over the pad along which it is correlated (e-folding), m.
        height: standard deviation of the place along the normal, m.
        assumed: whether the file does not state `slow` and `height`, so that those of the emulated array are assumed.
    """

    scale: float
    power: float
    slow: float
    slow_way: float
    height: float
    assumed: bool = False

    def image(self, level_over_peak: float) -> float:
        """Standard deviation of a centroid per axis from image to image, m."""
        return self.scale * math.pow(min(max(level_over_peak, 0.0), 1.0), self.power)

    def lateral(self, level_over_peak: float) -> float:
        """Standard deviation of a contact along the surface per axis, m, slow errors included."""
        return math.hypot(self.image(level_over_peak), self.slow)


@dataclass(frozen=True, slots=True)
class CentroidDelays:
    """Delays of the centroid behind the contact.

    Attributes:
        latency_s, latency_sigma_s: age of an image at its time stamp, and the standard deviation of this age, s.
        lag: lag of the centroid behind the contact, which does not depend on the speed.
    """

    latency_s: float
    latency_sigma_s: float
    lag: Lag


@dataclass(frozen=True, slots=True)
class StiffnessSources:
    """Stiffness K/h of the layer from two sources, each with its standard deviation.

    Attributes:
        moments, moments_sigma: stiffness from the moments of images, N/m³.
        depth, depth_sigma: stiffness from the arm's way into the object, N/m³; the arm's compliance makes it smaller.
        arm_compliance, arm_compliance_sigma: compliance of arm and mount, from the difference of both, m/N.
    """

    moments: float
    moments_sigma: float
    depth: float
    depth_sigma: float
    arm_compliance: float
    arm_compliance_sigma: float


@dataclass(frozen=True, slots=True)
class Residuals:
    """RMS errors of touches that the fit has not seen, relative to the truth.

    Attributes:
        touches: number of touches.
        force: error of the force.
        moments: error of second moments.
        curvature: error of curvature relative to (κ + 1/R_p).
        rod_curvature: error of the curvature across the rod, relative to the same.
    """

    touches: int
    force: float
    moments: float
    curvature: float
    rod_curvature: float


@dataclass(frozen=True, slots=True)
class ArrayCalibration:
    """The calibration of one array.

    Attributes:
        array: name and serial number of the array.
        date: date in ISO 8601.
        made_on: cell and objects on which it was made, and what moved.
        force_reference: the reference of newtons.
        force_sigma: relative standard deviation of that reference; NaN for "none".
        full_scale: pressure of a full count at which it was made, Pa.
        image: parameters of the image model.
        moments: errors of second moments.
        noise: noise of the place of a contact.
        centroid: delays of the centroid.
        stiffness: stiffness of the layer from both sources.
        residuals: held-out errors.
        force: errors of the force.
        gains: (rows, columns) gains of the taxels over their mean; empty where they were not found or are not used.
        dead: (row, column) of each taxel that reads nothing under a patch.
        serial_number: serial number of the array (1018h:04), or its name; None of a make, and where nobody named it.
        verified: date of the last touches that it held for, ISO 8601; None: never.
        of_make: whether the array that is used is another one of the make.
    """

    array: str
    date: str
    made_on: str
    force_reference: ForceReference
    force_sigma: float
    full_scale: float
    image: ImageParameters
    moments: MomentErrors
    noise: ContactNoise
    centroid: CentroidDelays
    stiffness: StiffnessSources
    residuals: Residuals
    force: ForceErrors = UNSTATED
    gains: tuple[tuple[float, ...], ...] = ()
    dead: tuple[tuple[int, int], ...] = ()
    serial_number: int | str | None = None
    verified: str | None = None
    of_make: bool = False

    @property
    def nominal(self) -> bool:
        """Whether newtons rest on nothing but the stated full scale."""
        return self.force_reference == "none"

    @property
    def newtons(self) -> str:
        """The reference of newtons, in words."""
        if self.nominal:
            return NO_FORCE_REFERENCE
        return f"newtons by {self.force_reference} (1σ {100.0 * self.force_sigma:.1f} %)"

    def of_another(self) -> ArrayCalibration:
        """What it says about another array of its make: no gains of single taxels, and the spread of a make."""
        force = replace(self.force, spread=max(self.force.spread, MAKE_SPREAD))
        return replace(self, gains=(), dead=(), force=force, of_make=True)

    def others_of_make(self) -> list[ArrayCalibration]:
        """What arrays of the make may have instead, each with one parameter off by a standard deviation.

        None where the array is the calibrated one.
        """
        p = self.image
        off = replace(p, blur=p.blur * (1.0 + MAKE_BLUR)), replace(p, crosstalk=p.crosstalk + MAKE_CROSSTALK)
        return [replace(self, image=image) for image in off if self.of_make]

    def with_stiffness(self, stiffness: float) -> ArrayCalibration:
        """The same calibration with another stiffness K/h of the layer, N/m³."""
        return replace(self, image=replace(self.image, stiffness=stiffness))
