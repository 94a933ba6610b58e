"""Throw faults at emulated nodes while they are served, by `canprobe emulate` or a run on a real bus.

A fault is written as: node N: NAME [k=v …] [at T | on EVENT] [for D]. Times count from now; events are boot-up,
operational, enabled and sync. --list prints all kinds with the clause, what happens, and what a conforming peer does.
Only the user who serves the nodes may throw faults.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from canprobe.cli.argument_types import word
from canprobe.cli.output import print_answer, print_table
from canprobe.cli.parser import Parser
from canprobe.errors import UsageError

HELP = "throw faults at emulated nodes"
EXAMPLE = """\
examples:
  canprobe inject --list
  canprobe inject --channel vcan0 "node 3: heartbeat-off for 2 s"
  canprobe inject --channel vcan0 "node 3: delay ms=2 share=0.5 seed=7" "node 16: torn at 1 s"
  canprobe inject --channel vcan0 "motor 1: over-temperature for 1 s"
  canprobe inject --channel vcan0 --clear
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("faults", metavar="FAULT", nargs="*", type=word, help="fault, such as 'node 3: mute for 2 s'")
    parser.add_option("--list", "list the kinds of faults, and end")
    parser.add_option("--clear", "end the faults that hold, before others are thrown")
    parser.add_option("--channel CH", "channel of the nodes [vcan0]", word, default="vcan0")
    parser.add_shared("--json", "-v")


def run(args: argparse.Namespace) -> None:
    """List the kinds, or throw faults."""
    if args.list:
        return _list(args)
    if not args.faults and not args.clear:
        raise UsageError("inject: name a FAULT, or --clear, or --list")
    from canprobe.fieldbus.tools.faults.control import request_faults

    done = request_faults(args.channel, args.faults, clear=args.clear)
    lines = [f"{what}: {fault}" for what, faults in done.items() for fault in faults]
    print_answer(args, done, "\n".join(lines), end="\n" * bool(lines))


def _list(args: argparse.Namespace) -> None:
    from canprobe.cell.emulated.array_faults import CELL_FAULTS
    from canprobe.fieldbus.tools.faults.fault import number_text
    from canprobe.fieldbus.tools.faults.motor_faults import MOTOR_FAULTS

    kinds = {**CELL_FAULTS, **MOTOR_FAULTS}
    document = [
        {
            "name": kind.name,
            "parameters": {name: asdict(one) for name, one in kind.parameters.items()},
            **{key: getattr(kind, key) for key in ("what", "clause", "reaction")},
            "conditions": sorted(kind.conditions),
            "points": sorted(kind.points),
            "needs": kind.needs,
        }
        for kind in kinds.values()
    ]
    rows = [("fault", "what happens", "clause", "expected reaction")]
    for kind in kinds.values():
        values = [number_text(name, one.default) for name, one in kind.parameters.items()]
        rows.append((" ".join([kind.name, *values]), kind.what, kind.clause, kind.reaction))
    print_answer(args, document, lambda: print_table(rows))
