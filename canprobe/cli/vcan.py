"""Run a command where a real vcan0 exists: on this machine if possible, else in a small virtual machine.

The command has the working folder and the environment of the caller, separate stdout and stderr, and no stdin. Without
a command a shell is opened, on your terminal or for the lines of standard input; `exit` leaves it. Signals are passed
on; the third one kills. The virtual machine is a user-mode Linux with the same files and without a network;
the command runs there as root. CANPROBE_VCAN names the way that was taken: here, namespace, link or guest.
"""

from __future__ import annotations

import argparse
import sys

from canprobe.cli.argument_types import seconds
from canprobe.cli.parser import Parser
from canprobe.errors import UsageError

HELP = "run a command with a virtual CAN interface vcan0"
EXAMPLE = """\
exit status: that of the command, 128 + n after signal n; 124 time-out, 125 no vcan0 possible here, 123 the virtual
machine ended early

examples:
  canprobe vcan -- canprobe run cylinder --bus socketcan --channel vcan0 --patient
  canprobe vcan
  canprobe vcan --timeout 60 -- sh -c 'cangen vcan0 -n 5 & candump -n 5 vcan0'
"""


def add_arguments(parser: Parser) -> None:
    parser.usage = "canprobe vcan [--install] [--timeout S] [--realtime] [-- COMMAND...]"
    parser.add_option(
        "--install", "install the Debian packages user-mode-linux and iproute2 if they are needed (as root)"
    )
    parser.add_option("--timeout S", "stop the command after S seconds", seconds)
    parser.add_option("--realtime", "pin the virtual machine to one processor under SCHED_FIFO")
    parser.add_argument(
        "command", metavar="COMMAND", nargs=argparse.REMAINDER, help="command to run, with its arguments [a shell]"
    )


def run(args: argparse.Namespace) -> int:
    """Run the command; return its exit status."""
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if not sys.platform.startswith("linux"):
        raise UsageError(
            "vcan: SocketCAN is Linux's: run this in a Linux, or take --bus lockstep or --bus udp_multicast"
        )
    from canprobe.fieldbus.vcan.launch import run_with_vcan

    return run_with_vcan(command, timeout_s=args.timeout, install=args.install, realtime=args.realtime)
