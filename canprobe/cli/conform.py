"""Examine a CANopen device of any maker: CiA 301, CiA 305, CiA 402, and what its EDS promises.

Safe by default. Everything is read; in 1000h to 1FFFh only what can be restored is written, and it is restored and read
back after each point. Nothing from 2000h on is written, unless --write names it, and a power stage stays off, unless
--motion is given. What 1010h, 1011h and the objects of program and configuration hold is never touched. A snapshot is
on disk before the first write; --restore puts it back after an examination that was cut off.

Beside another master, another SYNC producer or other nodes, what could disturb them is left out. With --bus lockstep
the emulated node of the EDS is examined.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cli.argument_types import seconds, whole, word
from canprobe.cli.output import print_answer, print_json, print_table
from canprobe.cli.parser import Parser
from canprobe.cli.reports import add_report_options, bench_facts, eds_and_hash, read_baseline, write_report
from canprobe.cli.stdin import yes_typed
from canprobe.cli.target import real_target
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.port import Port, nothing
from canprobe.fieldbus.eds.packaged import check_eds, load_eds
from canprobe.fieldbus.tools import reports

if TYPE_CHECKING:
    from canprobe.fieldbus.tools.conform import Point

HELP = "examine a device of any maker for conformance"
EXAMPLE = """\
verdicts: PASS; FAIL; NOT APPLICABLE, with the reason; ERROR: the bench failed, not the device

exit status: 0 no point failed, 1 a point failed, 2 wrong usage, 3 the bench failed or the device does not answer

examples:
  canprobe conform --node 5 --eds drive.eds --channel can0
  canprobe conform --node 5 --eds drive.eds --channel can0 --junit conform.xml --html conform.html
  canprobe conform --node 5 --eds drive.eds --channel can0 --write 2000h-20FFh,6081h --points sdo,28
  canprobe conform --node 5 --channel can0 --json      # redirect it to before.json
  canprobe conform --node 5 --channel can0 --baseline before.json
  canprobe conform --node 5 --channel can0 --restore conform-node5.snapshot.json
  canprobe conform --node 5 --eds puma260_joint --bus lockstep
  canprobe conform --list
