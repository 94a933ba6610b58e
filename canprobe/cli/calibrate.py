"""Calibrate a tactile array by touching a plane, a ball and a rod of known size with the arm of a cell.

39 touches take about five minutes. They give the force, the stiffness of the layer, the blur, the crosstalk, the noise
and the lag of the array. An emulated cell has the objects; at a real one you are asked to place them. Images alone do
not show newtons: --force-reference names what you measured the force with, else the calibration is in nominal newtons.
The result is a file for the key sensor.calibration. --verify says in a minute whether the file of the cell still holds.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from datetime import date
from functools import partial

from canprobe.cell.session.terminal import StepReport
from canprobe.cli.argument_types import folder_path, positive, seed, word
from canprobe.cli.output import print_answer
from canprobe.cli.parser import Parser
from canprobe.cli.target import target_of
from canprobe.errors import install_line

HELP = "calibrate a tactile array on objects of known size"
EXAMPLE = """\
examples:
  canprobe calibrate array puma260 --force-reference scale --sigma 0.5
  canprobe calibrate array mycell.toml --bus socketcan --channel can0
  canprobe calibrate array mycell.toml --verify
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("kind", metavar="array", choices=["array"], help="what is calibrated")
    parser.add_argument("cell", metavar="CELL", type=word, help="name of a packaged cell, or path of a cell file")
    parser.add_argument(
        "--force-reference",
        choices=["scale", "weights", "unit", "none"],
        default="none",
        help="reference of the force in newtons: a scale or load cell under the object, known weights, the stated"
        " full scale of the array (unit), or nothing [none: nominal newtons]",
    )
    parser.add_option("--sigma PERCENT", "standard deviation of that reference [1]", positive, default=1.0)
    parser.add_argument(
        "--at", metavar=("X", "Y", "Z"), nargs=3, type=float,
        help="touched point in the base frame, mm [for a cell file: below the probe in its start posture]",
    )  # fmt: skip
    parser.add_option("--ball-radius MM", "radius of the ball [25]", positive, default=25.0)
    parser.add_option("--rod-radius MM", "radius of the rod [25]", positive, default=25.0)
    parser.add_option(
        "--make", "write a calibration for all arrays of this make, without the gains and dead taxels of this one"
    )
    parser.add_option(
        "--spread PERCENT",
        "with --make: standard deviation of the force from array to array, by its data sheet [10]",
        positive,
        default=10.0,
    )
    parser.add_option(
        "--verify", "touch the ball three times, and say whether the calibration of the cell still holds [status 1: no]"
    )
    parser.add_option("--yes", "do not ask for objects; for an emulated cell only")
    parser.add_shared("BUS")
    parser.add_option("--seed N", "seed of the emulation [0]", seed, default=0)
    parser.add_option("--out DIR", "folder of the files [runs/calibrate-array-<cell>-<time>]", folder_path)
    parser.add_shared("--force", "--json", "-v")


def run(args: argparse.Namespace) -> int:
    """Touch, fit, print, and write calibration.toml, calibration.png and the recorded buses."""
    from canprobe import api
    from canprobe.cell.results.array_report import as_document, calibration_text, draw_calibration, verification_text
    from canprobe.cell.results.summary import without_nan
    from canprobe.cell.scene.calibrations import dump_calibration
    from canprobe.cell.scene.load import load_scene, read_cell
    from canprobe.cell.session.array_calibration import CalibrationRequest, calibrate, verify
    from canprobe.fieldbus.bus.files import write_text

    today = date.today().isoformat()
    out = args.out or api.timed_folder(f"calibrate-array-{read_cell(args.cell).cell.name}")
    api.check_free(out, force=args.force)
    request = CalibrationRequest(
        cell=args.cell,
        target=target_of(args, load_scene("press", {"cell": args.cell})),
        at=args.at and tuple(args.at),
        ball_radius=1e-3 * args.ball_radius,
        rod_radius=1e-3 * args.rod_radius,
        reference=args.force_reference,
        sigma=1e-2 * args.sigma,
        own_gains=not args.make,
        spread=1e-2 * args.spread,
        seed=args.seed,
    )
    ask, say = None if args.yes else _ask, partial(_say_step, args.report)
    if args.verify:
        calibration, verification = verify(request, date=today, ask=ask, say=say, out=out)
        document = {**asdict(verification), "holds": verification.holds, "verified": calibration.verified}
        print_answer(args, without_nan(document), verification_text(calibration, verification))
        return 0 if verification.holds else 1
    found = calibrate(request, date=today, ask=ask, say=say, out=out)
    write_text(out / "calibration.toml", dump_calibration(found.fit.calibration))
    try:
        draw_calibration(found.fit, out / "calibration.png")
    except ModuleNotFoundError:  # the touches are done: only their picture is missing
        args.report.say(f"calibration.png is left out: matplotlib is not installed: {install_line('study')}")
    document = as_document(found.fit) | {"restless": [list(p) for p in found.restless], "notes": list(found.notes)}
    lines = [
        calibration_text(found.fit),
        f"  unloaded   {len(found.restless)} taxels show counts, drift {found.drift_counts:.2f} counts",
        *(f"  note       {note}" for note in found.notes),
        f'  file       {out / "calibration.toml"}; name it in the cell: [sensor] calibration = "..."',
    ]
    print_answer(args, document, "\n".join(lines))
    return 0


def _say_step(report: StepReport, line: str) -> None:
    """Report the next step; the steps of each bring-up only with -v."""
    if report.verbosity > 0 or line.startswith(("visit", "warning")):
        report.say(line)


def _ask(text: str) -> str:
    print(text, end="", file=sys.stderr, flush=True)
    answer = sys.stdin.readline()
    if not answer:
        raise EOFError("no answer: standard input is closed")
    return answer.strip()
