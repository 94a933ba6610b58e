"""Stiffness of the pad's layer from a whole scan: the slope of its touch, and its images at the map's curvature.

Both need the curvature, which the map knows better than any estimate at the touch. On a Winkler layer the slope b gives
k = 2 √det A b² / π, and the patch's second moments V give k = F / (18 π √det A √det V); for a real array a calibrated
model takes the place of the second formula, and images count where it holds (`ImageModel.trust`). They are about
equally good. Where they disagree the slope counts less: it is of one place, where an edge or a groove may have been.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.image.image_model import ImageModel
from canprobe.mechanics.types import Floats

SOURCE_SIGMA = 0.031
"""Standard deviation of ln k from either source. Over 56 development shapes and draws of `study shapes` images err by
2.6 %, slopes by 3.7 % away from grooves and edges, and both together by 2.3 %; on grooves the slope is 30 % too
small."""
MAX_IMAGES = 30
"""Most images whose moments are compared."""
_NEWTON_STEPS, _DIFFERENCE, _MAX_LOG = 4, 0.02, 1.5


class Stiffness(NamedTuple):
    """Stiffness k, N/m³, and the standard deviation of its logarithm."""

    value: float
    sigma: float


def fused_stiffness(slope: float | None, images: float | None, stated: Stiffness) -> Stiffness:
    """One stiffness of ln k by the slope and by images (None: not known); the stated one where neither is."""
    if slope is None and images is None:
        return stated
    if slope is None or images is None:
        return Stiffness(math.exp(images if slope is None else slope), SOURCE_SIGMA)  # type: ignore[arg-type]
    of_images = SOURCE_SIGMA**-2
    # the difference has the variance of both sources: what is left beyond that of the images is the slope's
    of_slope = 1.0 / max(SOURCE_SIGMA**2, (slope - images) ** 2 - SOURCE_SIGMA**2)
    mean = (of_images * images + of_slope * slope) / (of_images + of_slope)
    return Stiffness(math.exp(mean), (of_images + of_slope) ** -0.5)


def log_of_images(model: ImageModel, patches: Floats, forces: Floats, kappa: Floats) -> float | None:
    """Median of ln k from √det of second moments (n,), m², forces (n,), N, and curvatures (n, 2), 1/m; None without."""
    found = [_log_of_image(model, *one) for one in zip(patches.tolist(), forces.tolist(), kappa.tolist(), strict=True)]
    known = [value for value in found if value is not None]
    return float(np.median(known)) if known else None


def _log_of_image(model: ImageModel, patch: float, force: float, kappa: list[float]) -> float | None:
    """ln k at which the model shows a patch of this size, by Newton's method; None where it does not hold."""
    k = kappa[0], 0.0, kappa[1]

    def layer(stiffer: float) -> ImageModel:
        return model.with_stiffness(model.parameters.stiffness * math.exp(stiffer))

    def apart(stiffer: float) -> float:
        xx, xy, yy = layer(stiffer).moments(k, force)
        return 0.5 * math.log((xx * yy - xy * xy) / patch**2)

    stiffer = 0.0
    try:
        for _ in range(_NEWTON_STEPS):
            here = apart(stiffer)
            step = here * _DIFFERENCE / (apart(stiffer + _DIFFERENCE) - here)
            stiffer = min(max(stiffer - step, -_MAX_LOG), _MAX_LOG)
            if abs(step) < 0.2 * SOURCE_SIGMA:
                break
        trust = layer(stiffer).trust(k, force)
    except (ValueError, ZeroDivisionError):  # hollower than the probe, or nothing above the level
        return None
    # a cut patch looks like that of a soft layer
    return math.log(model.parameters.stiffness) + stiffer if trust == 1.0 else None
