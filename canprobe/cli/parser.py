"""argparse for the commands: the arguments that they share, and one clear line for a wrong command line."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Callable, Container, Sequence
from typing import Any, NamedTuple, NoReturn

from canprobe.cli.argument_types import can_id, channel, folder_path, node_id, seconds, seed, setting, whole, word
from canprobe.errors import did_you_mean

PATIENT_SYNCS = 40
"""100 ms at 400 Hz: a virtual machine may stand still as long."""


class Option(NamedTuple):
    """An option, as `Parser.add_option` adds it.

    Attributes:
        form: how it is typed, such as `--every S`; a switch has no word behind it.
        text: its help.
        kind: function that reads its value.
        many: whether it may be repeated; its values are a list then.
    """

    form: str
    text: str
    kind: Callable[[str], Any] | None = None
    many: bool = False


_SHARED = (
    Option("--cell C", "a packaged cell (`canprobe cells` lists them) or a path [the scene's]", word),
    Option(
        "--bus B",
        "lockstep, direct (no bus), socketcan or another python-can interface; config: the one that CAN_INTERFACE or"
        " python-can's configuration files name [the scene's]",
        word,
    ),
    Option(
        "--channel [NAME=]CH",
        "channel of the interface; NAME=CH replaces the scene's channel NAME and may be repeated [the scene's]",
        channel,
        many=True,
    ),
    Option("--bitrate BIT/S", "bit rate [the scene's]", whole(10_000, 1_000_000)),
    Option(
        "--set KEY=VALUE",
        "a key of the scene, as `--set task.force_n=3`, checked as in a file; may be repeated",
        setting,
        many=True,
    ),
    Option(
        "--realtime",
        "request SCHED_FIFO, a processor for the cycle and locked memory; what the system does not permit is reported"
        " [the scene's cycle.realtime]",
    ),
    Option(
        "--patient",
        f"emulated nodes on a slow machine: drives wait for {PATIENT_SYNCS} SYNCs, and late cycles stop nothing",
    ),
    Option("--bridge NAME", "send the data to another tool: mcap, foxglove, ros2 or view; may be repeated", many=True),
    Option("--out DIR", "folder of the results [runs/<scene>-<time>]", folder_path),
    Option("--force", "replace the results of an earlier run in DIR"),
    Option("--seed N", "seed of all random numbers [the scene's]", seed),
    Option("--duration S", "length of the scan, press, listen or free phase in seconds [the scene's]", seconds),
    Option("--json", "print one JSON document on stdout"),
)
_OPTIONS = {option.form.partition(" ")[0]: option for option in _SHARED}
"""Options that commands share, by their names."""
_KEYS = {
    "--bus": "bus.interface",
    "--channel": "bus.channel",
    "--bitrate": "bus.bitrate",
    "--realtime": "cycle.realtime",
    "--seed": "scene.seed",
    "--duration": "task.duration_s",
}
"""Options of some commands that set a key of the scene."""
_FORMS = {
    "--node": r"\d+",
    "--eds": r".+\.(eds|dcf|xdd|xdc)",
    "--urdf": r".+\.urdf",
    "--record": r".+\.(log|asc|blf|trc)",
}
"""What arguments without their option look like."""


def option_for(word: str, known: Container[str]) -> str | None:
    """The option, of those that are known, that is missing before an argument which looks like its own."""
    fits = (option for option, form in _FORMS.items() if option in known and re.fullmatch(form, word, re.IGNORECASE))
    return next(fits, None)


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Paragraphs are as wide as the terminal; lists and examples, which are indented, stay as written."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n\n".join(
            part if "\n " in part else textwrap.fill(part, width, break_on_hyphens=False, break_long_words=False)
            for part in text.split("\n\n")
        )


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps examples as written and complains in one line.

    Attributes:
        takes_command: whether what stands behind `--` is a command, which is kept as the list `command`.
        takes_ways: whether an argument such as `-5deg` is a number, and no option.
        late: an optional positional argument that may stand behind options.
    """

    takes_command = False
    takes_ways = False
    late: str | None = None

    def __init__(self, **settings: object) -> None:
        settings.setdefault("formatter_class", _Formatter)
        settings.setdefault("allow_abbrev", False)
        super().__init__(**settings)  # type: ignore[arg-type]

    def add_option(
        self,
        form: str,
        text: str,
        kind: Callable[[str], Any] | None = None,
        many: bool = False,
        *,
        to: argparse._ActionsContainer | None = None,
        **more: Any,
    ) -> None:
        """Add an option.

        Args:
            form, text, kind, many: see `Option`.
            to: group of the help in which it stands.
            more: further arguments of `add_argument`.
        """
        name, _, metavar = form.partition(" ")
        if not metavar:
            more |= {"action": "store_true"}
        elif many:
            more |= {"metavar": metavar, "type": kind, "action": "append", "default": []}
        else:
            more |= {"metavar": metavar, "type": kind}
        (to or self).add_argument(name, help=text, **more)

    def add_shared(self, *names: str, to: argparse._ActionsContainer | None = None) -> None:
        """Add arguments that commands share, in this order.

        Args:
            names: their names; SCENE is the scene with --cell and --set, and [SCENE] one that another argument can
                replace; BUS is --bus, --channel and --bitrate; -v brings -q.
            to: group of the help in which they stand.
        """
        for name in names:
            match name:
                case "SCENE" | "[SCENE]":
                    what = "a packaged scene (`canprobe scenes` lists them), a cell, or the path of a TOML file"
                    self.add_argument("scene", metavar="SCENE", nargs="?" if name == "[SCENE]" else None, help=what)
                    self.add_shared("--cell", "--set")
                case "BUS":
                    self.add_shared("--bus", "--channel", "--bitrate", to=to)
                case "-v":
                    either = self.add_mutually_exclusive_group()
                    kind: dict[str, Any] = {"dest": "verbosity", "action": "store_const"}
                    what = "report every step on stderr, even without a terminal"
                    either.add_argument("-v", "--verbose", **kind, const=1, default=0, help=what)
                    either.add_argument("-q", "--quiet", **kind, const=-1, help="report only warnings and errors")
                case _:
                    self.add_option(*_OPTIONS[name], to=to)

    def add_real_bus(self, more: str = "") -> None:
        """Add --bus, --channel and --bitrate of a real bus without a scene; `more` names what else --bus may be."""
        what = f"python-can interface{more} [that of CAN_INTERFACE or python-can's configuration files, else socketcan]"
        self.add_option("--bus B", what, word)
        self.add_option("--channel CH", "channel of the interface [can0]", word)
        self.add_option("--bitrate BIT/S", "bit rate [1000000]", whole(10_000, 1_000_000))

    def add_eds_nodes(self, *, more: str = "") -> None:
        """Add --eds and --node-id, which stand in pairs; `more` ends the help of the latter."""
        what = "EDS, DCF, XDD or XDC file of a node; may be repeated, each with its --node-id"
        self.add_option("--eds FILE", what, many=True)
        self.add_option("--node-id N", f"node id for the --eds at the same position{more}", node_id, many=True)

    def add_motors(self) -> None:
        """Add --motor and --id, which stand in pairs, and --mst-id."""
        what = "motor that speaks no CANopen, such as damiao:dm4310; may be repeated, each with its --id"
        self.add_option("--motor MAKE:TYPE", what, word, many=True)
        self.add_option("--id N", "id (ESC_ID) of the --motor at the same position", whole(1, 127), many=True)
        self.add_option("--mst-id N", "MST_ID of its answers [0, the factory's]", can_id, many=True)

    def add_inject(self, what: str) -> None:
        """Add --inject; `what` begins its help."""
        what += "; may be repeated; `canprobe inject --list` lists them"
        self.add_option("--inject FAULT", what, word, many=True)

    def error(self, message: str) -> NoReturn:
        """Report the error in one line and exit with status 2."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse like argparse; unknown arguments are reported by their command, not by the root."""
        command: list[str] = []
        if self.takes_command and "--" in (args or ()):
            split = args.index("--")
            args, command = args[:split], args[split + 1 :]
        if self.takes_ways:  # argparse takes what begins with a space for no option
            args = [f" {one}" if re.match(r"-[\d.]", one) else one for one in args]
        found, rest = super().parse_known_args(args, namespace)
        if self.takes_command:
            found.command = command
        if self.late is not None and rest and getattr(found, self.late) is None and rest[0][0] != "-":
            setattr(found, self.late, rest.pop(0))
        if rest:
            self.refuse_unknown(rest)
        return found, rest

    def refuse_unknown(self, words: Sequence[str]) -> NoReturn:
        """Report unknown arguments and exit; where the command takes --set, the key of an option of other commands."""
        key = _KEYS.get(words[0].partition("=")[0]) if "--set" in self._option_string_actions else None
        hint = did_you_mean(words[0], self._option_string_actions, 0.7) if words[0].startswith("-") else ""
        if (option := option_for(words[0], self._option_string_actions)) is not None:
            hint = f"; did you mean {option} {words[0]}?"
        if key is not None:
            given = words[0].partition("=")[2] or next(
                (word for word in words[1:2] if not word.startswith("-")), "true"
            )
            hint = f"; did you mean --set {key}={given}?"
        self.error(f"unrecognized arguments: {' '.join(words)}{hint}")
