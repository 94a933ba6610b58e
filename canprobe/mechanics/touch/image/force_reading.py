"""The force of each image of an array in its order, without creep, with its standard deviation."""

from __future__ import annotations

import math
from dataclasses import replace

from canprobe.mechanics.touch.image.force_creep import ForceCreep
from canprobe.mechanics.touch.image.force_errors import ForceSigma, faint_share
from canprobe.mechanics.touch.image.patch import Patch, PatchCalibration
from canprobe.mechanics.touch.stops import TOUCH_FORCE


class ForceReading:
    """Follows the load of one array from image to image.

    Args:
        calibration: calibration of the array.
    """

    def __init__(self, calibration: PatchCalibration) -> None:
        self._errors, self._reference = calibration.force_errors, calibration.reference_sigma
        self._pad = calibration.pad
        self._creep = ForceCreep(self._errors.creep)
        self._began_s: float | None = None

    def widen(self, spread: float) -> None:
        """State forces with this relative standard deviation between arrays from now on, where it is the larger one."""
        self._errors = replace(self._errors, spread=max(spread, self._errors.spread))

    def step(self, t_s: float, patch: Patch) -> Patch:
        """The patch of an image with its force and the standard deviation of it.

        Args:
            t_s: time of the image, s; not before that of the last one.
            patch: patch of this image alone.
        """
        errors, creep = self._errors, self._creep
        self._began_s = t_s if self._began_s is None else self._began_s
        shown = creep.step(t_s, patch.force, touching=patch.force >= TOUCH_FORCE / 2)
        # newtons rest on touches that had crept by so many decades: their creep is in the gains
        force = shown * (1.0 + errors.creep * errors.creep_decades)
        lightness = self._pad.lightness(patch.peak_pa)
        sigma = errors.sigma(
            force,
            lightness,
            creep.decades_n - errors.creep_decades * shown,
            creep.late_decades,
            reference=self._reference,
            peak=patch.peak_pa / self._pad.full_scale_pa,
            bridged=patch.bridged,
            cut=1.0 if patch.cut_by_pad else patch.cut_by_window,
            faint=faint_share(lightness),
            age_s=t_s - self._began_s,
        )
        if patch.saturated or patch.off_pad:
            sigma = ForceSigma(sigma.reference, sigma.array, sigma.creep, math.inf)
        return patch._replace(force=force, sigma=sigma)
