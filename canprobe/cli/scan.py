"""`canprobe scan`: list the nodes on a bus with their identity."""

from __future__ import annotations

import argparse

from canprobe.cli.output import print_json, print_table
from canprobe.cli.parser import Commands, Parser, add_json, channel, whole
from canprobe.cli.target import real_target
from canprobe.errors import UsageError

_EXAMPLE = """\
example:
  canprobe scan --bus socketcan --channel can0
"""
_COLUMNS = ("node_id", "state", "vendor_id", "product_code", "revision_number", "serial_number", "device_name")


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("scan", help="list the nodes on a bus", description=__doc__, epilog=_EXAMPLE)
    parser.add_argument(
        "--bus", metavar="B", help="any python-can interface [as CAN_INTERFACE or python-can's files say, or socketcan]"
    )
    parser.add_argument("--channel", metavar="CH", type=channel, default=(None, None), help="the channel [can0]")
    parser.add_argument("--bitrate", metavar="BIT/S", type=whole(10_000, 1_000_000), help="[1000000]")
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print one row a node."""
    if args.bus == "lockstep":
        raise UsageError("scan: a lockstep bus lives inside one run and has nobody on it; name a real interface")

    from canprobe import api

    interface, name, bitrate = real_target(args.bus, args.channel[1], args.bitrate)
    where = name or "can0"
    nodes = api.scan(interface, where, bitrate or 1_000_000)
    if args.json:
        print_json(nodes)
    elif nodes:
        keys = [key for key in _COLUMNS if any(key in node for node in nodes)]
        print_table([keys, *([_cell(key, node.get(key)) for key in keys] for node in nodes)])
    else:
        print(f"no node answers on {where}")
    return 0


def _cell(key: str, value: object) -> str:
    if value is None:
        return "-"
    return f"{value:#x}" if isinstance(value, int) and key != "node_id" else str(value)
