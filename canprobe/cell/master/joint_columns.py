"""Positions of joints: columns `q_rad` for those that turn, `q_m` for those that slide, one place a joint in each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.types import Floats


def joint_columns(name: str, q: Floats, prismatic: NDArray[np.bool_] | None) -> dict[str, Floats]:
    """Joint positions as columns of the log: of an arm whose joints all turn `name_rad` alone, else with `name_m`.

    Args:
        name: `q` or `q_target`.
        q: (n,) rad or m.
        prismatic: (n,) which joints slide; None: none of them.

    Returns:
        (n,) each, NaN where a joint is of the other kind.
    """
    if prismatic is None:
        return {f"{name}_rad": q}
    sliding = {f"{name}_m": np.where(prismatic, q, np.nan)}
    return sliding if prismatic.all() else {f"{name}_rad": np.where(prismatic, np.nan, q), **sliding}


def joint_positions(log: Mapping[str, Floats], name: str = "q") -> Floats | None:
    """The inverse of `joint_columns` for a whole log: (rows, n) rad or m; None where it has no such columns.

    Args:
        log: columns by name.
        name: `q` or `q_target`.
    """
    turning, sliding = log.get(f"{name}_rad"), log.get(f"{name}_m")
    if turning is None or sliding is None:
        return sliding if turning is None else turning
    return np.where(np.isnan(turning), sliding, turning)
