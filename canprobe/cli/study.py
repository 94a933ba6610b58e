"""Run a study: accuracy of the estimators, limits of the force loop, faults, timing. It writes tables and pictures.

Finished cells of a study are kept in DIR/cells.jsonl. The same command computes what is missing, after Ctrl-C or a
crash. Cells whose code has changed since are computed again.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from canprobe.cli.argument_types import whole
from canprobe.cli.output import print_answer, print_json, print_table
from canprobe.cli.parser import Parser
from canprobe.errors import did_you_mean
from canprobe.fieldbus.bus.real.interrupts import interrupts_repeated

HELP = "measure accuracy, limits, faults and timing"
EXAMPLE = """\
examples:
  canprobe study --list
  canprobe study estimators --quick --out runs/estimators
  canprobe study faults --draw 1
  canprobe study faults --seed 4711
  canprobe study faults --recover --seed 17
  canprobe study regions --draw 2 --against earlier/regions.json
  canprobe study calibration --draw 2
  canprobe vcan -- canprobe study faults --vcan
  canprobe vcan -- canprobe study faults --recover --vcan
  canprobe vcan --realtime -- canprobe study realtime --soak
"""
STUDIES_WITH: Mapping[str, tuple[str, ...]] = {
    "draw": ("calibration", "faults", "realtime --link", "regions", "surfaces"),
    "against": ("regions",),
    "seed": ("faults", "faults --recover", "regions"),
}
"""Studies, as they are typed, that have an option, by the option's name."""
FORM_OPTIONS = ("recover", "link", "soak", "vcan")
"""Options that name another form of a study, in the order in which they are typed."""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("name", metavar="NAME", nargs="?", help="study to run; --list lists them")
    parser.add_option("--list", "list the studies, and end")
    parser.add_option("--out DIR", "folder of the files [runs/study-NAME]", Path)
    parser.add_option("--quick", "measure fewer cases, with fewer repeats")
    parser.add_option(
        "--seed N", "faults, regions: run only the case of this seed, and report each step", whole(0, 2**63 - 1)
    )
    parser.add_option(
        "--draw N",
        "calibration, faults, realtime --link, regions, surfaces: number that all cases follow from; others than those"
        " of the published figures",
        whole(0, 9999),
    )
    parser.add_option("--against FILE", "regions: regions.json of an earlier run, to compare with", Path)
    parser.add_option(
        "--recover", "faults: whether a cell comes back from what it loses by chance: power, links, its master's time"
    )
    parser.add_option("--vcan", "faults: on a real vcan0; processes are killed, and the link is taken down")
    parser.add_option("--link", "realtime: whether a check of a link says what the next minute shows, in virtual time")
    parser.add_option("--soak", "realtime: hold the cell for half an hour, and watch memory, clocks and counters")
    parser.add_option("--workers N", "number of processes [one for each core]", whole(1, 1024))
    parser.add_option("--fresh", "ignore finished cells in DIR")
    parser.add_shared("--json", "-v")
    parser.set_defaults(complain=parser.error)


def run(args: argparse.Namespace) -> int:
    """Run a study, print its table, write its files."""
    from canprobe.lab.studies.sweep import FORMS, STUDIES, run_study

    if args.list:
        described = {**STUDIES, **{typed: words for typed, (_, words) in FORMS.items()}}
        print_answer(args, described, lambda: print_table(list(described.items())))
        return 0
    typed = " ".join([args.name or "", *(f"--{form}" for form in FORM_OPTIONS if getattr(args, form))])
    _refuse_wrong(args, typed, STUDIES, FORMS)
    if args.seed is not None:
        return _replay(args, typed)
    from canprobe.lab.studies.result import as_document, text_of, write_study
    from canprobe.lab.studies.sweep import open_sweep

    out = args.out or Path("runs") / f"study-{typed.replace(' --', '-')}"
    options = {"workers": args.workers, "fresh": args.fresh}
    try:
        with open_sweep(out, say=args.report.say, progress=args.report.bar(".0f cells"), **options) as sweep:
            result = run_study(typed, quick=args.quick, sweep=sweep, **_chosen(args))
    except KeyboardInterrupt:
        args.report.complain(
            f"canprobe: interrupted; finished cells are kept in {out}, the same command computes the rest"
        )
        raise
    with interrupts_repeated():
        paths = write_study(result, out)
    print_answer(args, as_document(result), text_of(result), end="")
    args.report.say("wrote " + ", ".join(map(str, paths)))
    return 0


def _chosen(args: argparse.Namespace) -> dict[str, Any]:
    """The options that only some studies have, as far as they are given."""
    return {name: getattr(args, name) for name in STUDIES_WITH if getattr(args, name) is not None}


def _refuse_wrong(args: argparse.Namespace, typed: str, studies: Mapping[str, str], forms: Collection[str]) -> None:
    """Complain about an unknown study, and about options that it does not have."""
    if args.name not in studies:
        known = ", ".join(studies)
        wrong = f"unknown study {args.name!r}{did_you_mean(args.name, studies)}" if args.name else "expected NAME"
        args.complain(f"{wrong}; studies: {known}")
    if typed not in studies and typed not in forms:
        args.complain(f"study {typed}: there is no such form; expected one of {', '.join(forms)}")
    if args.vcan and args.seed is not None:
        args.complain("--seed: the runs on vcan0 depend on the machine's timing and cannot be repeated from a seed")
    for option in _chosen(args):
        if typed not in STUDIES_WITH[option]:
            args.complain(f"--{option}: study {typed}: only {', '.join(STUDIES_WITH[option])} has it")
        if args.seed is not None and option != "seed":
            args.complain(f"--{option}: study {typed}: a seed names its draw")


def _replay(args: argparse.Namespace, typed: str) -> int:
    """Carry out one numbered run of a study again; status 1 where it fails."""
    module = {"faults --recover": "recover"}.get(typed, typed)
    outcome = import_module(f"canprobe.lab.studies.{module}").replay(args.seed, args.report.say)
    if args.json:
        print_json(outcome)
    return 1 if outcome["failures"] else 0
