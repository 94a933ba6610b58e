"""The data of a finished run, which the files are written from and the figures are drawn from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.results.contacts import Contacts
    from canprobe.mechanics.touch.consistency import Consistency
    from canprobe.mechanics.touch.surface_map import SurfaceMap


@dataclass(frozen=True, slots=True)
class RunData:
    """Everything that is known of a run when it is over.

    Attributes:
        plan: what was planned.
        summary: the content of ``summary.json``.
        log: the columns of ``log.npz``, one row per cycle; the suffix of a name is its unit. ``t_s`` here, in the truth
            and in the estimates counts from the instant that is 0 in ``bus.log``.
        truth: the plant's true values, one row per SYNC; empty where nothing was emulated.
        estimates: the answers of each estimator, by name; the online one first.
        taxels: (rows, columns) counts of the task's last tactile frame, or None.
        tactile: the columns of ``tactile.npz``, one row per tactile frame that the cell used: ``t_s`` of the cycle,
            ``t_sample_s``, ``taxels`` (m, rows, columns), their ``window``, ``features``; empty where there was none.
        surface_map: the local patches of the online estimator, or None without a shape.
        consistency: the tests at its crossings, or None.
        out: the folder with the files, or None.
        contacts: of the scan, as the master measured them; None without a shape.
    """

    plan: Plan
    summary: dict[str, Any]
    log: dict[str, Floats]
    truth: dict[str, Floats]
    estimates: dict[str, list[ShapeRecord]] = field(default_factory=dict)
    taxels: NDArray[np.uint8] | None = None
    tactile: dict[str, NDArray[Any]] = field(default_factory=dict)
    surface_map: SurfaceMap | None = None
    consistency: Consistency | None = None
    out: Path | None = None
    contacts: Contacts | None = None
