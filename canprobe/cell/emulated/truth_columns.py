"""The names of the columns of `truth.npz`, with their units as in `log.npz`.

Inside the plant all is SI and has no suffix. In the file, and in `result.truth`, a suffix names the unit.
"""

from __future__ import annotations

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
"""Name in the plant → name in the file. Other columns have no unit.

The joints `q` are `q_rad` and `q_m`, as in `log.npz`."""


def with_units(columns: Mapping[str, NDArray[Any]], prismatic: Sequence[bool]) -> dict[str, NDArray[Any]]:
    """The plant's columns under the names of the file.

    Args:
        columns: columns as `Plant.truths` names them, others among them.
        prismatic: which joints slide; their positions are in ``q_m``, where other joints are NaN, as in ``log.npz``.
    """
    named: dict[str, NDArray[Any]] = {}
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
