"""Touches of known objects, what their images show, and the priors of the image model's parameters.

The curvature of the object and the place on the pad are known for each touch. The force is an unknown of each touch,
but for those with a reference force that something else measured. Without any reference the scale of the force is a
guess, and the stiffness with it.

Planes and balls alone hardly separate blur, crosstalk and memory: these three have a weak prior from arrays of films
and foams.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.image.force_errors import STRAIGHT_SHARE
from canprobe.mechanics.touch.image.moments import MomentImage, PadMemory
from canprobe.mechanics.touch.image.patch import PatchCalibration, compute_patch
from canprobe.mechanics.touch.image.silent_taxels import Image
from canprobe.mechanics.types import Floats

BLUR_PRIOR_PITCH = (0.7, 0.2)
CROSSTALK_PRIOR = (0.025, 0.01)
MEMORY_PRIOR = (0.03, 0.02)
"""Mean and standard deviation of the parameters' priors; the blur is in pitches."""
TOUCH_SIGMA = 0.012
"""Relative error of moments and sums of a touch: gains, hysteresis and creep."""
FIRST_IMAGE_S, LAST_IMAGE_S = 0.5, 3.5
"""Time from the touch to the first image that is used, and to the last, s: all touches are compared after the same
creep."""
MIN_CURVATURE_SHARE = -0.9
"""Least curvature in a search, over that of the probe."""
MIN_IMAGES = 10
"""Least number of images with a patch in a touch."""


@dataclass(frozen=True, slots=True, eq=False)
class Dwell:
    """One touch of a known object, pressed and rolled.

    Attributes:
        name: name of the object: "plane", "ball", "rod".
        kappa: principal curvatures of the object, larger first, 1/m.
        angle: direction of the first on the pad, from u, rad.
        place: number of the place that is touched; touches at one place differ in force only.
        t_s: (n,) time stamps of the images, s.
        images: (n,) images, (16, 16) counts, 0 outside the window.
        windows: (n,) first row, first column, rows, columns of each window.
        expected: (n, 2) places of the contact on the pad by joints and object, m.
        push: (n,) way of the probe's centre towards the object, from any zero, m.
        turn: turn of the probe about its pole, from the first touch, rad.
        force: reference force, N; None where nothing measured it.
        to_and_fro: whether it rolls along one line, slowly and then fast; else along an eight.
    """

    name: str
    kappa: tuple[float, float]
    angle: float
    place: int
    t_s: Floats
    images: Sequence[Image]
    windows: Sequence[Sequence[int]]
    expected: Floats
    push: Floats
    turn: float = 0.0
    force: float | None = None
    to_and_fro: bool = False


class Shown(NamedTuple):
    """What the images of a dwell show, averaged; moments in the object's principal axes, m².

    Attributes:
        dwell: the dwell.
        total: sum of pressure times area, N.
        crept: mean of that sum over the whole touch, over `total`.
        moments, remembered: (3,) xx, xy, yy of the image, and of the earlier places (`PadMemory`).
        frame_sigma: relative standard deviation of a moment from frame to frame.
        lightness: level over peak pressure.
        off: (n, 2) centroids less their expected places, m.
        way: (n, 2) expected places, m.
        t_s: (n,) time stamps, s.
        raw: (n, 2) centroids, m.
        usable: whether the touch neither saturates nor leaves the pad.
        push: mean way of the probe's centre, m.
        pushes: (n,) way of the probe's centre in each image, m.
        sums: (n,) sum of pressure times area in each image, N.
    """

    dwell: Dwell
    total: float
    crept: float
    moments: Floats
    remembered: Floats
    frame_sigma: float
    lightness: float
    off: Floats
    way: Floats
    t_s: Floats
    raw: Floats
    usable: bool
    push: float
    pushes: Floats
    sums: Floats


def what_is_shown(dwell: Dwell, plain: PatchCalibration, age_s: float = math.inf) -> Shown:
    """Mean sum and moments of a dwell's images.

    Args:
        dwell: the touch.
        plain: pressures of the array, with a force gain of 1 and an edge gain of 0.
        age_s: time from the touch to the last image that is used, s.

    Raises:
        UsageError: the images show no patch.
    """
    image_moments, memory = MomentImage(plain), PadMemory()
    start, end = dwell.t_s[0] + FIRST_IMAGE_S, dwell.t_s[0] + age_s
    rows, late = [], []
    for i, (t, image) in enumerate(zip(dwell.t_s.tolist(), dwell.images, strict=True)):
        patch = compute_patch(image, plain, dwell.windows[i])
        if not patch.n_active:
            continue
        way = memory.add(t, patch.u, patch.v)
        found = image_moments.moments(image)
        if t < start or found is None:
            continue
        if t > end and not dwell.to_and_fro:
            late.append(patch.force)
            continue
        rows.append((i, patch, found, way))
    if len(rows) < MIN_IMAGES:
        raise UsageError(
            f"a touch of the {dwell.name}: expected a patch in its images, got {len(rows)} images with one"
        )
    kept, patches, moments, ways = (list(column) for column in zip(*rows, strict=True))
    c, s = math.cos(dwell.angle), math.sin(dwell.angle)
    turn = np.array([[c * c, 2 * c * s, s * s], [-c * s, c * c - s * s, c * s], [s * s, -2 * c * s, c * c]])
    sums, raw = np.array([p.force for p in patches]), np.array([(p.u, p.v) for p in patches])
    V, peak = np.array(moments), float(np.mean([p.peak_pa for p in patches]))
    bad = sum(p.saturated or p.cut_by_pad for p in patches)
    steps = np.diff(V[:, [0, 2]], axis=0) / V[:, [0, 2]].mean(axis=0)
    return Shown(
        dwell=dwell,
        total=float(np.mean(sums)),
        crept=float(np.mean([*sums, *late]) / np.mean(sums)),
        moments=turn @ V.mean(axis=0),
        remembered=turn @ np.mean(ways, axis=0),
        frame_sigma=float(steps.std() / math.sqrt(2.0)),  # a step has the noise of two frames
        lightness=plain.pad.lightness(peak),
        off=raw - dwell.expected[kept],
        way=dwell.expected[kept],
        t_s=dwell.t_s[kept],
        raw=raw,
        usable=bad <= 0.2 * len(kept) and peak < STRAIGHT_SHARE * plain.pad.full_scale_pa,
        push=float(dwell.push[kept].mean()),
        pushes=dwell.push[kept],
        sums=sums,
    )
