# PYTHON_ARGCOMPLETE_OK
"""The command line: parse, call, print. Each command is a module, imported only when it is used.

A command module has `HELP`, `EXAMPLE`, `add_arguments(parser)` and `run(args)`, which returns the exit status, or
nothing for 0; its docstring is the description in its help. It imports everything besides argparse inside `run`, so
that `canprobe --help` stays quick.

Commands share the arguments of `parser`, `argument_types`, `target` (scene and bus of a command), `output` (stdout),
`interrupts`, `operator` (questions) and `completion`.
"""

from __future__ import annotations

import argparse
import errno
import gc
import importlib
import io
import os
import sys
import traceback
from collections.abc import Sequence
from functools import partial

import canprobe
from canprobe.cell.session.terminal import StepReport
from canprobe.cli.completion import complete
from canprobe.cli.interrupts import termination_interrupts
from canprobe.cli.parser import Parser
from canprobe.cli.target import with_scene
from canprobe.errors import EXTRA_OF, CanprobeError, did_you_mean, install_line
from canprobe.fieldbus.bus.real.interrupts import Terminated
from canprobe.fieldbus.bus.real.processor import BLAS_THREADS

COMMANDS = (
    "scenes", "cells", "schema", "init", "plan", "check", "run", "up",
    "console", "move", "home", "tare", "listen", "posture",
    "emulate", "inject", "conform", "judge", "adapters", "scan", "monitor",
    "replay", "runs", "view", "export", "calibrate", "study", "vcan", "eds",
)  # fmt: skip

ELSEWHERE = {
    "jog": "canprobe console CELL, and jog there",
    "goto": "canprobe move CELL POSTURE",
    "teach": "canprobe posture save CELL NAME",
    "zero": "canprobe tare CELL for the array, canprobe home CELL for joints",
    "enable": "canprobe up CELL",
}
"""What people call a command that has another name here, and what to type."""
_WRONG_PATH = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
_RAISING = ("strict", "surrogateescape")
"""Handlers of a stream that raise an error on a character that its encoding does not have."""
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_EXAMPLE = """\
`canprobe COMMAND --help` describes a command, with examples. Defaults stand in [brackets].

exit status:
    0  done
    1  stopped for safety
    2  wrong usage, scene or plan
    3  bus or node failure, or a file that cannot be written (full disk)
   70  unexpected error: please report it
  130  interrupted by Ctrl-C
  143  interrupted by SIGTERM or SIGHUP

examples:
  canprobe scenes
  canprobe plan cylinder
  canprobe run cylinder
"""


def main(argv: Sequence[str] | None = None) -> int:  # noqa: PLR0911 - one per way of ending
    """Run one command line.

    Args:
        argv: arguments without the program's name; by default those of the process.

    Returns:
        The exit status: 0, 1, 2, 3, 130 or 143 as `--help` says; 141 when the reader of our output went away; 70 after
        an unexpected error.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    if "_ARGCOMPLETE" in os.environ:
        complete(parser_of, COMMANDS)
    _prepare_streams()
    gc.set_threshold(max(10_000, gc.get_threshold()[0]))  # at Python's 700 a tenth of a start looks for garbage
    for name in BLAS_THREADS:  # before numpy is loaded
        os.environ.setdefault(name, "1")
    report, args = StepReport(), argparse.Namespace()
    try:
        args = parser_of(arguments).parse_args(arguments or ["--help"])
        args.arguments, args.report, report.verbosity = arguments, report, getattr(args, "verbosity", 0)
        report.words = partial(with_scene, args=args)
        with termination_interrupts():
            status = int(args.run(args) or 0)
        sys.stdout.flush()
        return status
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else 0
    except CanprobeError as error:
        text = "\n".join([str(error), *getattr(error, "__notes__", ())])
        return _complain(report, text, error.exit_status)
    except BrokenPipeError:
        _forget_output()
        return 141
    except OSError as error:
        if error.filename is None and error.errno in _NO_ROOM:  # whatever writes a file names it
            _forget_output()
            return _complain(report, f"standard output: cannot be written: {error.strerror}", 3)
        where = f"{error.filename}: " if error.filename is not None else ""
        return _complain(
            report, f"{where}{error.strerror or error}", 2 if where and isinstance(error, _WRONG_PATH) else 3
        )
    except KeyboardInterrupt as interrupt:
        return 143 if isinstance(interrupt, Terminated) else 130
    except Exception as error:
        package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
        if package in EXTRA_OF:
            return _complain(report, f"{arguments[0]}: needs {package}; type: {install_line(EXTRA_OF[package])}", 2)
        traceback.print_exc()
        return _complain(report, "this is a fault of canprobe itself: please report it with the lines above", 70)


def _prepare_streams() -> None:
    """Make closed standard streams (`>&-`) usable, and print characters that an encoding lacks as `\\xb5`.

    Unless PYTHONIOENCODING says otherwise. Strict streams raise, and so do those of the C locale (`surrogateescape`).
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115 - as long as the process
        elif mode == "w" and isinstance(stream, io.TextIOWrapper) and stream.errors in _RAISING:
            stream.reconfigure(errors="backslashreplace")


def _forget_output() -> None:
    """Let the interpreter's last flush of stdout go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def parser_of(arguments: Sequence[str]) -> Parser:
    """The parser with the named command only, or with all of them when none is named."""
    parser = Parser(
        prog="canprobe", description="Bring up, run, emulate and watch a robot cell on a CAN bus.", epilog=_EXAMPLE
    )
    parser.add_argument(
        "--version", action="version", version=f"canprobe {canprobe.__version__}", help="print the version"
    )
    named = next((word for word in arguments if not word.startswith("-")), None)
    if named is not None and named not in COMMANDS:
        hint = f"; type {typed}" if (typed := ELSEWHERE.get(named)) else did_you_mean(named, COMMANDS)
        parser.error(f"unknown command {named!r}{hint}; commands: {', '.join(COMMANDS)}")
    if named is None and (unknown := [word for word in arguments if word not in parser._option_string_actions]):
        parser.refuse_unknown(unknown)
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)
    for name in (named,) if named else COMMANDS:
        command = importlib.import_module(f"canprobe.cli.{name}")
        one = commands.add_parser(name, help=command.HELP, description=command.__doc__, epilog=command.EXAMPLE)
        one.set_defaults(run=command.run)
        command.add_arguments(one)
    return parser


def _complain(report: StepReport, text: str, status: int) -> int:
    for line in text.splitlines():
        report.complain(f"canprobe: {line}")
    return status
