"""The data of a finished run, the source of its files and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.planning.model import Plan
from canprobe.cell.results.scores import Contacts, contacts_of
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch.contact import ContactSample
    from canprobe.mechanics.touch.map.surface_map import SurfaceMap


@dataclass(frozen=True)
class RunData:
    """All data of a finished run; `RunResult` explains each attribute but those of the contacts.

    Attributes:
        tracker: tracker of the scan's contacts; None without a shape.
        start_s: time of the first SYNC on the clock of the log, s.
    """

    plan: Plan
    summary: dict[str, Any]
    log: Mapping[str, Floats]
    truth: Mapping[str, Floats]
    estimates: dict[str, list[ShapeRecord]]
    taxels: NDArray[np.uint8] | None
    tactile: Mapping[str, NDArray[Any]]
    out: Path | None
    tracker: ShapeTracker | None
    start_s: float

    @property
    def surface_map(self) -> SurfaceMap | None:
        return None if self.tracker is None else self.tracker.surface_map

    @cached_property
    def settled(self) -> list[ContactSample]:
        """The contacts of the scan, with the depths that are known at its end (`ShapeTracker.settled`)."""
        task = self.plan.setup.task
        return [] if self.tracker is None or not isinstance(task, Touch) else self.tracker.settled(task.probe.radius)

    @cached_property
    def contacts(self) -> Contacts | None:
        """The measured contacts of the scan; None without a shape."""
        task = self.plan.setup.task
        if self.tracker is None or not isinstance(task, Touch):
            return None
        return contacts_of(self.settled, task, self.start_s)
