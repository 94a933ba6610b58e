"""Table of the bridges: what each is for, which packages it needs, and how they are installed."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from canprobe.cell.scene.setup import Setup
from canprobe.errors import UsageError, did_you_mean, install_line


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


def check_bridges(names: Iterable[str], what: str = "bridge ") -> None:
    """Check that every name is a bridge whose packages are installed; `what` precedes the name in the message.

    Raises:
        UsageError: when one is unknown or lacks packages; the message lists the bridges, or has the line to type.
    """
    for name in names:
        if name not in BRIDGES:
            known = "; ".join(f"{known} ({info.what})" for known, info in BRIDGES.items())
            hint = did_you_mean(name, BRIDGES)
            raise UsageError(f"bridge {name!r}: there is no such bridge{hint}; there are: {known}")
        info = BRIDGES[name]
        if info.missing:
            raise UsageError(f"{what}{name}: needs {', '.join(info.missing)}; type: {info.pip}")


def unavailable_bridges(setup: Setup) -> tuple[tuple[str, str], ...]:
    """Bridges that the scene asks for and cannot have here, as (what, why)."""
    return tuple(
        (f"bridge {name}", f"{', '.join(BRIDGES[name].missing)} not installed: {BRIDGES[name].pip}")
        for name in setup.bridge.use
        if BRIDGES[name].missing
    )


def bridge_outputs(setup: Setup) -> tuple[str, ...]:
    """The files that the scene's bridges write."""
    return tuple(output for name in setup.bridge.use if (output := BRIDGES[name].output) is not None)
