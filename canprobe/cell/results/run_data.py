"""The data of a finished run, the source of its files and figures."""

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
    from canprobe.mechanics.touch.map.surface_map import SurfaceMap


@dataclass(frozen=True, slots=True)
class RunData:
    """All data of a finished run; `RunResult` explains each attribute."""

    plan: Plan
    summary: dict[str, Any]
    log: dict[str, Floats]
    truth: dict[str, Floats]
    estimates: dict[str, list[ShapeRecord]] = field(default_factory=dict)
    taxels: NDArray[np.uint8] | None = None
    tactile: dict[str, NDArray[Any]] = field(default_factory=dict)
    surface_map: SurfaceMap | None = None
    out: Path | None = None
    contacts: Contacts | None = None
