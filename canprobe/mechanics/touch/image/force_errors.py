"""Errors of the force that an array measures, and the standard deviation of one reading.

Four causes, taken for independent: the reference of newtons; the array (gains of taxels, hysteresis, what is lost below
the threshold, the form of the image model); creep, as far as `ForceCreep` does not correct it; and taxels that do not
measure, whose share is interpolated. A saturated patch and one that runs off the pad show only a lower bound: their
standard deviation is infinite.

The variance of the array's part grows with the level over the peak pressure, as that of second moments does: a light
touch presses few taxels, and loses more of its force below the threshold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

USUAL_LIGHTNESS = 0.05
"""Level over peak pressure for which relative errors of force and moments hold; light touches have larger ones."""
UPPER_SIGMAS = 2.0
"""Standard deviations from a measured force to its upper end, which the supervision compares with the limit."""
BRIDGED_SIGMA = 0.1
"""Error of what is interpolated over taxels that do not measure, over the interpolated force: over 200 random presses
below 5 % of the force with one dead row, which takes up to a third of it."""
STRAIGHT_SHARE, BENT_SIGMA = 0.7, 0.06
"""Peak over full scale from which on taxels bend off before they saturate, and the error of the force that grows from
there up to full scale, relative: touches with a higher peak are left out of a calibration."""
CUT_SIGMA = 0.05
"""Error of the force of a patch that reaches the pad's edge, relative: a part of it lies beyond. At a window's edge it
is this times the pressure there over the peak: over 480 random presses forces are too small by 1.5 times that."""
FAINT_LIGHTNESS = 0.2
"""Level over peak pressure from which on a touch is faint: the threshold hides most of its rim, and the force is too
small by the square of what is above this. Over 480 random presses that is 1 % at 0.3 and 13 % at 0.55."""
DRIFT_SIGMA, DRIFT_S = 0.015, 10.0
"""Error of the force by changes since the tare, relative, and the time in which they come. The gain of a film changes
by 0.36 % a degree, and a millimetre of rubber takes on the temperature of what it touches within 10 s. Source: Tekscan,
FlexiForce A201, data sheet."""
BEYOND_SIGMA = 0.05
"""Error of a force above those of the calibration, relative, for each unit of `ForceErrors.beyond`: of scans with 5 to
15 N by a calibration up to 3 N forces are 1 to 6 % too small for each, by the window and the form of a large patch."""


def faint_share(lightness: float) -> float:
    """Share of the force of a touch that the threshold may hide, for the level over its peak pressure."""
    return max(lightness - FAINT_LIGHTNESS, 0.0) ** 2


def upper_end(force: float, sigma: float) -> float:
    """Upper end of a force with a standard deviation, both in N: the true force is above it once in fifty."""
    return force + UPPER_SIGMAS * sigma


class ForceSigma(NamedTuple):
    """Standard deviation of a measured force by its causes, N.

    Attributes:
        reference: the reference of newtons; 0 where there is none, and newtons are nominal.
        array: gains, hysteresis, form of the patch, and drift since the tare.
        creep: what the creep correction leaves.
        taxels: what taxels that do not measure or bend off, the threshold, and the edges of pad and window hide;
            infinite for a lower bound.
    """

    reference: float = 0.0
    array: float = 0.0
    creep: float = 0.0
    taxels: float = 0.0

    @property
    def total(self) -> float:
        """Standard deviation of the force, N."""
        return math.hypot(*self)


@dataclass(frozen=True, slots=True)
class ForceErrors:
    """Errors of the force that an array measures, relative, as its calibration states them.

    Attributes:
        creep: growth of the reading under a constant load, per decade of time; 0: it is not corrected.
        creep_sigma: standard deviation of that growth.
        creep_decades: decades of creep in the touches that newtons rest on.
        array: standard deviation of the force at `USUAL_LIGHTNESS`.
        spread: standard deviation of the force from array to array, where the calibration stands for a make.
        highest: largest force of the touches that the calibration was fitted to, N; infinite where it is not known.
    """

    creep: float
    creep_sigma: float
    creep_decades: float
    array: float
    spread: float
    highest: float = math.inf

    def beyond(self, force: float) -> float:
        """How far a force (N) is above all that the calibration has seen: logarithm of their ratio, at least 0."""
        return math.log(max(force / self.highest, 1.0))

    def sigma(
        self,
        force: float,
        lightness: float,
        creep_n: float,
        late_decades: float = 0.0,
        *,
        reference: float = 0.0,
        peak: float = 0.0,
        bridged: float = 0.0,
        cut: float = 0.0,
        faint: float = 0.0,
        age_s: float = 0.0,
    ) -> ForceSigma:
        """Standard deviation of a measured force.

        Args:
            force: force, N.
            lightness: level over peak pressure, up to 1.
            creep_n: what one unit of growth per decade adds to this reading, less what it added to those of the
                calibration, N.
            late_decades: decades of time beyond the slowest relaxation of the creep correction.
            reference: relative standard deviation of the reference of newtons.
            peak: peak pressure over full scale.
            bridged: share of the force that is interpolated over taxels that do not measure.
            cut: 1 where the patch reaches the pad's edge, else the pressure at the window's edge over the peak.
            faint: share of the force that the threshold may hide (`faint_share`); not taken from `lightness`, as a plan
                has that of a layer, which a flat array does not have.
            age_s: time since the tare, s.
        """
        light = self.array * math.sqrt(max(lightness / USUAL_LIGHTNESS, 1.0))
        drift = DRIFT_SIGMA * (1.0 - math.exp(-age_s / DRIFT_S))
        bent = min(max(peak - STRAIGHT_SHARE, 0.0) / (1.0 - STRAIGHT_SHARE), 1.0)
        late = force * late_decades * math.hypot(self.creep, self.creep_sigma)
        return ForceSigma(
            reference * force,
            force * math.hypot(light, drift, self.spread, BEYOND_SIGMA * self.beyond(force)),
            math.hypot(self.creep_sigma * creep_n, late),
            force * math.hypot(BRIDGED_SIGMA * bridged, BENT_SIGMA * bent, CUT_SIGMA * cut, faint),
        )


UNSTATED = ForceErrors(creep=0.0, creep_sigma=0.05, creep_decades=2.0, array=0.015, spread=0.05)
"""Errors of an array whose calibration does not state them: creep of 5 % per decade, as data sheets of resistive arrays
give it, and not corrected."""
MAKE_SPREAD = 0.1
"""Stated standard deviation of the force between arrays of one make, which touches of one array do not show: gains
within 15 % of the make's, and blur, hysteresis and creep of each."""
