"""What packages take on disk, with everything that they need and canprobe itself does not."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib import metadata

BASE = ("python-can", "canopen", "numpy", "scipy")


def size_of(packages: Iterable[str]) -> int:
    """Bytes of the distributions behind import names and of all that they require, as far as installed.

    Args:
        packages: import names, such as `foxglove`.
    """
    owners = metadata.packages_distributions()
    wanted = {name for package in packages for name in owners.get(package, ())}
    return sum(_bytes_of(name) for name in _closure(wanted) - _closure(BASE))


def _closure(names: Iterable[str]) -> set[str]:
    """Normalised names of installed distributions and of what they require, extras left out."""
    found: set[str] = set()
    waiting = [_normal(name) for name in names]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        try:
            requires = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        found.add(name)
        waiting += [_normal(re.split(r"[^\w.-]", line, maxsplit=1)[0]) for line in requires if "extra ==" not in line]
    return found


def _bytes_of(name: str) -> int:
    files = metadata.files(name) or []
    return sum(path.stat().st_size for file in files if (path := file.locate()).is_file())  # type: ignore[attr-defined]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
