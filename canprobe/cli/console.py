"""Move the arm by hand from a terminal: jog, go to postures, teach them, home, tare, and see the cell meanwhile.

The cell comes up as with `up`. Nothing moves before a person has typed `yes`, and a motion goes on only while it is
renewed: it ends within 150 ms after the last key, or when the terminal is gone. With the extra `console` a screen has
keys for it. Without it, or with --plain, commands are typed line by line; `help` lists them.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from canprobe.cli.hands import ROWS
from canprobe.cli.interrupts import left_by_ctrl_c
from canprobe.cli.parser import Parser
from canprobe.cli.target import scene_of
from canprobe.fieldbus.bus.system import system

if TYPE_CHECKING:
    from canprobe.cell.master.observers import Observation

HELP = "jog the arm and watch the cell on a screen"
EXAMPLE = """\
examples:
  canprobe console puma260 --view
  canprobe console cell.toml --bus socketcan --channel can0
  canprobe console cell.toml --plain --bus socketcan --channel can0
"""
PATIENCE_S = 2.0
"""Longest time without a reader at the end, s."""
_MOST_WAITING = 100_000
"""Bytes that wait for a reader; what comes then is left out."""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE", "BUS", "--realtime", "--patient", "--bridge")
    parser.add_argument(
        "--view", action="append_const", dest="bridge", const="view", help="show the arm in a browser; --bridge view"
    )
    parser.add_option("--plain", "commands and answers as lines, without a screen")
    parser.add_option("--json", "as --plain, with answers and, ten times a second, the state as JSON lines")
    parser.add_shared("-v")


def run(args: argparse.Namespace) -> int:
    """Show the screen, whose cell is a process of its own; or take lines from stdin."""
    scene = scene_of(args)
    on_terminal = all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr))
    if on_terminal and not (args.plain or args.json) and importlib.util.find_spec("textual") is not None:
        from canprobe.cli.console_screen import run_screen

        return run_screen(args.arguments)

    from canprobe import api
    from canprobe.cli.console_words import Words
    from canprobe.cli.hand_session import HandSession

    output = WaitingOutput(sys.stdout, as_json=args.json)
    homes = any(joint.zero == "homing" for joint in scene.joints.values())

    def observe(observation: Observation) -> None:
        session.view.observe(observation)

    say = output.show if args.json else args.report.say
    cell = api.open_cell(scene, say=say, rows_kept=ROWS, to_home=homes, observers=[observe], bridge=args.bridge)
    session = HandSession(cell, output.show, Path(args.cell or args.scene))

    def lines() -> tuple[bytes, bool]:
        return (b"", False) if output.gone else system.typed(sys.stdin.fileno())

    session.take = Words(session, lines, output.show).take
    with left_by_ctrl_c(), cell:
        session.run()
    output.flush(PATIENCE_S)
    return 0


class WaitingOutput:
    """Lines for a reader that may be slow or stand still: what it does not take waits, and no cycle with it.

    Args:
        stream: a terminal, file or pipe.
        as_json: each line is a JSON document, and states are written, too.

    Attributes:
        gone: whether nobody reads it any more.
    """

    def __init__(self, stream: TextIO, *, as_json: bool) -> None:
        self._descriptor, self._encoding = stream.fileno(), stream.encoding
        self._as_json, self._waiting = as_json, b""
        self.gone = False

    def show(self, what: str | dict[str, Any]) -> None:
        """Write a text or a state; states are left out where something waits."""
        if self._as_json and (isinstance(what, str) or not self._waiting):
            what = json.dumps({"says": what} if isinstance(what, str) else what, separators=(",", ":"))
        if isinstance(what, str) and len(self._waiting) < _MOST_WAITING:
            self._waiting += what.encode(self._encoding, "backslashreplace") + b"\n"
        self.flush()

    def flush(self, patience_s: float = 0.0) -> None:
        """Write as much as the reader takes, without waiting for it any longer than that."""
        taken = 1
        while taken and not self.gone:
            try:
                taken = system.write_some(self._descriptor, self._waiting, patience_s)
            except OSError:
                self.gone = True
            self._waiting = self._waiting[taken:]
