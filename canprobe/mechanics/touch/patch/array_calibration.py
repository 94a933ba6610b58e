"""What is known of one tactile array.

`canprobe calibrate array` finds it by touching a plane and a ball (`calibrate`), and writes it to a file. Images alone
do not show newtons: stiffness, full scale and mean gain times 1.3 give identical images and 1.3 times the force. So a
calibration names its force reference; without one forces and stiffness are in nominal newtons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from canprobe.errors import UsageError

ForceReference = Literal["scale", "weights", "unit", "none"]
NO_FORCE_REFERENCE = "nominal newtons: no force reference"


@dataclass(frozen=True, slots=True)
class ImageParameters:
    """What makes the images of an array, found by touching known things (`calibrate`).

    Attributes:
        stiffness: K/h of the layer, N/m³.
        scale: pressure that the array shows over the true one.
        blur: standard deviation of cover and taxel together, m.
        crosstalk: share of a taxel's signal that spreads over its row, and again over its column.
        memory: share of the patch's past ways on the pad (`PadMemory`) in the moments.
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
        moment: variance along a principal axis that no averaging removes (gains, hysteresis, creep, the model's form).
        both: covariance of those along the two axes.
        shear: variance of V_12 over √(V_1 V_2).
        frame_sigma: standard deviation from one frame to the next.
    """

    moment: float
    both: float
    shear: float
    frame_sigma: float


@dataclass(frozen=True, slots=True)
class Lag:
    """How far the centroid trails the contact, as a calibration found it.

    Attributes:
        most: largest distance, m.
        reach: way at which it is half of that, m.
        quick_s, slow_s: time constants of the places, s.
    """

    most: float
    reach: float
    quick_s: float = 0.02
    slow_s: float = 0.3


@dataclass(frozen=True, slots=True)
class CentroidErrors:
    """How well an image shows the place of the contact.

    Attributes:
        scale, power: the standard deviation is `scale · t^power`, m, with t the level over the peak pressure.
        correlation: way over the pad along which a part of the errors is alike, m.
        share: of the variance that this part has.
        latency_s, latency_sigma_s: by which an image is older than its time stamp says, and its standard deviation.
        lag: by which the centroid trails the contact, whatever the speed.
    """

    scale: float
    power: float
    correlation: float
    share: float
    latency_s: float
    latency_sigma_s: float
    lag: Lag

    def sigma(self, level_over_peak: float) -> float:
        """Standard deviation of a centroid per axis, m."""
        return self.scale * math.pow(min(max(level_over_peak, 0.0), 1.0), self.power)


@dataclass(frozen=True, slots=True)
class StiffnessSources:
    """Stiffness of the layer (K/h, N/m³) from the images, and from the arm's way into the object; each with its 1σ.

    The arm's way holds its own compliance too.
    """

    moments: float
    moments_sigma: float
    depth: float
    depth_sigma: float
    arm_compliance: float
    """m/N: of what the probe stands on, from the difference of both."""
    arm_compliance_sigma: float


@dataclass(frozen=True, slots=True)
class Residuals:
    """RMS errors relative to the truth, or to (K + 1/R_p): of touches that the fit has not seen, and of the rod."""

    touches: int
    force: float
    moments: float
    curvature: float
    rod_curvature: float


@dataclass(frozen=True, slots=True)
class ArrayCalibration:
    """Of one array.

    Attributes:
        array: which one: name and serial number.
        date: ISO 8601.
        made_on: cell, objects, and what moved.
        force_reference: what newtons rest on.
        force_sigma: relative standard deviation of that reference; NaN for "none".
        full_scale: at which it was made, Pa.
        image: the image model's parameters.
        moments: errors of second moments.
        centroid: errors of the centroid.
        stiffness: from both sources.
        residuals: held-out errors.
        gains: (rows, columns) of the taxels over their mean; empty where they were not found or are not used.
        dead: (row, column) of taxels that read nothing under a patch.
    """

    array: str
    date: str
    made_on: str
    force_reference: ForceReference
    force_sigma: float
    full_scale: float
    image: ImageParameters
    moments: MomentErrors
    centroid: CentroidErrors
    stiffness: StiffnessSources
    residuals: Residuals
    gains: tuple[tuple[float, ...], ...] = ()
    dead: tuple[tuple[int, int], ...] = ()

    @property
    def nominal(self) -> bool:
        """Newtons rest on nothing but the stated full scale."""
        return self.force_reference == "none"

    @property
    def newtons(self) -> str:
        """What a newton of this array is, in words."""
        if self.nominal:
            return NO_FORCE_REFERENCE
        return f"newtons by {self.force_reference} (1σ {100.0 * self.force_sigma:.1f} %)"

    def with_stiffness(self, stiffness: float) -> ArrayCalibration:
        """The same with another layer, K/h in N/m³."""
        return replace(self, image=replace(self.image, stiffness=stiffness))
