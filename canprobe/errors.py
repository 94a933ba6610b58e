"""Exceptions of canprobe, and the exit status that each one means to the command line.

    CanprobeError
    ├── UsageError           2  wrong usage
    │   ├── SceneError       2  the scene file is wrong; carries every problem found
    │   ├── PlanError        2  the scene is right but does not fit (bus, reach, geometry)
    │   └── EdsError         2  an EDS file cannot be used
    ├── BusError             3  interface missing or lost, node missing, node refused
    │   ├── InterfaceError   3  the CAN interface itself
    │   ├── NodeError        3  one node: absent, wrong identity, refused an access, failed
    │   └── ArmError         3  the external arm: lost, or a method of it failed
    ├── StudyError           3  a case, a worker or the files of a study failed
    ├── ResultsError         3  a file that cannot be written: on a full disk, for example
    ├── SafetyStop           1  the cell was stopped for safety; the drives are disabled
    └── ProtocolError        3  bytes on the bus that cannot be decoded

All can be imported from `canprobe`.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


class CanprobeError(Exception):
    """Base of every error that canprobe raises on purpose.

    Attributes:
        summary: summary of the run that the error ended, as in ``summary.json``; None where no bus was opened.
    """

    exit_status = 3
    summary: dict[str, Any] | None = None


class UsageError(CanprobeError):
    """The request itself is wrong; nothing was started."""

    exit_status = 2


class SceneError(UsageError):
    """A scene that cannot be loaded.

    Attributes:
        problems: every problem found, one line each, with file, key path and a suggestion.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(self.problems))


class PlanError(UsageError):
    """A valid scene that cannot be carried out.

    Attributes:
        problems: every reason with its numbers, one line each.
        ways_out: changes of the scene, each of which makes it fit its bus, with the load that it leaves.
    """

    def __init__(self, problems: Sequence[str], ways_out: Sequence[str] = (), beside: str = "") -> None:
        """Take problems and ways out; `beside` says what each way out does not mend."""
        self.problems = tuple(problems)
        self.ways_out = tuple(ways_out)
        head = f"ways out, each by itself{beside}:"
        lines = [head, *(f"  {way}" for way in self.ways_out)] if self.ways_out else []
        super().__init__("\n".join((*self.problems, *lines)))


class EdsError(UsageError):
    """An EDS file that is missing or cannot be read."""


class BusError(CanprobeError):
    """The bus or something on it failed."""


class InterfaceError(BusError):
    """The CAN interface is missing, cannot be opened or was lost."""


class NodeError(BusError):
    """One node did not do what it must.

    Attributes:
        node_id: the node, 1–127.
        reason: what it did or did not do.
    """

    def __init__(self, node_id: int, message: str) -> None:
        self.node_id = node_id
        self.reason = message
        super().__init__(f"node {node_id}: {message}")


class ArmError(BusError):
    """The external arm did not do what it must, or was lost."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"external arm: {reason}")


class StudyError(CanprobeError):
    """A case of a study, a worker process, or a file of a study failed."""


class ProtocolError(BusError):
    """Bytes on the bus that cannot be decoded as what their identifier means."""


class ResultsError(CanprobeError):
    """A file cannot be written, for example on a full disk; the drives of a running cell are disabled."""


class SafetyStop(CanprobeError):  # noqa: N818 - it is a stop, not a mistake
    """The cell was stopped for safety. Raised after the drives were disabled.

    Attributes:
        reason: what was detected, with numbers.
    """

    exit_status = 1

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(reason)


def regular_file(path: Path, most_bytes: int | None = None) -> Path:
    """A path to read from, if it is a regular file: a device or a pipe may never end.

    It is here because every wing reads files; it raises the errors of `open`.

    Args:
        path: path of the file.
        most_bytes: largest size of a file that is read whole; None: any size.

    Raises:
        OSError: when there is no such file, it is not a regular one, or it is larger.
    """
    try:
        found = path.stat()
    except ValueError as error:  # no system takes such a path
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path)) from error
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "Is a directory", str(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "expected a regular file, got a device or a pipe", str(path))
    if most_bytes is not None and found.st_size > most_bytes:
        raise OSError(errno.EFBIG, f"expected at most {most_bytes >> 20} MiB, got {found.st_size >> 20} MiB", str(path))
    return path


def check_schema(file: object, found: object, newest: int, remedy: str) -> None:
    """Check the `schema` of a file that canprobe wrote: a reader takes its own version and those before.

    It is here because every wing reads files.

    Args:
        file: name of the file in the message.
        found: version that the file states.
        newest: version that this canprobe writes.
        remedy: what to do with another file.

    Raises:
        UsageError: the file is of a newer canprobe, or states no version.
    """
    if not isinstance(found, int) or isinstance(found, bool) or found < 1:
        raise UsageError(f"{file}: schema: expected {newest}, got {found!r}; {remedy}")
    if found > newest:
        why = f"the file is of a newer canprobe: this one reads up to schema {newest}, got {found}"
        raise UsageError(f"{file}: {why}; {remedy}, or use that canprobe")


EXTRA_OF = {
    "matplotlib": "study",
    "cantools": "can",
    "yaml": "can",
    "msgpack": "can",
    "mcap": "mcap",
    "rosbags": "mcap",
    "foxglove": "foxglove",
    "cyclonedds": "ros2",
    "viser": "view",
    "trimesh": "view",
    "collada": "view",
    "mujoco": "dynamics",
    "pandas": "data",
    "xarray": "data",
    "pyarrow": "data",
    "textual": "console",
    "rich": "console",
}
"""Extra that installs a package, by the package's import name."""


