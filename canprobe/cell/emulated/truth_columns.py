"""The names of the columns of `truth.npz`, with their units as in `log.npz`; the former names are understood.

Inside the plant all is SI and has no suffix. In the file, and in `result.truth`, a suffix names the unit.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

NAMES = {
    "probe_centre": "probe_centre_m",
    "force": "force_n",
    "depth": "depth_m",
    "depth_rate": "depth_rate_m_s",
    "contact_point": "contact_point_m",
    "kappa": "kappa_per_m",
    "pad_uv": "pad_uv_m",
}
"""Name in the plant, and in earlier files → name in the file. Other columns have no unit.

The joints `q` are `q_rad` and `q_m`, as in `log.npz`."""


class TruthColumns(dict[str, NDArray[Any]]):
    """Columns of the truth by name; a former name gives its column, with a warning."""

    def __missing__(self, old: str) -> NDArray[Any]:
        """The column that had this name."""
        new = NAMES.get(old, "q_rad" if "q_rad" in self else "q_m") if old in (*NAMES, "q") else old
        if not dict.__contains__(self, new):
            raise KeyError(old)
        _warn(f"truth: {old} is now {new}", stacklevel=3)
        if old == "q" and "q_m" in self and "q_rad" in self:
            return np.where(np.isnan(self["q_rad"]), self["q_m"], self["q_rad"])
        return self[new]

    def __contains__(self, name: object) -> bool:
        """Whether `truth[name]` is there; no warning."""
        has = super().__contains__
        return has(name) or has(NAMES.get(str(name), name)) or (name == "q" and (has("q_rad") or has("q_m")))

    def get(self, name: str, default: Any = None) -> Any:
        """`truth[name]` where it is there."""
        try:
            return self[name]
        except KeyError:
            return default


def with_units(columns: Mapping[str, NDArray[Any]], prismatic: Sequence[bool]) -> TruthColumns:
    """The plant's columns under the names of the file.

    Args:
        columns: columns as `Plant.truths` names them, others among them.
        prismatic: which joints slide; their positions are in ``q_m``, where other joints are NaN, as in ``log.npz``.
    """
    named = TruthColumns()
    for name, column in columns.items():
        if name != "q":
            named[NAMES.get(name, name)] = column
            continue
        slides = np.asarray(prismatic, dtype=bool)
        if not slides.all() or not len(slides):
            named["q_rad"] = np.where(slides, np.nan, column) if slides.any() else column
        if slides.any():
            named["q_m"] = column if slides.all() else np.where(slides, column, np.nan)
    return named


def present_name(old: str) -> str:
    """The present name of a column; a former one gives a warning. Joints are taken to turn."""
    new = NAMES.get(old, "q_rad" if old == "q" else old)
    if new != old:
        _warn(f"truth: {old} is now {new}")
    return new


def with_present_names(
    columns: Mapping[str, NDArray[Any]], prismatic: Sequence[bool] | None, file: object
) -> dict[str, NDArray[Any]]:
    """Columns as they were read from a file; former names become the present ones, with one warning.

    Args:
        columns: columns by name.
        prismatic: which joints slide; None where it is not known, and ``q`` keeps its name.
        file: name of the file in the warning.
    """
    old = [name for name in columns if name in NAMES or (name == "q" and prismatic is not None)]
    if not old:
        return dict(columns)
    _warn(
        f"{file}: columns without units, of an earlier canprobe: {', '.join(old)}; they are read under their new names"
    )
    if prismatic is not None and (columns.get("q", np.empty((0, 0))).shape[1:] == (len(prismatic),)):
        return dict(with_units(columns, prismatic))
    return {NAMES.get(name, name): column for name, column in columns.items()}


def _warn(text: str, stacklevel: int = 4) -> None:
    warnings.warn(text, FutureWarning, stacklevel=stacklevel)
