"""Units of keys: the end of a key is its unit.

One table says what it is called, how large it is in SI, and which other unit people give in its place. `in_si` reads a
section by this table, and `in_units` writes one.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

from canprobe.cell.scene.checks import annotations_of, values_of

Section = TypeVar("Section")


class Unit(NamedTuple):
    """The unit of a key.

    Attributes:
        text: its name, as the page of keys and the schemas have it.
        si: its size in SI; None: a key keeps its unit, as counts.
        other: another unit in which people give such a value, and the size of that one in this.
    """

    text: str
    si: float | None = 1.0
    other: tuple[str, float] | None = None


UNITS: Mapping[str, Unit] = {  # the longest end that fits
    "bitrate": Unit("bit/s", None, ("kbit/s", 1e3)),
    "n_m3": Unit("N/m³", 1.0, ("N/mm³", 1e9)),
    "nm_rad": Unit("N m/rad"),
    "kg_m2": Unit("kg m²"),
    "nm_s": Unit("N m s"),
    "n_s_m": Unit("N s/m"),
    "um_n": Unit("µm/N", 1e-6),
    "n_m": Unit("N/m"),
    "deg_s2": Unit("°/s²", math.radians(1)),
    "mm_s2": Unit("mm/s²", 1e-3),
    "deg_s": Unit("°/s", math.radians(1)),
    "nm": Unit("N m"),
    "counts": Unit("units of the drive", None),
    "mm_s": Unit("mm/s", 1e-3, ("m/s", 1e3)),
    "s_m": Unit("s/m"),
    "percent": Unit("%", 1e-2),
    "permille": Unit("‰", 1e-3),
    "hz": Unit("Hz", 1.0, ("kHz", 1e3)),
    "kpa": Unit("kPa", 1e3, ("Pa", 1e-3)),
    "deg": Unit("°", math.radians(1)),
    "kg": Unit("kg"),
    "mm": Unit("mm", 1e-3, ("metres", 1e3)),
    "ms": Unit("ms", 1e-3, ("seconds", 1e3)),
    "us": Unit("µs", 1e-6, ("seconds", 1e6)),
    "um": Unit("µm", 1e-6),
    "n": Unit("N"),
    "s": Unit("s", 1.0, ("milliseconds", 1e-3)),
}
NO_UNIT = Unit("", None)


@functools.cache
def unit_of(key: str) -> Unit:
    """The unit of a key, `NO_UNIT` for a number without one and for what is no number."""
    return next((unit for end, unit in UNITS.items() if f"_{key}".endswith(f"_{end}")), NO_UNIT)


@functools.cache
def quantity_of(key: str) -> str:
    """The name of a key without its unit; that of a key which keeps its unit is the key."""
    end = next((end for end in UNITS if f"_{key}".endswith(f"_{end}")), "")
    return key.removesuffix(f"_{end}") if end and UNITS[end].si is not None else key


def in_si(section: Any) -> dict[str, Any]:
    """The keys of a section that have a value and belong to the others, by `quantity_of`, in SI."""
    return {
        quantity_of(key): value if (size := unit_of(key).si) is None else _times(value, size)
        for key, value in values_of(section).items()
    }


def _times(value: Any, size: float) -> Any:
    return tuple(_times(one, size) for one in value) if isinstance(value, tuple) else value * size


def in_units(cls: type[Section], quantities: Mapping[str, Any], digits: int = 5) -> Section:
    """A section from quantities in SI by `quantity_of`, numbers to some digits; what is not finite is left out."""
    values = {}
    for key in annotations_of(cls):
        value = quantities.get(quantity_of(key))
        if isinstance(value, float):
            value = float(f"{value / (unit_of(key).si or 1.0):.{digits}g}") if math.isfinite(value) else None
        values[key] = value
    return cls(**values)
