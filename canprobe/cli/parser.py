"""argparse as the commands use it: one clear line for a wrong command line, and the arguments that commands share."""

from __future__ import annotations

import argparse
import difflib
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NoReturn

Commands = argparse._SubParsersAction


class Parser(argparse.ArgumentParser):
    """An argument parser that keeps examples as written and complains in one line."""

    def __init__(self, **settings: object) -> None:
        settings.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        settings.setdefault("allow_abbrev", False)
        super().__init__(**settings)  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line and leave with status 2."""
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def did_you_mean(got: str, known: Iterable[str]) -> str:
    """`; did you mean X?`, or nothing when no known word is close."""
    close = difflib.get_close_matches(got, list(known), n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else ""


def add_scene(parser: argparse.ArgumentParser, optional: bool = False) -> None:
    """SCENE, which most commands take; optional where another argument can stand for it."""
    parser.add_argument(
        "scene",
        metavar="SCENE",
        nargs="?" if optional else None,
        help="a packaged scene (`canprobe scenes` lists them) or the path of a TOML file",
    )


def add_bus(parser: argparse.ArgumentParser) -> None:
    """Where the nodes are, in place of what the scene says."""
    parser.add_argument(
        "--bus",
        metavar="B",
        type=word,
        help="lockstep, socketcan or another python-can interface; config: the one that CAN_INTERFACE or python-can's"
        " configuration files name [the scene's]",
    )
    parser.add_argument(
        "--channel",
        metavar="[NAME=]CH",
        action="append",
        type=channel,
        help="channel of the interface; NAME=CH replaces the scene's channel NAME and may be repeated [the scene's]",
    )
    parser.add_argument("--bitrate", metavar="BIT/S", type=whole(10_000, 1_000_000), help="bit rate [the scene's]")


def add_bridge(parser: argparse.ArgumentParser) -> None:
    """Other tools to feed, besides those of the scene."""
    parser.add_argument(
        "--bridge",
        metavar="NAME",
        action="append",
        help="send the data to another tool: mcap, foxglove, ros2 or view; may be repeated",
    )


def add_force(parser: argparse.ArgumentParser) -> None:
    """--force, of what writes results into a folder."""
    parser.add_argument("--force", action="store_true", help="replace the results of an earlier run in DIR")


def add_json(parser: argparse.ArgumentParser) -> None:
    """--json: one document on stdout."""
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout")


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
