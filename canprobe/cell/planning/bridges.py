"""Table of the bridges: what each is for, which packages it needs, and how they are installed."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from canprobe.errors import UsageError, did_you_mean, install_line
from canprobe.fieldbus.bus.system import system

_ELSEWHERE = "leave it out, and feed the folder of the run on Linux or macOS: canprobe replay FOLDER --bridge NAME"


@dataclass(frozen=True, slots=True)
class BridgeInfo:
    """One bridge.

    Attributes:
        what: its purpose in one line, for people.
        module: its module in `canprobe.lab.bridge`, loaded in the process of the bridge only.
        extra: extra of canprobe that installs these packages.
        packages: import names of the packages that it needs.
        live: whether it shows the cell while the cell runs.
        output: file that it writes into the run's folder; None where it writes none.
    """

    what: str
    module: str
    extra: str
    packages: tuple[str, ...]
    live: bool = False
    output: str | None = None

    @property
    def missing(self) -> tuple[str, ...]:
        """Packages that are not installed."""
        return tuple(name for name in self.packages if importlib.util.find_spec(name) is None)

    @property
    def lacks(self) -> str:
        """What it lacks here, with what to do; empty where it can be used."""
        if not system.NON_BLOCKING_PIPES:
            return "its process is fed by a pipe that never waits, which this system lacks; " + _ELSEWHERE
        return self.lacks_packages

    @property
    def lacks_packages(self) -> str:
        """The packages that it lacks, with what to type; empty where they are installed."""
        return f"needs {', '.join(self.missing)}; type: {self.pip}" if self.missing else ""

    @property
    def pip(self) -> str:
        """Command line that installs them."""
        return install_line(self.extra)


BRIDGES: Mapping[str, BridgeInfo] = {
    "mcap": BridgeInfo(
        "one MCAP file of ROS 2 messages, for Foxglove and ros2 bag",
        "mcap_file",
        "mcap",
        ("mcap", "rosbags"),
        output="run.mcap",
    ),
    "foxglove": BridgeInfo(
        "live view in Foxglove over a WebSocket", "foxglove_live", "foxglove", ("foxglove", "rosbags"), live=True
    ),
    "ros2": BridgeInfo(
        "live ROS 2 topics and commands, without ROS being installed",
        "ros2_dds",
        "ros2",
        ("cyclonedds", "rosbags"),
        live=True,
    ),
    "view": BridgeInfo("live 3-D view in a browser", "view.browser", "view", ("viser",), live=True),
}


def check_view() -> None:
    """Check that a recorded run can be viewed, for which no process is fed.

    Raises:
        UsageError: packages are missing; the message has the line to type.
    """
    if lacks := BRIDGES["view"].lacks_packages:
        raise UsageError(f"view: {lacks}")


def check_bridges(names: Iterable[str]) -> None:
    """Check that every name is a bridge that can be used here.

    Raises:
        UsageError: when one is unknown or lacks packages; the message lists the bridges, or has the line to type.
    """
    for name in names:
        if name not in BRIDGES:
            known = "; ".join(f"{known} ({info.what})" for known, info in BRIDGES.items())
            hint = did_you_mean(name, BRIDGES)
            raise UsageError(f"bridge {name!r}: there is no such bridge{hint}; there are: {known}")
        if lacks := BRIDGES[name].lacks:
            raise UsageError(f"bridge {name}: {lacks}")
