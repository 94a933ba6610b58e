"""Where a command goes: the bus that the scene names, and what the command line put in its place."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from canprobe.cli.parser import did_you_mean
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.scene import Scene


@dataclass(frozen=True, slots=True)
class Target:
    """An interface, its channel and bit rate."""

    interface: str
    channel: str
    bitrate: int


def target_of(args: argparse.Namespace, scene: Scene) -> Target:
    """The scene's bus with the command line's changes.

    Raises:
        UsageError: when `--channel NAME=CH` names no channel of the scene.
    """
    return Target(
        interface=args.bus or scene.bus.interface,
        channel=_channel(args.channel or [], scene.bus.channel),
        bitrate=args.bitrate or scene.bus.bitrate,
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


def _channel(given: list[tuple[str | None, str]], of_scene: str) -> str:
    for name, _ in given:
        if name is not None and name != of_scene:
            hint = did_you_mean(name, [of_scene])
            raise UsageError(f"--channel {name}=…: the scene has no channel {name}, only {of_scene}{hint}")
    if len(given) > 1:
        raise UsageError(f"--channel given {len(given)} times, but the scene has one channel, {of_scene}")
    return given[0][1] if given else of_scene