def package_line(requirement: str) -> str:
    """Command line that installs another package beside canprobe."""
    tool = _tool()
    return f"{tool} install {'canprobe --with ' if tool == 'uv tool' else ''}'{requirement}'"


def install_line(extra: str) -> str:
    """Command line that installs an extra, from where canprobe itself was installed, if that is known."""
    import importlib.metadata  # only where something is missing
    import json
    from urllib.parse import unquote, urlsplit

    try:
        origin = json.loads(importlib.metadata.distribution("canprobe").read_text("direct_url.json") or "{}")
    except importlib.metadata.PackageNotFoundError:  # a tree on the path
        origin = {}
    editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
    wanted = f"canprobe[{extra}]"
    if "dir_info" in origin:  # a folder
        wanted = f"{unquote(urlsplit(origin['url']).path)}[{extra}]"
    elif "url" in origin:  # a wheel, or a repository
        vcs = origin.get("vcs_info", {}).get("vcs")
        wanted += f" @ {f'{vcs}+' if vcs else ''}{origin['url']}"
    return f"{_tool()} install {editable}'{wanted}'"


def needed_module(module: str, extra: str, need: str) -> Any:
    """A module of an extra, imported.

    Args:
        module: its import name.
        extra: extra of canprobe that installs it.
        need: what needs it, in words that end before the line to type.

    Raises:
        UsageError: it is not installed; the message has the line that installs it.
    """
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"{need} {install_line(extra)}") from error


def door(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose names are imported on first use (PEP 562).

    Args:
        package: the package, or a module of canprobe itself.
        modules: names by the module that has them, below the package's wing, or below canprobe itself.
    """
    import importlib

    wing = ".".join(package.split(".")[:2]) if hasattr(sys.modules[package], "__path__") else "canprobe"
    module_of = {name: module for module, names in modules.items() for name in names}

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{wing}.{module_of[name]}"), name)

    return load, lambda: sorted({*vars(sys.modules[package]), *module_of}), [*module_of]


def _tool() -> str:
    """The command that installs packages where canprobe is installed."""
    if os.path.exists(os.path.join(sys.prefix, "pipx_metadata.json")):
        return "pipx runpip canprobe"
    if os.path.exists(os.path.join(sys.prefix, "uv-receipt.toml")) or f"{os.sep}archive-v" in sys.prefix:
        return "uv tool"  # also where uvx made an environment for one run, in its cache
    return "pip"


def at_most(value: float, digits: int = 3) -> str:
    """An advised upper bound as text: so many significant digits, rounded down, so that the number itself fits."""
    return _advised(value, digits, "ROUND_FLOOR")


def at_least(value: float, digits: int = 3) -> str:
    """An advised lower bound as text: so many significant digits, rounded up, so that the number itself fits."""
    return _advised(value, digits, "ROUND_CEILING")


def _advised(value: float, digits: int, rounding: str) -> str:
    from decimal import Decimal

    exact = Decimal(f"{value:.12g}")  # without the rounding error of a float, which would cost 0.3 a digit
    return f"{float(exact.quantize(Decimal((0, (1,), exact.adjusted() - digits + 1)), rounding)):.12g}"


def did_you_mean(got: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """The text `; did you mean X?`, whatever the case; empty when no known word is close."""
    import difflib

    folded = {word.lower(): word for word in known}
    close = difflib.get_close_matches(got.lower(), folded, n=1, cutoff=cutoff)
    return f"; did you mean {folded[close[0]]}?" if close else ""
