"""Run a study: accuracy of the estimators, limits of the force loop, faults, timing. It writes tables and pictures.

Finished cells of a study are kept in DIR/cells.jsonl. The same command computes what is missing, after Ctrl-C or a
crash. Cells whose code has changed since are computed again.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from canprobe.cli.argument_types import whole
from canprobe.cli.common_arguments import add_options, add_verbosity
from canprobe.cli.output import print_json, print_table
from canprobe.cli.parser import Parser
from canprobe.errors import did_you_mean
from canprobe.fieldbus.bus.real.interrupts import interrupts_repeated

HELP = "measure accuracy, limits, faults and timing"
EXAMPLE = """\
examples:
  canprobe study --list
  canprobe study estimators --quick --out runs/estimators
  canprobe study bound --dask tcp://10.0.0.1:8786
  canprobe study faults --seed 4711
  canprobe study recover --seed 17
  canprobe study regions --draw 2 --against earlier/regions.json
  canprobe study arrays --draw 2
  canprobe vcan -- canprobe study faults --vcan
  canprobe vcan -- canprobe study recover --vcan
  canprobe vcan --realtime -- canprobe study realtime --soak
"""
STUDIES_WITH: Mapping[str, tuple[str, ...]] = {
    "draw": ("arrays", "calibrations", "explore", "link", "regions", "shapes"),
    "against": ("regions",),
}
"""Studies that have an option, by the option's name."""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("name", metavar="NAME", nargs="?", help="study to run; --list lists them")
    parser.add_argument("--list", action="store_true", help="list the studies, and end")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder of the files [runs/study-NAME]")
    parser.add_argument("--quick", action="store_true", help="measure fewer cases, with fewer repeats")
    parser.add_argument(
        "--seed",
        metavar="N",
        type=whole(0, 2**63 - 1),
        help="faults, recover, regions: run only the case of this seed, and report each step",
    )
    parser.add_argument(
        "--draw",
        metavar="N",
        type=whole(0, 9999),
        help="arrays, calibrations, explore, link, regions, shapes: number that all cases follow from; others than"
        " those of the published figures",
    )
    parser.add_argument(
        "--against", metavar="FILE", type=Path, help="regions: regions.json of an earlier run, to compare with"
    )
    parser.add_argument(
        "--vcan",
        action="store_true",
        help="faults, recover: on a real vcan0; processes are killed (faults), and the link is taken down",
    )
    parser.add_argument(
        "--soak",
        action="store_true",
        help="realtime: hold the cell for half an hour, and watch memory, clocks and counters",
    )
    parser.add_argument("--workers", metavar="N", type=whole(1, 1024), help="number of processes [one for each core]")
    parser.add_argument("--dask", metavar="ADDRESS", help="compute on the Dask cluster with this scheduler")
    parser.add_argument("--fresh", action="store_true", help="ignore finished cells in DIR")
    add_options(parser, "--json")
    add_verbosity(parser)
    parser.set_defaults(complain=parser.error)


def run(args: argparse.Namespace) -> int:
    """Run a study, print its table, write its files."""
    from canprobe.lab.studies.sweep import STUDIES, run_study

    if args.list:
        if args.json:
            print_json(dict(STUDIES))
        else:
            print_table(list(STUDIES.items()))
        return 0
    _refuse_wrong(args, STUDIES)
    if args.seed is not None:
        return _replay(args)
    from canprobe.lab.studies.result_files import as_document, text_of, write_study
    from canprobe.lab.studies.sweep import open_sweep

    out = args.out or Path("runs") / f"study-{args.name}"
    form = "vcan" if args.vcan else "soak" if args.soak else ""
    options = {"workers": args.workers, "dask": args.dask, "fresh": args.fresh}
    try:
        with open_sweep(out, say=args.report.say, progress=args.report.bar(".0f cells"), **options) as sweep:
            result = run_study(args.name, quick=args.quick, sweep=sweep, form=form, **_chosen(args))
    except KeyboardInterrupt:
        args.report.complain(
            f"canprobe: interrupted; finished cells are kept in {out}, the same command computes the rest"
        )
        raise
    with interrupts_repeated():
        paths = write_study(result, out)
    if args.json:
        print_json(as_document(result))
    else:
        print(text_of(result), end="")
    args.report.say("wrote " + ", ".join(map(str, paths)))
    return 0


def _chosen(args: argparse.Namespace) -> dict[str, Any]:
    """The options that only some studies have, as far as they are given."""
    return {name: getattr(args, name) for name in STUDIES_WITH if getattr(args, name) is not None}


def _refuse_wrong(args: argparse.Namespace, studies: Mapping[str, str]) -> None:
    """Complain about an unknown study, and about options that it does not have."""
    if args.name == "soak":
        args.complain("study soak is now an option of study realtime: canprobe study realtime --soak")
    if args.name not in studies:
        known = ", ".join(studies)
        wrong = f"unknown study {args.name!r}{did_you_mean(args.name, studies)}" if args.name else "expected NAME"
        args.complain(f"{wrong}; studies: {known}")
    if args.vcan and args.name not in ("faults", "recover"):
        args.complain(f"--vcan: study {args.name} does not run on vcan0; only faults and recover do")
    if args.vcan and args.seed is not None:
        args.complain("--seed: the runs on vcan0 depend on the machine's timing and cannot be repeated from a seed")
    if args.soak and args.name != "realtime":
        args.complain(f"--soak: study {args.name} has no such form; only realtime has")
    for option in _chosen(args):
        if args.name not in STUDIES_WITH[option]:
            args.complain(f"--{option}: study {args.name}: only {', '.join(STUDIES_WITH[option])} has it")
        if args.seed is not None:
            args.complain(f"--{option}: study {args.name}: a seed names its draw")


def _replay(args: argparse.Namespace) -> int:
    """Carry out one numbered run of a study again; status 1 where it fails."""
    if args.name == "faults":
        from canprobe.lab.studies.faults import replay
    elif args.name == "recover":
        from canprobe.lab.studies.recover import replay
    elif args.name == "regions":
        from canprobe.lab.studies.regions import replay
    else:
        args.complain(f"--seed: expected study faults, recover or regions, got {args.name}")
    outcome = replay(args.seed, args.report.say)
    if args.json:
        print_json(outcome)
    return 1 if outcome["failures"] else 0
