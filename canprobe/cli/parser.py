"""argparse as the commands use it: the arguments that commands share, and where a command goes."""

from __future__ import annotations

import argparse
import difflib
import math
import re
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.cell.scene.model import Scene
    from canprobe.cell.session.target import Target
    from canprobe.fieldbus.bus.real.python_can import ConfiguredBus


# One clear line for a wrong command line.


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Paragraphs are as wide as the terminal; lists and examples, which are indented, stay as written."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n\n".join(
            part if "\n " in part else textwrap.fill(part, width, break_on_hyphens=False, break_long_words=False)
            for part in text.split("\n\n")
        )


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps examples as written and complains in one line."""

    def __init__(self, **settings: object) -> None:
        settings.setdefault("formatter_class", _Formatter)
        settings.setdefault("allow_abbrev", False)
        super().__init__(**settings)  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line and leave with status 2."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does it; what is left over is said by the command that has no such argument, not by the root."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            self.refuse_unknown(rest)
        return found, rest

    def refuse_unknown(self, words: Sequence[str]) -> NoReturn:
        """Complain about arguments that nothing takes."""
        hint = did_you_mean(words[0], self._option_string_actions, 0.7) if words[0].startswith("-") else ""
        self.error(f"unrecognized arguments: {' '.join(words)}{hint}")


def did_you_mean(got: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """`; did you mean X?`, or nothing when no known word is close."""
    close = difflib.get_close_matches(got, list(known), n=1, cutoff=cutoff)
    return f"; did you mean {close[0]}?" if close else ""


# Types of arguments.


def word(text: str) -> str:
    """An argument type: any text but none, which is what a shell makes of a variable that is not set."""
    if not text:
        raise argparse.ArgumentTypeError("expected a name, got ''")
    return text


def folder_path(text: str) -> Path:
    """An argument type: a folder; not the current one for want of a name."""
    return Path(word(text))


def channel(text: str) -> tuple[str | None, str]:
    """Parse `CH` or `NAME=CH`."""
    name, equals, target = text.rpartition("=")
    if not target or (equals and not name):
        raise argparse.ArgumentTypeError(f"expected CH or NAME=CH, got {text!r}")
    return (name if equals else None), target


def whole(low: int, high: int) -> Callable[[str], int]:
    """An argument type: integers from `low` to `high`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected an integer from {low} to {high}, got {text!r}")
        return value

    return parse


def node_id(text: str) -> int:
    """An argument type: a node id, or 255 for none."""
    return 255 if text == "255" else whole(1, 127)(text)


def number_of_32_bits(text: str) -> int:
    """An argument type: a number of 1018h, decimal or hexadecimal with 0x."""
    try:
        value = int(text, 0)
    except ValueError:
        value = -1
    if not 0 <= value <= 0xFFFFFFFF:
        raise argparse.ArgumentTypeError(f"expected a number of 32 bits such as 4711 or 0x1267, got {text!r}")
    return value


def seconds(text: str) -> float:
    """An argument type: a duration."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected seconds above 0, got {text!r}")
    return value


def setting(text: str) -> tuple[str, Any]:
    """An argument type: a key and its value as a scene file writes them; a word needs no quotes."""
    key, equals, value = text.partition("=")
    if not key.strip() or not equals:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE such as task.force_n=3, got {text!r}")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        return key.strip(), value.strip()
    except RecursionError:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE, got one of too many brackets: {text[:40]}…") from None


def node_ids(text: str) -> tuple[int, ...]:
    """An argument type: node ids such as `1-6,16`, ascending and without repetitions."""
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= first <= last <= 126:
            raise argparse.ArgumentTypeError(f"expected node ids from 1 to 126 such as 1-6,16, got {text!r}")
        found.update(range(first, last + 1))
    return tuple(sorted(found))


# Arguments that commands share.

PATIENT_SYNCS = 40
"""100 ms at 400 Hz: a virtual machine may stand still as long."""
seed = whole(0, 2**63 - 1)

OPTIONS: Mapping[str, dict[str, Any]] = {
    "--bus": {
        "metavar": "B",
        "type": word,
        "help": "lockstep, direct (no bus), socketcan or another python-can interface; config: the one that"
        " CAN_INTERFACE or python-can's configuration files name [the scene's]",
    },
    "--channel": {
        "metavar": "[NAME=]CH",
        "action": "append",
        "type": channel,
        "help": "channel of the interface; NAME=CH replaces the scene's channel NAME and may be repeated [the scene's]",
    },
    "--bitrate": {"metavar": "BIT/S", "type": whole(10_000, 1_000_000), "help": "bit rate [the scene's]"},
    "--set": {
        "metavar": "KEY=VALUE",
        "action": "append",
        "default": [],
        "type": setting,
        "help": "a key of the scene, as `--set task.force_n=3`, checked as in a file; may be repeated",
    },
    "--realtime": {
        "action": "store_true",
        "help": "request SCHED_FIFO, a processor for the cycle and locked memory; what the system does not permit is"
        " reported [the scene's cycle.realtime]",
    },
    "--patient": {
        "action": "store_true",
        "help": f"emulated nodes on a slow machine: drives wait for {PATIENT_SYNCS} SYNCs, and late cycles stop"
        " nothing",
    },
    "--bridge": {
        "metavar": "NAME",
        "action": "append",
        "default": [],
        "help": "send the data to another tool: mcap, foxglove, ros2 or view; may be repeated",
    },
    "--out": {"metavar": "DIR", "type": folder_path, "help": "folder of the results [runs/<scene>-<time>]"},
    "--force": {"action": "store_true", "help": "replace the results of an earlier run in DIR"},
    "--seed": {"metavar": "N", "type": seed, "help": "seed of all random numbers [the scene's]"},
    "--duration": {
        "metavar": "S",
        "type": seconds,
        "help": "length of the scan, press, listen or free phase in seconds [the scene's]",
    },
    "--json": {"action": "store_true", "help": "print one JSON document on stdout"},
}
BUS = ("--bus", "--channel", "--bitrate")


def add_scene(parser: Parser, optional: bool = False) -> None:
    """SCENE, which most commands take; optional where another argument can stand for it."""
    parser.add_argument(
        "scene",
        metavar="SCENE",
        nargs="?" if optional else None,
        help="a packaged scene (`canprobe scenes` lists them), a cell, or the path of a TOML file",
    )
    parser.add_argument(
        "--cell", metavar="C", type=word, help="a packaged cell (`canprobe cells` lists them) or a path [the scene's]"
    )
    add_options(parser, "--set")


def add_options(parser: argparse._ActionsContainer, *names: str) -> None:
    """Options of `OPTIONS`, in this order."""
    for name in names:
        parser.add_argument(name, **OPTIONS[name])


def add_verbosity(parser: Parser) -> None:
    """-v and -q of a command that reports its steps."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "-v",
        "--verbose",
        dest="verbosity",
        action="store_const",
        const=1,
        default=0,
        help="report every step on stderr, even where that is no terminal",
    )
    either.add_argument(
        "-q", "--quiet", dest="verbosity", action="store_const", const=-1, help="report only warnings and errors"
    )


