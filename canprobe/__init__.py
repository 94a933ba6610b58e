"""A robot cell on a CAN bus: PUMA 260, tactile servo and local shape from touch, over CANopen.

Public names are imported when they are first used, so that `import canprobe` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from canprobe.api import open_cell, plan, run
    from canprobe.cell.controller import Command, Controller, Measurement
    from canprobe.errors import (
        BusError,
        CanprobeError,
        EdsError,
        InterfaceError,
        NodeError,
        PlanError,
        ProtocolError,
        ResultsError,
        SafetyStop,
        SceneError,
        StudyError,
        UsageError,
    )
    from canprobe.recorded.reestimate import ReplayResult, replay
    from canprobe.results.contacts import Contacts
    from canprobe.results.files import load_surface_map, load_table
    from canprobe.results.summary import RunResult, measure_traffic
    from canprobe.scene.load import load_scene
    from canprobe.studies.many import Runs, run_many
    from canprobe.touch.contact import ContactSample
    from canprobe.touch.estimate.answer import SurfaceEstimate
    from canprobe.touch.estimate.fit import fit_surface
    from canprobe.touch.estimate.likelihood import cramer_rao
    from canprobe.touch.surface import SurfaceMatrix
    from canprobe.touch.surface_map import SurfaceMap

__version__ = "0.1.0"

_MODULES = {
    "canprobe.api": ("open_cell", "plan", "run"),
    "canprobe.cell.controller": ("Command", "Controller", "Measurement"),
    "canprobe.errors": (
        *("BusError", "CanprobeError", "EdsError", "InterfaceError", "NodeError", "PlanError", "ProtocolError"),
        *("ResultsError", "SafetyStop", "SceneError", "StudyError", "UsageError"),
    ),
    "canprobe.recorded.reestimate": ("ReplayResult", "replay"),
    "canprobe.scene.load": ("load_scene",),
    "canprobe.studies.many": ("Runs", "run_many"),
    "canprobe.results.contacts": ("Contacts",),
    "canprobe.results.files": ("load_surface_map", "load_table"),
    "canprobe.touch.contact": ("ContactSample",),
    "canprobe.touch.estimate.likelihood": ("cramer_rao",),
    "canprobe.touch.estimate.answer": ("SurfaceEstimate",),
    "canprobe.touch.estimate.fit": ("fit_surface",),
    "canprobe.touch.surface": ("SurfaceMatrix",),
    "canprobe.touch.surface_map": ("SurfaceMap",),
    "canprobe.results.summary": ("RunResult", "measure_traffic"),
}
_EXPORTS = {name: (module, name) for module, names in _MODULES.items() for name in names}

__all__ = [
    "BusError",
    "CanprobeError",
    "Command",
    "ContactSample",
    "Contacts",
    "Controller",
    "EdsError",
    "InterfaceError",
    "Measurement",
    "NodeError",
    "PlanError",
    "ProtocolError",
    "ReplayResult",
    "ResultsError",
    "RunResult",
    "Runs",
    "SafetyStop",
    "SceneError",
    "StudyError",
    "SurfaceEstimate",
    "SurfaceMap",
    "SurfaceMatrix",
    "UsageError",
    "__version__",
    "cramer_rao",
    "fit_surface",
    "load_scene",
    "load_surface_map",
    "load_table",
    "measure_traffic",
    "open_cell",
    "plan",
    "replay",
    "run",
    "run_many",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use (PEP 562)."""
    if name not in _EXPORTS:
        raise AttributeError(f"module 'canprobe' has no attribute {name!r}")
    module, attribute = _EXPORTS[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
