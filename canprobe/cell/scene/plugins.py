"""Cells, scenes, arrays and estimators that other packages offer by entry points.

    [project.entry-points."canprobe.cells"]
    lab-arm = "lab_canprobe"                    # the file lab-arm.toml in the folder of this package

    [project.entry-points."canprobe.estimators"]
    lab-fit = "lab_canprobe.fits:LabFit"        # a function or class that makes an estimator

The packages are looked at only for a name that canprobe itself does not have, and for lists. A name that stands alone
is found; `package:name` is found always. Source: PyPA, entry points specification.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canprobe.errors import SceneError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUPS = {kind: f"canprobe.{kind}s" for kind in ("scene", "cell", "array", "estimator")}
"""Groups of entry points by the kind of what they offer."""


@dataclass(frozen=True, slots=True)
class Plugin:
    """What one entry point offers.

    Attributes:
        kind: ``scene``, ``cell``, ``array`` or ``estimator``.
        name: its name.
        package: name of the package, as pip knows it.
        entry_point: the entry point.
    """

    kind: str
    name: str
    package: str
    entry_point: EntryPoint

    @property
    def whole_name(self) -> str:
        """The name by which it is found, whoever else has the same name."""
        return f"{self.package}:{self.name}"

    def path(self) -> Path:
        """Path of the TOML file of a scene, cell or array.

        Raises:
            SceneError: the package cannot be imported, or has no such file.
        """
        from importlib.util import find_spec

        try:
            spec = find_spec(self.entry_point.value)
        except Exception as error:  # whatever a foreign package raises when the ones above it are imported
            raise self._broken(error) from error
        folders = [] if spec is None else list(spec.submodule_search_locations or [])
        for folder in folders:
            if (path := Path(folder, f"{self.name}.toml")).is_file():
                return path
        value = self.entry_point.value
        why = f"{value} is no package" if not folders else f"there is no file {self.name}.toml in {folders[0]}"
        raise SceneError([f"{self}: {why}; expected the package of this file in its entry point"])

    def load(self) -> Any:
        """What the entry point refers to.

        Raises:
            SceneError: it cannot be imported.
        """
        try:
            return self.entry_point.load()
        except Exception as error:  # whatever a foreign package raises
            raise self._broken(error) from error

    def _broken(self, error: Exception) -> SceneError:
        return SceneError([f"{self}: cannot be imported: {type(error).__name__}: {error}; mend or remove the package"])

    def __str__(self) -> str:
        return f"{self.kind} {self.name} of the package {self.package}"


def plugins(kind: str) -> list[Plugin]:
    """What other packages offer of a kind, by name; nothing of theirs is imported."""
    from importlib.metadata import entry_points  # here, as it takes longer than to read a scene

    found = entry_points(group=GROUPS[kind]) if kind in GROUPS else ()
    made = [Plugin(kind, point.name, point.dist.name if point.dist else "unknown", point) for point in found]
    return sorted(made, key=lambda plugin: (plugin.name, plugin.package))


def find_plugin(kind: str, name: str) -> Plugin | None:
    """The offer of a name, or of `package:name`; None where no package has it.

    Raises:
        SceneError: two packages have the name.
    """
    found = [plugin for plugin in plugins(kind) if name in (plugin.name, plugin.whole_name)]
    if len(found) > 1:
        names, packages = " or ".join(one.whole_name for one in found), " and ".join(one.package for one in found)
        article = "an" if kind[0] in "ae" else "a"
        raise SceneError([f"{name}: the packages {packages} each offer {article} {kind} of this name; type {names}"])
    return found[0] if found else None
