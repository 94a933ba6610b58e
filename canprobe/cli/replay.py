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
    """Replay the log, to bridges too where some are named; print the estimates and the state of the bridges."""
    from canprobe.cell.recorded.reestimate import RecordedBridges, replay, replay_into
    from canprobe.cell.results.text import bridge_lines

    if args.bridge:
        replayed = replay_into(args.log, args.bridge, scene=args.scene, method=args.method, say=args.report.say)
    else:
        replayed = RecordedBridges(replay(args.log, scene=args.scene, method=args.method), {})
    result, bridges = replayed.result, replayed.bridges
    if result is not None and args.out is not None:
        result.save(args.out)
    summary, texts = ({}, []) if result is None else (result.summary, [result.text()])
    document = {**summary, "bridges": bridges} if args.bridge else summary
    print_answer(args, document, "\n".join([*texts, *bridge_lines(bridges)]))
    for name, status in bridges.items():
        if status["error"] is not None:
            raise ResultsError(f"bridge {name}: {status['error']}")
