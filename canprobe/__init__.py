"""A robot cell on a CAN bus: PUMA 260, tactile servo and local shape from touch, over CANopen.

Public names are imported when they are first used, so that `import canprobe` costs nothing.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from canprobe.moved import MovedModules

if TYPE_CHECKING:
    from canprobe.api import open_cell, plan, run
    from canprobe.cell.master.controller import Command, Controller, Measurement
    from canprobe.cell.recorded.reestimate import ReplayResult, replay
    from canprobe.cell.results.contacts import Contacts
    from canprobe.cell.results.files import load_table
    from canprobe.cell.results.result import RunResult
    from canprobe.cell.results.surface_file import load_surface_map
    from canprobe.cell.results.traffic import measure_traffic
    from canprobe.cell.scene.load import load_scene
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
    from canprobe.lab.studies.many import Runs, run_many
    from canprobe.mechanics.touch.contact import ContactSample
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
    from canprobe.mechanics.touch.estimate.fit import fit_surface
    from canprobe.mechanics.touch.estimate.likelihood import cramer_rao
    from canprobe.mechanics.touch.map.fit import fit_map
    from canprobe.mechanics.touch.map.surface_map import SurfaceMap
    from canprobe.mechanics.touch.surface import SurfaceMatrix

__version__ = "0.2.0"

sys.meta_path.insert(0, MovedModules())

_MODULES = {
    "canprobe.api": ("open_cell", "plan", "run"),
    "canprobe.cell.master.controller": ("Command", "Controller", "Measurement"),
    "canprobe.errors": (
        *("BusError", "CanprobeError", "EdsError", "InterfaceError", "NodeError", "PlanError", "ProtocolError"),
        *("ResultsError", "SafetyStop", "SceneError", "StudyError", "UsageError"),
    ),
    "canprobe.cell.recorded.reestimate": ("ReplayResult", "replay"),
    "canprobe.cell.scene.load": ("load_scene",),
    "canprobe.lab.studies.many": ("Runs", "run_many"),
    "canprobe.cell.results.contacts": ("Contacts",),
    "canprobe.cell.results.files": ("load_table",),
    "canprobe.cell.results.surface_file": ("load_surface_map",),
    "canprobe.mechanics.touch.contact": ("ContactSample",),
    "canprobe.mechanics.touch.estimate.likelihood": ("cramer_rao",),
    "canprobe.mechanics.touch.estimate.answer": ("SurfaceEstimate",),
    "canprobe.mechanics.touch.estimate.fit": ("fit_surface",),
    "canprobe.mechanics.touch.map.surface_map": ("SurfaceMap",),
    "canprobe.mechanics.touch.map.fit": ("fit_map",),
    "canprobe.mechanics.touch.surface": ("SurfaceMatrix",),
    "canprobe.cell.results.result": ("RunResult",),
    "canprobe.cell.results.traffic": ("measure_traffic",),
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
    "fit_map",
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