"""
_REAL_SLACK_S = 0.05


def add_arguments(parser: Parser) -> None:
    parser.add_option("--node N", "node id of the device", whole(1, 127))
    parser.add_option("--eds FILE", "EDS, DCF, XDD or XDC file of the device, or a packaged name", word)
    parser.add_real_bus(", or lockstep")
    parser.add_option(
        "--data-bitrate BIT/S",
        "the bus carries CAN FD: bit rate of the data phase [classical CAN]",
        whole(50_000, 8_000_000),
    )
    parser.add_option("--points LIST", "groups, numbers or points [all]", word)
    parser.add_option(
        "--write LIST",
        "objects that may be written, as 2000h-20FFh,6081h,60C2h:01; and the words reset (NMT reset node), history"
        " (clear 1003h)",
        default="",
    )
    parser.add_option("--motion", "also switch the power stage on and move the axis")
    parser.add_option("--yes", "with --motion: do not ask whether the axis may move")
    parser.add_option("--own FILE", "a TOML file with points of your own", Path)
    parser.add_option("--timeout S", "longest time to an SDO answer [1]", seconds, default=1.0)
    parser.add_option("--listen S", "time to hear the bus before [1.5]", seconds, default=1.5)
    parser.add_option(
        "--snapshot FILE",
        "keep the snapshot in this file [conform-node<N>.snapshot.json, removed when all is put back]",
        Path,
    )
    parser.add_option("--restore FILE", "put back a snapshot, and end", Path)
    parser.add_option("--log FILE", "record all frames as a candump log", Path)
    parser.add_option("--full", "print all points below the verdict")
    parser.add_option("--list", "list the points, and end")
    add_report_options(parser)
    parser.add_shared("-v")


def run(args: argparse.Namespace) -> int:
    """Examine the device, and print what was found."""
    if args.list:
        return _list(args)
    if args.node is None:
        how = "any, such as --node 1" if args.bus == "lockstep" else "`canprobe scan` lists the nodes on a bus"
        raise UsageError(f"conform: --node N names the device; {how}")
    from canprobe.fieldbus.eds.description import Description
    from canprobe.fieldbus.tools.conform import Examination, ExaminationSettings, WriteList, restore_snapshot
    from canprobe.fieldbus.tools.conform.frame_link import BenchTimes

    points, baseline = _points(args), read_baseline(args)
    description = None if args.eds is None else Description(load_eds(args.eds, args.node))
    times, virtual = BenchTimes(sdo_s=args.timeout, slack_s=_REAL_SLACK_S), args.bus == "lockstep"
    question = f"node {args.node} will be switched on and its axis will move: is everybody out of its way?"
    if args.motion and not (args.yes or virtual or yes_typed(question)):
        raise UsageError("conform: --motion needs a yes at the terminal, or --yes")
    with _port(args) as port:
        if args.restore is not None:
            restored = restore_snapshot(port, args.node, args.restore, times)
            print_answer(args, {"restored": restored}, "\n".join(restored))
            return 0
        settings = ExaminationSettings(
            written=WriteList.parse(args.write),
            motion=args.motion,
            snapshot=args.snapshot or (None if virtual else Path(f"conform-node{args.node}.snapshot.json")),
            keep_snapshot=args.snapshot is not None,
            listen_s=args.listen,
            bitrate=args.bitrate or 1_000_000,
            fd=virtual or args.data_bitrate is not None,
            times=BenchTimes() if virtual else times,
            ask=yes_typed if sys.stdin.isatty() else None,
        )
        examination = Examination(port, args.node, description, settings)
        examination.report.facts.update(_bench_facts(args))
        bar = args.report.bar(".0f points") or nothing
        report = examination.run(points, lambda _row, number, total: bar(number, total))
    report.log = None if args.log is None else str(args.log)
    if "warning" in report.facts:
        args.report.say(f"warning: {report.facts['warning']}")
    return _finish(args, report, baseline)


def _finish(args: argparse.Namespace, report: reports.Report, baseline: reports.Report | None) -> int:
    if baseline is not None and args.points:
        asked = {(row.group, row.name) for row in report.rows}
        baseline.rows = [row for row in baseline.rows if (row.group, row.name) in asked]
    change = write_report(args, report, baseline)
    if args.json:
        print_json(reports.report_document(report))
        return report.exit_status
    print(reports.verdict_text(report, change))
    if args.full:
        print("", *map(reports.row_text, report.rows), reports.closing_text(report), sep="\n")
    else:
        failed = dict.fromkeys(row.group for row in report.rows if row.verdict is reports.Verdict.FAIL)
        again = f"; after a change --points {','.join(failed)}" if failed else ""
        print(f"all points: type it again with --full, or --html FILE for the frames{again}")
    return report.exit_status


def _points(args: argparse.Namespace) -> tuple[Point, ...]:
    from canprobe.fieldbus.tools.conform.own_points import read_points
    from canprobe.fieldbus.tools.conform.registry import POINTS, chosen_points

    own = () if args.own is None else read_points(args.own)
    return chosen_points((*POINTS, *own), (args.points or "").split(","))


@contextlib.contextmanager
def _port(args: argparse.Namespace) -> Iterator[Port]:
    """The bus of the command; with --log its frames are recorded."""
    from canprobe.fieldbus.bus.candump import CandumpWriter, RecordingPort

    with contextlib.ExitStack() as stack:
        if args.bus == "lockstep":
            port = _emulated(args)
        else:
            from canprobe.cell.session.target import open_bus, refuse_virtual

            refuse_virtual(args.bus, "conform")
            target = real_target(args, args.channel, channel_else="can0")
            port = stack.enter_context(open_bus(target, args.report.say, args.data_bitrate))
        if args.log is not None:
            writer = stack.enter_context(CandumpWriter(args.log, port.channel, port.clock.now_ns()))
            port = RecordingPort(port, writer.on(port.channel))
        yield port


def _emulated(args: argparse.Namespace) -> Port:
    """A port of a bus in virtual time with the emulated node of the EDS."""
    if args.eds is None:
        raise UsageError("conform: --bus lockstep examines the emulated node of an EDS: name it with --eds")
    from canprobe.fieldbus.bus.clock import VirtualClock
    from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
    from canprobe.fieldbus.drive.from_eds import make_eds_node

    bus = LockstepBus(VirtualClock(), "lockstep", fd=True)
    bus.attach(make_eds_node(load_eds(args.eds, args.node), args.node, eds=args.eds))
    return bus.port()


def _bench_facts(args: argparse.Namespace) -> dict[str, str]:
    """What the report says of the bench."""
    rate = f"{args.bitrate or 1_000_000} bit/s" if args.bus != "lockstep" else "virtual time"
    facts = bench_facts({"adapter": args.bus or "socketcan", "bit rate": rate})
    permitted = ", ".join(filter(None, [args.write, "motion" if args.motion else ""]))
    facts["permitted"] = permitted or "nothing beyond the default"
    if args.eds is not None:
        reading = check_eds(args.eds, args.node)
        facts["EDS check"] = f"{len(reading.faults)} faults, {len(reading.warnings)} warnings; canprobe eds check"
        facts["EDS"] = eds_and_hash(args.eds)
    return facts


def _list(args: argparse.Namespace) -> int:
    points, keys = _points(args), ("group", "number", "name", "clause", "expected")
    document = [{key: getattr(one, key) for key in keys} | {"needs": sorted(one.needs)} for one in points]
    rows = [(point.group, point.title, point.clause, point.expected, " ".join(sorted(point.needs))) for point in points]
    print_answer(args, document, lambda: print_table([("group", "point", "clause", "accepted", "needs"), *rows]))
    return 0
