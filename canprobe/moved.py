"""Modules under the names that they had before the package had wings; they go with the next version.

An import of an old name gives the module itself and a `DeprecationWarning` with the new one:

    canprobe.tasks.Trajectory  →  canprobe.cell.tasks.Trajectory
    canprobe.gym               →  canprobe.lab.gym
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, SourceFileLoader
from types import CodeType, ModuleType

_ROOMS = {
    "protocol": "fieldbus.protocol",
    "eds": "fieldbus.eds",
    "bus": "fieldbus.bus",
    "vcan": "fieldbus.vcan",
    "robot": "mechanics.robot",
    "touch.patch.image": "mechanics.touch.image.patch",
    "touch.patch": "mechanics.touch.image",
    "mechanics.touch.patch.image": "mechanics.touch.image.patch",
    "mechanics.touch.patch": "mechanics.touch.image",
    "touch": "mechanics.touch",
    "scene": "cell.scene",
    "planning": "cell.planning",
    "cell.controller": "cell.master.controller",
    "cell.cycle": "cell.master.cycle",
    "tasks": "cell.tasks",
    "session": "cell.session",
    "results": "cell.results",
    "recorded": "cell.recorded",
    "studies": "lab.studies",
    "bridge": "lab.bridge",
    "gym": "lab.gym",
    "examples": "lab.examples",
}
"""Old name → new name, both below `canprobe`, a part before its room; what lies in a room moves with it."""
_ALSO = {
    "canprobe.cell.cycle": "canprobe.cell.master.observers",
    "canprobe.protocol.tactile": "canprobe.cell.master.tactile_frame",
    "canprobe.touch.estimate.noise": "canprobe.mechanics.touch.estimate.prior",
}
"""Old name → where else its contents are now, of documented modules that were taken apart."""


def new_name(name: str) -> str | None:
    """The present name of a module that moved; None for any other module."""
    package, _, below = name.partition(".")
    if package != "canprobe":
        return None
    for old, new in _ROOMS.items():
        if below == old or below.startswith(f"{old}."):
            return f"canprobe.{new}{below.removeprefix(old)}"
    return None


class MovedModules:
    """Finds and loads a module under its old name; without the base classes of `importlib.abc`, which load slowly."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The specification of a module that moved."""
        new = new_name(fullname)
        found = importlib.util.find_spec(new) if new is not None else None
        return None if found is None else ModuleSpec(fullname, self, origin=found.origin)  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> None:
        """A module as always."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the module into the place of its old name."""
        old = module.__name__
        found = importlib.import_module(self._named(old))
        if old in _ALSO:
            public = {**vars(importlib.import_module(_ALSO[old])), **vars(found)}
            module.__dict__.update((name, value) for name, value in public.items() if not name.startswith("__"))
        else:
            sys.modules[old] = found

    def get_code(self, fullname: str) -> CodeType | None:
        """The code of the module, for `python -m`."""
        spec = importlib.util.find_spec(self._named(fullname))
        assert spec is not None
        assert isinstance(spec.loader, SourceFileLoader)
        return spec.loader.get_code(spec.name)

    def _named(self, old: str) -> str:
        new = new_name(old)
        assert new is not None
        warnings.warn(f"{old} is now {new}", DeprecationWarning, stacklevel=3)
        return new
