"""`canprobe vcan`: run a command where a real vcan0 exists, in a guest machine if need be."""

from __future__ import annotations

import argparse

from canprobe.cli.parser import Commands, Parser, seconds
from canprobe.errors import UsageError

_EXAMPLE = """\
The command has the same working folder and environment, separate stdout and stderr, no stdin; signals are passed on
(the third one kills). Where this kernel has no vcan it runs as root of a user-mode Linux guest on the same files,
without a network; CANPROBE_VCAN tells the command where it is: here, namespace, link or guest.

exit status: the command's own, 128 + n after signal n; 124 time-out, 125 no vcan can be had, 123 the guest died

examples:
  canprobe vcan -- canprobe run cylinder --bus socketcan --channel vcan0 --patient
  canprobe vcan --timeout 60 -- sh -c 'cangen vcan0 -n 5 & candump -n 5 vcan0'
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "vcan",
        help="run a command where a vcan0 exists",
        usage="canprobe vcan [--install] [--timeout S] [--realtime] -- COMMAND...",
        description=__doc__,
        epilog=_EXAMPLE,
    )
    parser.add_argument("--install", action="store_true", help="install the guest's Debian package if it is missing")
    parser.add_argument("--timeout", metavar="S", type=seconds, help="stop the command after S seconds")
    parser.add_argument("--realtime", action="store_true", help="pin the guest to one processor under SCHED_FIFO")
    parser.add_argument("command", metavar="COMMAND", nargs=argparse.REMAINDER, help="program and arguments")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the command; return its exit status."""
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if not command:
        raise UsageError("vcan: COMMAND is missing; for example: canprobe vcan -- ip link show vcan0")

    from canprobe.bus.vcan import run_with_vcan

    return run_with_vcan(command, timeout_s=args.timeout, install=args.install, realtime=args.realtime)
