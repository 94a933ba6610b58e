"""What differs from one episode to the next: values by the keys of a scene file, fixed or drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from canprobe.errors import UsageError

Values = Mapping[str, Any]
"""By dotted key; a value is one of the scene's, or a draw."""


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
class Choice:
    """A value that is one of several, each as likely, for each episode.

    Attributes:
        values: of the key; they may be draws themselves, or tables with draws in them.
    """

    values: Sequence[Any]

    def draw(self, rng: np.random.Generator) -> Any:
        """One of them."""
        return drawn(self.values[int(rng.integers(len(self.values)))], rng)


def drawn(value: Any, rng: np.random.Generator) -> Any:
    """The value with everything drawn that is to be drawn."""
    if isinstance(value, Uniform | Choice):
        return value.draw(rng)
    if isinstance(value, Mapping):
        return {key: drawn(item, rng) for key, item in value.items()}
    return value


# Objects to train on, and those that are held out: other kinds, not other sizes.

START_MM = (-150.0, -150.0, 374.0)
"""Where the default scene expects its object."""
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
OBJECTS: Mapping[str, Choice] = MappingProxyType({"train": Choice(_TRAIN), "held_out": Choice(_HELD_OUT)})
"""Sets of objects by name: the section `[object]` of an episode's scene, round the start point of the default scene."""


def overrides_of(options: Values, rng: np.random.Generator) -> dict[str, Any]:
    """Options of a reset as overrides of a scene, with everything drawn.

    `objects` names a set of `OBJECTS`; keys of the object come on top of what was drawn from it.

    Raises:
        UsageError: there is no such set.
    """
    options = dict(options)
    objects = options.pop("objects", None)
    if objects is None:
        return {key: drawn(value, rng) for key, value in options.items()}
    if objects not in OBJECTS:
        known = ", ".join(OBJECTS)
        raise UsageError(f"objects: expected one of {known}, or None for that of the scene, got {objects!r}")
    return {"object": OBJECTS[objects].draw(rng)} | {key: drawn(value, rng) for key, value in options.items()}
