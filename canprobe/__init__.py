"""A robot cell on a CAN bus: PUMA 260, tactile servo and local shape from touch, over CANopen.

Public names are imported when they are first used, so that `import canprobe` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.api import open_cell as open_cell
    from canprobe.api import plan as plan
    from canprobe.api import run as run
    from canprobe.api import sample_target as sample_target
    from canprobe.cell.master.controller import Command as Command
    from canprobe.cell.master.controller import Controller as Controller
    from canprobe.cell.master.controller import Measurement as Measurement
    from canprobe.cell.master.external_arm import ExternalArm as ExternalArm
    from canprobe.cell.recorded.reestimate import ReplayResult as ReplayResult
    from canprobe.cell.recorded.reestimate import replay as replay
    from canprobe.cell.results.result import RunResult as RunResult
    from canprobe.cell.results.run_files import load_table as load_table
    from canprobe.cell.results.scores import Contacts as Contacts
    from canprobe.cell.results.surface_file import load_surface_map as load_surface_map
    from canprobe.cell.results.traffic import measure_traffic as measure_traffic
    from canprobe.cell.scene.load import load_scene as load_scene
    from canprobe.errors import ArmError as ArmError
    from canprobe.errors import BusError as BusError
    from canprobe.errors import CanprobeError as CanprobeError
    from canprobe.errors import EdsError as EdsError
    from canprobe.errors import InterfaceError as InterfaceError
    from canprobe.errors import NodeError as NodeError
    from canprobe.errors import PlanError as PlanError
    from canprobe.errors import ProtocolError as ProtocolError
    from canprobe.errors import ResultsError as ResultsError
    from canprobe.errors import SafetyStop as SafetyStop
    from canprobe.errors import SceneError as SceneError
    from canprobe.errors import StudyError as StudyError
    from canprobe.errors import UsageError as UsageError
    from canprobe.lab.studies.many import Runs as Runs
    from canprobe.lab.studies.many import run_many as run_many
    from canprobe.mechanics.touch.contact import ContactSample as ContactSample
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate as SurfaceEstimate
    from canprobe.mechanics.touch.estimate.fit import fit_surface as fit_surface
    from canprobe.mechanics.touch.estimate.likelihood import cramer_rao as cramer_rao
    from canprobe.mechanics.touch.map.fit import fit_map as fit_map
    from canprobe.mechanics.touch.map.surface_map import SurfaceMap as SurfaceMap
    from canprobe.mechanics.touch.surface import SurfaceMatrix as SurfaceMatrix

__version__ = "0.2.0"
__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "api": ("open_cell", "plan", "run", "sample_target"),
        "cell.master.controller": ("Command", "Controller", "Measurement"),
        "cell.master.external_arm": ("ExternalArm",),
        "errors": (
            *("ArmError", "BusError", "CanprobeError", "EdsError", "InterfaceError", "NodeError", "PlanError"),
            *("ProtocolError", "ResultsError", "SafetyStop", "SceneError", "StudyError", "UsageError"),
        ),
        "cell.recorded.reestimate": ("ReplayResult", "replay"),
        "cell.scene.load": ("load_scene",),
        "lab.studies.many": ("Runs", "run_many"),
        "cell.results.scores": ("Contacts",),
        "cell.results.run_files": ("load_table",),
        "cell.results.surface_file": ("load_surface_map",),
        "mechanics.touch.contact": ("ContactSample",),
        "mechanics.touch.estimate.likelihood": ("cramer_rao",),
        "mechanics.touch.estimate.answer": ("SurfaceEstimate",),
        "mechanics.touch.estimate.fit": ("fit_surface",),
        "mechanics.touch.map.surface_map": ("SurfaceMap",),
        "mechanics.touch.map.fit": ("fit_map",),
        "mechanics.touch.surface": ("SurfaceMatrix",),
        "cell.results.result": ("RunResult",),
        "cell.results.traffic": ("measure_traffic",),
    },
)
__all__ += ["__version__"]
