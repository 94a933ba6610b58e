"""Values that differ between episodes, by the keys of a scene file, fixed or drawn, and the objects to draw from.

Objects are those to train on, and those that are held out: other kinds, not other sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from canprobe.errors import UsageError

Values = Mapping[str, Any]
"""Value as in a scene file, or a draw of one, by dotted key."""


@dataclass(frozen=True, slots=True)
class Uniform:
    """A value that is drawn uniformly for each episode.

    Attributes:
        low: least number, or a tuple of them, in the unit of the key.
        high: largest one; tuples are drawn element by element.
    """

    low: float | tuple[float, ...]
    high: float | tuple[float, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """A number, or a tuple of them."""
        values = rng.uniform(self.low, self.high)
        return values if isinstance(values, float) else tuple(values.tolist())


@dataclass(frozen=True, slots=True)
class OneOf:
    """A value that is one of several, equally likely, for each episode.

    Attributes:
        values: possible values of the key; a value may itself be a draw, or a table with draws in it.
    """

    values: Sequence[Any]

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw one of the values."""
        return drawn(self.values[int(rng.integers(len(self.values)))], rng)


def drawn(value: Any, rng: np.random.Generator) -> Any:
    """The value with all its draws made."""
    if isinstance(value, Uniform | OneOf):
        return value.draw(rng)
    if isinstance(value, Mapping):
        return {key: drawn(item, rng) for key, item in value.items()}
    return value


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
OBJECTS: Mapping[str, OneOf] = {"train": OneOf(_TRAIN), "held_out": OneOf(_HELD_OUT)}
"""Sets of objects by name: the section `[object]` of an episode's scene, round the start point of the default scene."""


def overrides_of(options: Values, rng: np.random.Generator) -> dict[str, Any]:
    """Options of a reset as overrides of a scene, with everything drawn.

    `objects` names a set of `OBJECTS`; keys of the object replace the values drawn from it.

    Raises:
        UsageError: when there is no such set.
    """
    values = dict(options)
    objects = values.pop("objects", None)
    if objects is not None and objects not in OBJECTS:
        known = ", ".join(OBJECTS)
        raise UsageError(f"objects: expected one of {known}, or None for that of the scene, got {objects!r}")
    chosen = {} if objects is None else {"object": OBJECTS[objects]}
    return {key: drawn(value, rng) for key, value in {**chosen, **values}.items()}
