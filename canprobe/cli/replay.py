"""Estimate the shape again from a recorded bus.

The log of a run gives the estimates of that run again. In another candump of the same nodes every contact is used.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from canprobe.cli.output import print_answer
from canprobe.cli.parser import Parser
from canprobe.errors import ResultsError

HELP = "estimate the shape again from a recorded bus"
EXAMPLE = """\
examples:
  canprobe replay runs/cylinder-20260101-120000-000
  canprobe replay runs/cylinder-20260101-120000-000 --method ml --method chen1996 --out estimates.npz
  canprobe replay candump.log --scene cylinder --json
  canprobe replay runs/cylinder-20260101-120000-000 --bridge mcap
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument(
        "log", metavar="LOG", type=Path, help="folder of a run, or a log of candump or, by its suffix, of another tool"
    )
    parser.add_option("--scene SCENE", "packaged scene or path of a TOML file [the scene.toml of the run]")
    parser.add_option(
        "--method M", "recursive, ml, chord or chen1996; may be repeated [those of the scene]", action="append"
    )
    parser.add_option("--out FILE", "write all estimates to this npz file", Path)
    parser.add_shared("--bridge", "--json", "-v")


def run(args: argparse.Namespace) -> None:
    """Replay the log and print the estimates."""
    from canprobe.cell.recorded import reestimate as recorded

    if args.bridge:
        return _run_into(args)
    result = recorded.replay(args.log, scene=args.scene, method=args.method)
    if args.out is not None:
        result.save(args.out)
    print_answer(args, result.summary, result.text())


def _run_into(args: argparse.Namespace) -> None:
    """Feed the log to bridges; print the estimates and the state of the bridges."""
    from canprobe.cell.recorded.reestimate import replay_into
    from canprobe.cell.results.text import bridge_lines

    replayed = replay_into(args.log, args.bridge, scene=args.scene, method=args.method, say=args.report.say)
    if replayed.result is not None and args.out is not None:
        replayed.result.save(args.out)
    summary, texts = ({}, []) if replayed.result is None else (replayed.result.summary, [replayed.result.text()])
    text = "\n".join([*texts, *bridge_lines(replayed.bridges)])
    print_answer(args, {**summary, "bridges": replayed.bridges}, text)
    for name, status in replayed.bridges.items():
        if status["error"] is not None:
            raise ResultsError(f"bridge {name}: {status['error']}")
