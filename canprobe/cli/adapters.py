"""List the CAN interfaces of this machine and what to type next, and what each interface of python-can needs.

Interfaces of the kernel (SocketCAN) come first, then channels that the makers' drivers report, then serial ports by
USB, each of which may be an adapter that speaks slcan. No bus is opened, and nothing is sent.
"""

from __future__ import annotations

import argparse

from canprobe.cli.parser import Parser

HELP = "list the CAN interfaces of this machine"
EXAMPLE = """\
examples:
  canprobe adapters
  canprobe adapters --json
"""
_READY = "nothing; for example --bus {} --channel {}"


def add_arguments(parser: Parser) -> None:
    parser.add_shared("--json")


def run(args: argparse.Namespace) -> None:
    """Print the channels that are here, then the interfaces with what they lack."""
    from dataclasses import asdict

    from canprobe.cli.output import print_json, print_table
    from canprobe.fieldbus.bus.real.adapters import BACKENDS, find_adapters, missing_here

    found, missing = find_adapters(), {name: missing_here(name) for name in BACKENDS}
    if args.json:
        interfaces = [{"interface": name, **asdict(one), "missing": missing[name]} for name, one in BACKENDS.items()]
        print_json({"found": [asdict(one) for one in found], "interfaces": interfaces})
        return
    if found:
        rows = [(one.interface, one.channel, one.state, one.type_next) for one in found]
        print_table([("found here", "channel", "state", "type next"), *rows])
    else:
        print("found here: no CAN interface")
    print()
    states = [
        (name, one.hardware, one.has, "; ".join(missing[name]) or _READY.format(name, one.example))
        for name, one in BACKENDS.items()
    ]
    print_table([("--bus", "for", "has, by python-can", "missing"), *states])
