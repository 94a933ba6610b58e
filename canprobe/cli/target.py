"""Where a command goes: what the command line says, else the scene, else python-can's configuration."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from canprobe.cli.parser import did_you_mean
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.bus.configured import ConfiguredBus
    from canprobe.scene import Scene

CONFIG = "config"
"""Stands for the interface where python-can's configuration is to name it."""
_LOCKSTEP = "lockstep"


@dataclass(frozen=True, slots=True)
class Target:
    """An interface, its channel and bit rate."""

    interface: str
    channel: str
    bitrate: int


def target_of(args: argparse.Namespace, scene: Scene) -> Target:
    """The scene's bus with the command line's changes.

    Where neither names a bus and the scene has real nodes, which no lockstep bus has, python-can's configuration does.

    Raises:
        UsageError: when `--channel NAME=CH` names no channel of the scene, or nothing is configured.
    """
    channel = _channel(args.channel or [], scene.bus.channel)
    open_to_configuration = args.bus is None and scene.bus.interface == _LOCKSTEP and _has_real_nodes(scene)
    found = _configured(CONFIG if args.bus == CONFIG else None) if args.bus == CONFIG or open_to_configuration else None
    if found is None:
        return Target(args.bus or scene.bus.interface, channel or scene.bus.channel, args.bitrate or scene.bus.bitrate)
    return Target(
        found.interface,
        channel or found.channel or scene.bus.channel,
        args.bitrate or found.bitrate or scene.bus.bitrate,
    )


def add_realtime(parser: argparse.ArgumentParser) -> None:
    """The option of commands that keep time on a real interface."""
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="SCHED_FIFO, a processor of its own and locked memory, as far as permitted [the scene's cycle.realtime]",
    )


def with_realtime(scene: Scene, wanted: bool) -> Scene:
    """The scene, in real time where the command line wants it."""
    return replace(scene, cycle=replace(scene.cycle, realtime=True)) if wanted else scene


def real_target(bus: str | None, channel: str | None, bitrate: int | None) -> tuple[str, str | None, int | None]:
    """Interface, channel and bit rate of a command without a scene that needs a bus between processes.

    Returns:
        What the command line says, else python-can's configuration; channel and bit rate None where nobody says.

    Raises:
        UsageError: nothing is configured, and the command line asks for what is.
    """
    found = _configured(bus) if bus in (None, CONFIG) else None
    if found is None:
        return bus or "socketcan", channel, bitrate
    return found.interface, channel or found.channel, bitrate or found.bitrate


def _configured(bus: str | None) -> ConfiguredBus | None:
    from canprobe.bus.configured import configured_bus

    found = configured_bus()
    if found is None and bus == CONFIG:
        raise UsageError(
            "--bus config: python-can's configuration names no interface; set CAN_INTERFACE and CAN_CHANNEL, or write "
            "them into ~/.canrc"
        )
    return found


def _has_real_nodes(scene: Scene) -> bool:
    return any(part is not None and not part.emulated for part in (scene.arm, scene.sensor))


def _channel(given: list[tuple[str | None, str]], of_scene: str) -> str | None:
    for name, _ in given:
        if name is not None and name != of_scene:
            hint = did_you_mean(name, [of_scene])
            raise UsageError(f"--channel {name}=…: the scene has no channel {name}, only {of_scene}{hint}")
    if len(given) > 1:
        raise UsageError(f"--channel given {len(given)} times, but the scene has one channel, {of_scene}")
    return given[0][1] if given else None