# Where a command goes: what the command line says, else the scene, else python-can's configuration.

CONFIG = "config"
"""Stands for the interface where python-can's configuration is to name it."""


def scene_of(args: argparse.Namespace) -> Scene:
    """The scene of `run` and `up`, as their options change it.

    Raises:
        UsageError: --patient is given and a node is real, or as `target_of`.
    """
    from canprobe.cell.scene.load import load_scene
    from canprobe.cell.session.target import VIRTUAL

    scene = loaded(args)
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


def loaded(args: argparse.Namespace) -> Scene:
    """The scene of a command with `add_scene`, as --cell, --set and --realtime change it."""
    from canprobe.cell.scene.load import load_scene

    overrides = dict(args.set)
    if args.cell is not None:
        overrides["cell"] = args.cell
    if getattr(args, "realtime", False):
        overrides["cycle.realtime"] = True
    return load_scene(args.scene, overrides)


def target_of(args: argparse.Namespace, scene: Scene) -> Target:
    """The scene's buses with the command line's changes.

    Where neither names a bus and the scene has real nodes, which no lockstep bus has, python-can's configuration does.

    Raises:
        UsageError: when `--channel NAME=CH` names no channel of the scene, or nothing is configured.
    """
    from canprobe.cell.session.target import LOCKSTEP, Target

    (main, *_), bitrate = scene.channels, args.bitrate
    channels = _channels(args.channel or [], scene.channels)
    interface, channel = args.bus, channels.pop(main, None)
    open_to_configuration = args.bus is None and scene.bus.interface == LOCKSTEP and _has_real_nodes(scene)
    if (args.bus == CONFIG or open_to_configuration) and (found := _configured(args.bus)) is not None:
        interface, channel, bitrate = found.interface, channel or found.channel, bitrate or found.bitrate
    return Target.over(scene, interface, channels | ({} if channel is None else {main: channel}), bitrate)


def real_target(
    bus: str | None,
    channel: str | None,
    bitrate: int | None,
    *,
    channel_else: str | None = None,
    bitrate_else: int = 1_000_000,
) -> Target:
    """The bus of a command that needs one between processes: the command line's, else python-can's configuration's.

    Args:
        bus, channel, bitrate: of the command line.
        channel_else, bitrate_else: where neither says anything.

    Raises:
        UsageError: nothing names a channel, or nothing is configured and the command line asks for what is.
    """
    from canprobe.cell.session.target import Target

    interface = bus or "socketcan"
    if bus in (None, CONFIG) and (found := _configured(bus)) is not None:
        interface, channel, bitrate = found.interface, channel or found.channel, bitrate or found.bitrate
    if (channel := channel or channel_else) is None:
        raise UsageError("--channel is missing: name the bus, such as --channel vcan0")
    return Target(interface, channel, bitrate or bitrate_else)


def _configured(bus: str | None) -> ConfiguredBus | None:
    from canprobe.fieldbus.bus.real.python_can import configured_bus

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
    """What stands for which of the scene's channels; a channel without a name stands for the first."""
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
