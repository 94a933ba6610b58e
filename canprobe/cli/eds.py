"""List the packaged EDS files, print the path of one, or check the EDS, DCF, XDD or XDC file of any vendor."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from canprobe.cli.argument_types import whole
from canprobe.cli.output import print_answer
from canprobe.cli.parser import Parser
from canprobe.fieldbus.eds.packaged import check_eds, eds_names, eds_path

if TYPE_CHECKING:
    from canprobe.fieldbus.eds.findings import EdsFinding
    from canprobe.fieldbus.eds.reading import Reading

HELP = "list, locate or check EDS files"
EXAMPLE = """\
examples:
  canprobe eds list
  canprobe eds path puma260_joint
  canprobe eds check drive.eds
"""
_CHECK = """\
A fault means that the file leaves open what the device is or which PDOs it has: it cannot be served. A warning names
what was corrected or ignored.

exit status: 0 without faults, 2 with faults

examples:
  canprobe eds check drive.eds
  canprobe eds check drive.eds --node-id 5 --json
"""


def add_arguments(parser: Parser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=Parser)
    for action, text, examples in (
        ("list", "list the packaged EDS files", "examples:\n  canprobe eds list\n  canprobe eds list --json\n"),
        ("path", "print the path of a packaged EDS file", "example:\n  canprobe eds path puma260_joint\n"),
        ("check", "list the faults and warnings of an EDS, DCF, XDD or XDC file, with section and line", _CHECK),
    ):
        one = actions.add_parser(action, help=text, description=f"{text[0].upper()}{text[1:]}.", epilog=examples)
        one.set_defaults(run=run, action=action)
        if action == "path":
            one.add_argument("eds", metavar="NAME", help="name of a packaged file, with or without .eds")
            continue
        if action == "check":
            file = "path of an EDS, DCF, XDD or XDC file, or name of a packaged file"
            one.add_argument("file", metavar="FILE", help=file)
            one.add_option("--node-id N", "node id that replaces $NODEID [that of the DCF, or 1]", whole(1, 127))
        one.add_shared("--json")


def run(args: argparse.Namespace) -> int:
    """Print the names of the files, the path of one, or what is wrong with one."""
    if args.action == "check":
        return _check(args)
    if args.action == "path":
        print(eds_path(args.eds))
    else:
        print_answer(args, list(eds_names()), "\n".join(eds_names()))
    return 0


def _check(args: argparse.Namespace) -> int:
    """Print the faults and warnings of a file; status 2 when it cannot be served."""
    reading = check_eds(args.file, args.node_id)
    found = [f"{'fault' if fault.prevents else 'warning'}: {fault}" for fault in reading.found]
    print_answer(args, _document(reading), "\n".join([*found, f"{reading.path}: {_summary(reading)}"]))
    return 2 if reading.faults else 0


def _summary(reading: Reading) -> str:
    faults, warnings = len(reading.faults), len(reading.warnings)
    if not faults and not warnings:
        return f"clean, {len(reading.dictionary)} objects"
    verdict = "cannot be served" if faults else "can be served"
    return f"{faults} fault{'s' * (faults != 1)}, {warnings} warning{'s' * (warnings != 1)}; {verdict}"


def _document(reading: Reading) -> dict[str, object]:
    return {
        "file": str(reading.path),
        "servable": not reading.faults,
        "objects": len(reading.dictionary),
        "device_profile": reading.profile or None,
        "faults": [_row(fault) for fault in reading.faults],
        "warnings": [_row(fault) for fault in reading.warnings],
    }


def _row(fault: EdsFinding) -> dict[str, object]:
    return {key: getattr(fault, key) or None for key in ("line", "section", "key")} | {"text": fault.text}
