"""Positions of joints: columns `q_rad` for those that turn, `q_m` for those that slide, one place a joint in each."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, MutableSequence
from dataclasses import astuple, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import TactileSample
from canprobe.fieldbus.protocol.tactile import Features
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


class TactileLog:
    """The tactile frames that the cell used: images and what belongs to them, for `tactile.npz`.

    Args:
        kept: how many frames are kept, the last ones; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._rows: MutableSequence[tuple[int, TactileSample]] = [] if kept is None else deque(maxlen=kept)

    def add(self, t_ns: int, sample: TactileSample) -> None:
        """Append the sample that became usable in the cycle at ``t_ns``."""
        self._rows.append((t_ns, sample))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """One row a frame (m, ...): when it was usable and sampled, s, taxels, their window, features; empty without.

        Features (m, 7) are NaN in a frame of taxels. A device of raw frames has their values (m, rows, columns, axes).
        """
        if not self._rows:
            return {}
        frames = [sample.frame for _, sample in self._rows]
        none = (np.nan,) * len(fields(Features))
        raw = [frame.raw for frame in frames if frame.raw is not None]
        return ({"raw": np.array(raw)} if raw else {}) | {
            "t_s": np.array([t_ns * 1e-9 for t_ns, _ in self._rows]),
            "t_sample_s": np.array([sample.t_sample_ns * 1e-9 for _, sample in self._rows]),
            "t_sigma_s": np.array([sample.t_sigma_s for _, sample in self._rows]),
            "taxels": np.array([frame.taxels for frame in frames]),
            "window": np.array([frame.window for frame in frames]),
            "features": np.array([none if f.features is None else astuple(f.features) for f in frames]),
        }
