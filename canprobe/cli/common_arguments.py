"""Arguments that commands share."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from canprobe.cli.argument_types import channel, folder_path, node_id, seconds, setting, whole, word
from canprobe.cli.parser import Parser

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
    """Add SCENE, which most commands take; optional where another argument can replace it."""
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


def add_eds_nodes(parser: Parser, *, more: str = "") -> None:
    """Add --eds and --node-id, which stand in pairs; `more` ends the help of the latter."""
    parser.add_argument(
        "--eds",
        metavar="FILE",
        action="append",
        default=[],
        help="EDS or DCF file of a node; may be repeated, each with its --node-id",
    )
    parser.add_argument(
        "--node-id",
        metavar="N",
        action="append",
        default=[],
        type=node_id,
        help=f"node id for the --eds at the same position{more}",
    )


def add_inject(parser: Parser, what: str) -> None:
    """Add --inject; `what` begins its help."""
    parser.add_argument(
        "--inject",
        metavar="FAULT",
        action="append",
        default=[],
        type=word,
        help=f"{what}; may be repeated; `canprobe inject --list` lists them",
    )


def add_options(parser: argparse._ActionsContainer, *names: str) -> None:
    """Add options of `OPTIONS`, in this order."""
    for name in names:
        parser.add_argument(name, **OPTIONS[name])


def add_verbosity(parser: Parser) -> None:
    """Add -v and -q to a command that reports its steps."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "-v",
        "--verbose",
        dest="verbosity",
        action="store_const",
        const=1,
        default=0,
        help="report every step on stderr, even without a terminal",
    )
    either.add_argument(
        "-q", "--quiet", dest="verbosity", action="store_const", const=-1, help="report only warnings and errors"
    )
