"""A robot cell on a CAN bus: PUMA 260, tactile servo and local shape from touch, over CANopen.

Public names are imported when they are first used, so that `import canprobe` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from canprobe.api import RunResult, open_cell, run
    from canprobe.planning import make_plan as plan
    from canprobe.recorded import ReplayResult, replay
    from canprobe.scene_loader import load_scene
    from canprobe.surface_file import load_surface_map
    from canprobe.tables import load_table
    from canprobe.touch.bound import cramer_rao
    from canprobe.touch.estimate import SurfaceEstimate
    from canprobe.touch.fit import fit_surface
    from canprobe.touch.surface import SurfaceMatrix
    from canprobe.touch.surface_map import SurfaceMap
    from canprobe.traffic_log import measure_traffic

__version__ = "0.1.0"

_EXPORTS = {
    "load_scene": ("canprobe.scene_loader", "load_scene"),
    "load_surface_map": ("canprobe.surface_file", "load_surface_map"),
    "measure_traffic": ("canprobe.traffic_log", "measure_traffic"),
    "plan": ("canprobe.api", "plan"),
    "run": ("canprobe.api", "run"),
    "load_table": ("canprobe.tables", "load_table"),
    "open_cell": ("canprobe.api", "open_cell"),
    "replay": ("canprobe.recorded", "replay"),
    "ReplayResult": ("canprobe.recorded", "ReplayResult"),
    "RunResult": ("canprobe.api", "RunResult"),
    "SurfaceMatrix": ("canprobe.touch.surface", "SurfaceMatrix"),
    "SurfaceMap": ("canprobe.touch.surface_map", "SurfaceMap"),
    "SurfaceEstimate": ("canprobe.touch.estimate", "SurfaceEstimate"),
    "fit_surface": ("canprobe.touch.fit", "fit_surface"),
    "cramer_rao": ("canprobe.touch.bound", "cramer_rao"),
}

__all__ = [
    "ReplayResult",
    "RunResult",
    "SurfaceEstimate",
    "SurfaceMap",
    "SurfaceMatrix",
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
