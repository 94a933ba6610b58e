"""From a calibration to the models of its array."""

from __future__ import annotations

from dataclasses import replace

from canprobe.mechanics.touch.pad import COUNTS_MAX, Pad
from canprobe.mechanics.touch.patch.array_calibration import ArrayCalibration
from canprobe.mechanics.touch.patch.image import PatchCalibration
from canprobe.mechanics.touch.patch.image_model import ImageModel
from canprobe.mechanics.touch.patch.moments import LEVEL_COUNTS

LIST_BLUR_TAXELS = 0.1
"""Blur of taxels that are separate, in pitches: the least of the image model."""
GAIN_FORCES_N = (0.5, 1.0, 2.0, 4.0)
GAIN_CURVATURES = ((0.0, 0.0), (0.8, 0.8), (1.6, 1.6), (1.2, 0.0), (0.6, -0.5))
"""Forces, and principal curvatures over that of the probe, between which the force gains hold: plane, balls, cylinder,
saddle."""


def make_patch_calibration(calibration: ArrayCalibration, pad: Pad) -> PatchCalibration:
    """From counts to force, for an array of these taxels.

    On a flat array, which has no image model, the force is the plain sum of pressure times area over the scale. The
    taxels of a list are separate: their model has the least blur. At another full scale than that of the calibration,
    level, threshold and noise are the same counts of another pressure; layer, blur, crosstalk and scale stay.
    """
    reference = 0.0 if calibration.nominal else calibration.force_sigma
    plain = PatchCalibration(pad, force_errors=calibration.force, reference_sigma=reference)
    if pad.is_flat:
        return replace(plain, force_gain=1.0 / calibration.image.scale, dead=calibration.dead)
    if not pad.is_grid:
        image = calibration.image
        calibration = replace(calibration, image=replace(image, blur=min(image.blur, LIST_BLUR_TAXELS * pad.pitch_m)))
    plain = replace(plain, gains=calibration.gains)
    gain, edge = make_image_model(calibration, plain, seen=None).force_gains(GAIN_FORCES_N, GAIN_CURVATURES)
    return replace(plain, force_gain=gain, edge_gain=edge, dead=calibration.dead, blur_m=calibration.image.blur)


def make_image_model(calibration: ArrayCalibration, patch: PatchCalibration, *, seen: int | None) -> ImageModel:
    """The image model of an array; `seen` is the number of taxels along the side of the window, None for all."""
    count, side = patch.full_scale_pa / COUNTS_MAX, max(patch.pad.shape)
    return ImageModel(
        calibration.image,
        patch.radius_m,
        patch.pitch_m,
        level=LEVEL_COUNTS * count,
        count=count,
        side=side,
        seen=side if seen is None else seen,
        errors=calibration.moments,
    )
