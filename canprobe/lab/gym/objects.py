"""Objects to train on, and those that are held out: other kinds, not other sizes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from canprobe.errors import UsageError
from canprobe.lab.gym.randomise import OneOf, Uniform, Values, drawn

START_MM = (-150.0, -150.0, 374.0)
"""Place where the default scene expects its object, mm."""
_ABOUT = {"position_mm": Uniform((*START_MM[:2], START_MM[2] - 1.0), (*START_MM[:2], START_MM[2] + 1.0))}
_TURNED = _ABOUT | {"rotation_deg": Uniform((0.0, 0.0, -90.0), (0.0, 0.0, 90.0))}
_TRAIN = (
    {"kind": "cylinder", "radius_mm": Uniform(36.0, 80.0), **_TURNED},
    {"kind": "sphere", "radius_mm": Uniform(40.0, 100.0), **_ABOUT},
    {"kind": "wave", "amplitude_mm": Uniform(0.4, 1.0), "wavelength_mm": Uniform(50.0, 70.0), **_TURNED},
)
_AXES = {"radius_x_mm": Uniform(50.0, 60.0), "radius_y_mm": Uniform(40.0, 50.0), "radius_z_mm": Uniform(40.0, 50.0)}
_HELD_OUT = (
    {"kind": "ellipsoid", **_AXES, **_TURNED},
    {"kind": "saddle", "radius_x_mm": Uniform(40.0, 80.0), "radius_y_mm": Uniform(-200.0, -100.0), **_TURNED},
    {"kind": "torus", "ring_radius_mm": Uniform(100.0, 140.0), "radius_mm": Uniform(40.0, 60.0), **_TURNED},
    {"kind": "fillet", "radius_mm": Uniform(30.0, 50.0), "angle_deg": Uniform(20.0, 30.0), **_TURNED},
)
OBJECTS: Mapping[str, OneOf] = MappingProxyType({"train": OneOf(_TRAIN), "held_out": OneOf(_HELD_OUT)})
"""Sets of objects by name: the section `[object]` of an episode's scene, round the start point of the default scene."""


def overrides_of(options: Values, rng: np.random.Generator) -> dict[str, Any]:
    """Options of a reset as overrides of a scene, with everything drawn.

    `objects` names a set of `OBJECTS`; keys of the object replace the values drawn from it.

    Raises:
        UsageError: when there is no such set.
    """
    options = dict(options)
    objects = options.pop("objects", None)
    if objects is None:
        return {key: drawn(value, rng) for key, value in options.items()}
    if objects not in OBJECTS:
        known = ", ".join(OBJECTS)
        raise UsageError(f"objects: expected one of {known}, or None for that of the scene, got {objects!r}")
    return {"object": OBJECTS[objects].draw(rng)} | {key: drawn(value, rng) for key, value in options.items()}
