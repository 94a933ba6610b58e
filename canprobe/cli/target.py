"""The bus of a command: from the command line, else the scene, else python-can's configuration."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from canprobe.cli.parser import PATIENT_SYNCS
from canprobe.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from canprobe.cell.scene.model import Scene
    from canprobe.cell.session.target import Target
    from canprobe.fieldbus.bus.real.adapters import ConfiguredBus

CONFIG = "config"
"""Value of --bus for the interface that python-can's configuration names."""


def scene_of(args: argparse.Namespace) -> Scene:
    """The scene of `run` and `up`, changed by their options.

    Raises:
        UsageError: when --patient is given and a node is real, or as in `target_of`.
    """
    from canprobe.cell.scene.load import load_scene
    from canprobe.cell.session.target import VIRTUAL

    given = {
        "bus.interface": None if args.bus == CONFIG else args.bus,
        "bus.bitrate": args.bitrate,
        "scene.seed": getattr(args, "seed", None),
        "task.duration_s": getattr(args, "duration", None),
        **({} if getattr(args, "only", None) is None else _kept_outputs(args.only)),
    }
    if getattr(args, "figures", None) is not None:
        given["outputs.figures"] = False
    scene = loaded(args, {key: value for key, value in given.items() if value is not None})
    if args.patient:
        if _has_real_nodes(scene):
            raise UsageError(
                "--patient is for emulated nodes: real drives must stop soon after their master; for nodes of `canprobe"
                f" emulate`: --set arm.missed_syncs={PATIENT_SYNCS} --set limits.late_cycles_max_percent=100"
            )
        arm = {} if scene.arm is None else {"arm.missed_syncs": PATIENT_SYNCS}
        scene = load_scene(scene, {"limits.late_cycles_max_percent": 100.0, **arm})
    scene = target_of(args, scene).applied_to(scene)
    if args.realtime and scene.bus.interface in VIRTUAL:
        args.report.say(f"warning: --realtime has no effect on bus {scene.bus.interface}, whose time is virtual")
    return scene


def _kept_outputs(names: str) -> dict[str, bool]:
    """The keys of `[outputs]` by the names that --only keeps; the log is always written."""
    from canprobe.cell.scene.model import OutputSettings

    kept, known = names.split(","), [key.name for key in fields(OutputSettings)]
    for name in kept:
        if name not in ("log", *known):
            raise UsageError(f"--only: expected some of log,{','.join(known)}, got {name}{did_you_mean(name, known)}")
    return {f"outputs.{name}": name in kept for name in known}


def loaded(args: argparse.Namespace, more: Mapping[str, Any] | None = None) -> Scene:
    """The scene of a command with the argument SCENE, changed by --cell, --set, --realtime and more overrides."""
    from canprobe.cell.scene.load import load_scene

    overrides = {**dict(args.set), **(more or {})}
    if args.cell is not None:
        overrides["cell"] = args.cell
    if getattr(args, "realtime", False):
        overrides["cycle.realtime"] = True
    return load_scene(args.scene, overrides)


def with_scene(text: str, args: argparse.Namespace) -> str:
    """A message whose line to type has the scene as it was given: the command line knows its path, a cell its name."""
    if getattr(args, "scene", None) is None:
        return text
    cell = f" --cell {shlex.quote(args.cell)}" if getattr(args, "cell", None) else ""
    return re.sub(
        r"(type: canprobe (?:up|home) ).+?(?= --(?:check-joints|bus))",
        lambda found: found[1] + shlex.quote(str(args.scene)) + cell,
        text,
    )


def target_of(args: argparse.Namespace, scene: Scene) -> Target:
    """The scene's buses with the command line's changes.

    Where neither names a bus and the scene has real nodes, which no lockstep bus has, python-can's configuration does.

    Raises:
        UsageError: when `--channel NAME=CH` names no channel of the scene, or nothing is configured.
    """
    from canprobe.cell.session.target import LOCKSTEP, Target

    (main, *_), bitrate = scene.channels, args.bitrate
    channels = _channels(args.channel, scene.channels)
    interface, channel = args.bus, channels.pop(main, None)
    open_to_configuration = args.bus is None and scene.bus.interface == LOCKSTEP and _has_real_nodes(scene)
    if (args.bus == CONFIG or open_to_configuration) and (found := _configured(args.bus)) is not None:
        interface, channel, bitrate = found.interface, channel or found.channel, bitrate or found.bitrate
    return Target.over(scene, interface, channels | ({} if channel is None else {main: channel}), bitrate)


def one_channel(args: argparse.Namespace, refusal: str) -> str | None:
    """The channel of the command line where there can be one, without a name; None where none is given.

    Raises:
        UsageError: there are several, or it has a name.
    """
    given: Sequence[tuple[str | None, str | None]] = args.channel or [(None, None)]
    (name, channel), *more = given
    if more or name is not None:
        raise UsageError(refusal)
    return channel


def real_target(
    args: argparse.Namespace, channel: str | None, *, channel_else: str | None = None, bitrate_else: int = 1_000_000
) -> Target:
    """The bus of a command that needs a real one: from the command line, else from python-can's configuration.

    Args:
        args: the command line, with `bus` and `bitrate`.
        channel: its channel; None where not given.
        channel_else, bitrate_else: values where neither the command line nor the configuration gives one.

    Raises:
        UsageError: when nothing names a channel, or --bus config is given and nothing is configured.
    """
    from canprobe.cell.session.target import Target
    from canprobe.fieldbus.bus.real.adapters import check_interface_name

    interface, bitrate = args.bus or "socketcan", args.bitrate
    if args.bus in (None, CONFIG) and (found := _configured(args.bus)) is not None:
        interface, channel, bitrate = found.interface, channel or found.channel, bitrate or found.bitrate
    check_interface_name(interface)
    if (channel := channel or channel_else) is None:
        raise UsageError("--channel is missing: name the bus, such as --channel vcan0")
    return Target(interface, channel, bitrate or bitrate_else)


def scene_target(args: argparse.Namespace, scene: Scene) -> Target:
    """The real bus of a scene's nodes: a channel without a name is for all of them, else each has that of the scene."""
    from canprobe.cell.session.target import Target

    name, channel = args.channel[0] if args.channel else ("", None)
    real = real_target(args, channel, bitrate_else=scene.bus.bitrate)
    channels = _channels(args.channel, scene.channels) or {scene.bus.channel: real.channel}
    target = Target.over(scene, real.interface, channels, real.bitrate)
    one = channel if name is None else None
    return replace(target, others={each: one or target.others.get(each, each) for each in scene.channels[1:]})


def _configured(bus: str | None) -> ConfiguredBus | None:
    from canprobe.fieldbus.bus.real.adapters import configured_bus

    found = configured_bus()
    if found is None and bus == CONFIG:
        raise UsageError(
            "--bus config: python-can's configuration names no interface; set CAN_INTERFACE and CAN_CHANNEL, or write "
            "them into ~/.canrc"
        )
    return found


def _has_real_nodes(scene: Scene) -> bool:
    real_array = scene.sensor is not None and not scene.sensor.emulated
    return real_array or not all(scene.drives.values())


def _channels(given: Sequence[tuple[str | None, str]], names: Sequence[str]) -> dict[str, str]:
    """New channel of each channel of the scene; one without a name replaces the first."""
    main = names[0]
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
