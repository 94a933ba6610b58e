"""The registry of faults: every kind with its clause, the reaction to it, and the conditions that it trips.

A row is a class of the modules below, with its facts in `kinds.toml`; a row that does what another one does, to other
frames, needs no class. Its conditions are those of a node of a cell in motion: node 3, a drive, of the packaged scene
`free`; its points those of a drive that `conform` examines. A test throws each kind and compares.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType, ModuleType

from canprobe.fieldbus.tools.faults import drive_faults, frame_faults, service_faults
from canprobe.fieldbus.tools.faults.fault import FACTS, Effect, FaultKind


def kinds_of(*modules: ModuleType) -> Mapping[str, FaultKind]:
    """The kinds of faults of modules by name, in the order of `kinds.toml`, and those that do what one of them does."""
    classes = (one for module in modules for one in vars(module).values() if isinstance(one, type))
    found = {one.name: one for one in classes if issubclass(one, Effect) and "name" in vars(one)}
    for name, facts in FACTS.items():
        if (does := facts.get("does")) in found:
            found[name] = type(name, (found[does],), {"name": name})
    return MappingProxyType({name: found[name] for name in FACTS if name in found})


BUS_FAULTS = kinds_of(frame_faults, service_faults, drive_faults)
"""Kinds of faults of nodes, links and drives by name. `canprobe.cell.emulated` adds those of the array."""
