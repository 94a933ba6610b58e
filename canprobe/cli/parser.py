"""argparse for the commands: one clear line for a wrong command line."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Sequence
from typing import Any, NoReturn

from canprobe.errors import did_you_mean

_KEYS = {
    "--bus": "bus.interface",
    "--channel": "bus.channel",
    "--bitrate": "bus.bitrate",
    "--realtime": "cycle.realtime",
    "--seed": "scene.seed",
    "--duration": "task.duration_s",
}
"""Options of some commands that set a key of the scene."""


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
        if key is not None:
            given = words[0].partition("=")[2] or next(
                (word for word in words[1:2] if not word.startswith("-")), "true"
            )
            hint = f"; did you mean --set {key}={given}?"
        self.error(f"unrecognized arguments: {' '.join(words)}{hint}")
