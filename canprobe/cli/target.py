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
PATIENT_SYNCS = 40
"""100 ms at 400 Hz: a virtual machine may stand still as long."""
_LOCKSTEP = "lockstep"


@dataclass(frozen=True, slots=True)
class Target:
    """An interface, its channel and bit rate; and the sensor's channel where the scene gives it one of its own."""

    interface: str
    channel: str
    bitrate: int
    sensor_channel: str | None = None


def target_of(args: argparse.Namespace, scene: Scene) -> Target:
    """The scene's buses with the command line's changes.

    Where neither names a bus and the scene has real nodes, which no lockstep bus has, python-can's configuration does.

    Raises:
        UsageError: when `--channel NAME=CH` names no channel of the scene, or nothing is configured.
    """
    sensors = scene.sensor.channel if scene.sensor is not None and scene.sensor.channel != "auto" else None
    channels = _channels(args.channel or [], scene.bus.channel, sensors)
    open_to_configuration = args.bus is None and scene.bus.interface == _LOCKSTEP and _has_real_nodes(scene)
    found = _configured(args.bus) if args.bus == CONFIG or open_to_configuration else None
    sensor_channel = None if sensors is None else channels.get(sensors, sensors)
    if found is None:
        channel = channels.get(scene.bus.channel, scene.bus.channel)
        return Target(args.bus or scene.bus.interface, channel, args.bitrate or scene.bus.bitrate, sensor_channel)
    channel = channels.get(scene.bus.channel) or found.channel or scene.bus.channel
    return Target(found.interface, channel, args.bitrate or found.bitrate or scene.bus.bitrate, sensor_channel)


def add_realtime(parser: argparse.ArgumentParser) -> None:
    """The option of commands that keep time on a real interface."""
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="request SCHED_FIFO, a processor for the cycle and locked memory; what the system does not permit is"
        " reported [the scene's cycle.realtime]",
    )


def add_patient(parser: argparse.ArgumentParser) -> None:
    """The option of commands that run emulated nodes on a machine that is too slow for what hardware needs."""
    parser.add_argument(
        "--patient",
        action="store_true",
        help=f"emulated nodes on a slow machine: drives wait for {PATIENT_SYNCS} SYNCs, and late cycles stop nothing",
    )


def with_patience(scene: Scene, wanted: bool) -> Scene:
    """The scene with drives that wait for their master and a master that is never too late, where it is wanted.

    Raises:
        UsageError: it is wanted of real nodes.
    """
    if not wanted:
        return scene
    if _has_real_nodes(scene):
        raise UsageError("--patient is for emulated nodes: real drives must stop soon after their master")
    arm = scene.arm and replace(scene.arm, missed_syncs=PATIENT_SYNCS)
    return replace(scene, arm=arm, limits=replace(scene.limits, late_cycles_max_percent=100.0))


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


def _channels(given: list[tuple[str | None, str]], main: str, sensors: str | None) -> dict[str, str]:
    """What stands for which of the scene's channels; a channel without a name stands for the main one."""
    names = [main] if sensors in (None, main) else [main, str(sensors)]
    found: dict[str, str] = {}
    for name, target in given:
        if name is not None and name not in names:
            hint = did_you_mean(name, names)
            raise UsageError(f"--channel {name}=…: the scene has no channel {name}, only {', '.join(names)}{hint}")
        if (name or main) in found:
            have = "one channel, " + main if len(names) == 1 else f"the channels {' and '.join(names)}"
            raise UsageError(f"--channel given {len(given)} times, but the scene has {have}")
        found[name or main] = target
    return found
